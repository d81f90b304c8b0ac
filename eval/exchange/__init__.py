"""Benchmark `exchange`: other programs read our files, and we read theirs."""
