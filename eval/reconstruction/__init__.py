"""Benchmark `reconstruction`: reconstructions, their lights, optimisation steps."""
