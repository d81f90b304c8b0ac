"""Configuration of `tron-datagen`."""
