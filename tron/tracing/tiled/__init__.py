"""Camera rays along the lists of screen tiles."""
