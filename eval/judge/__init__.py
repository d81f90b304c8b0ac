"""Benchmark `judge`: a vision model chooses the more photorealistic of two pictures."""
