"""Other renderers that ours is timed against, and the scenes on which."""
