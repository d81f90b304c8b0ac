"""Benchmark `video`: steadiness of films by exact flow, and the five scores of VBench."""
