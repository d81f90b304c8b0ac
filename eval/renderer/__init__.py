"""Benchmark of the neural renderer: `tron-eval benchmark=renderer`."""
