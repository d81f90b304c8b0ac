"""Configuration of `tron-export`."""
