"""Camera rays, traced through the candidate lists of screen tiles."""
