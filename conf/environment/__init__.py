"""Configuration of `tron-environment`."""
