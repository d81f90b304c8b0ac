"""Configuration of `tron-eval`."""
