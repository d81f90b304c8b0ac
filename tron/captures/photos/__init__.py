"""Photographs: files, masks, depth, lenses, and the views that they become."""
