"""Configuration of `tron-train`."""
