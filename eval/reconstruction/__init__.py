"""Benchmark `reconstruction`: surfels from photos, fitted lights, relighting and speed."""
