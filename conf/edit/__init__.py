"""Configuration of `tron-edit`."""
