"""Benchmark `exchange`: files that we write as other programs read them, and the reverse."""
