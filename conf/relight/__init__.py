"""Configuration of `tron-relight`."""
