"""Configuration of `tron-view`."""
