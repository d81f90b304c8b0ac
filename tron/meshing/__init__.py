"""Surfels as triangles with textures."""
