"""Benchmark `video`: temporal stability by exact flow, and five scores of VBench."""
