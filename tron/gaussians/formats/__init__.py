"""Splats in other files than PLYs, one format a file."""
