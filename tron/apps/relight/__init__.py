"""The command ``tron-relight``."""
