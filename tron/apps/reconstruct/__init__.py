"""The command ``tron-reconstruct``."""
