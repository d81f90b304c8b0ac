"""Configuration of `tron-bake`."""
