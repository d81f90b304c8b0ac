"""Benchmark `compare`: score folders of pictures, ours and anyone's, by the same rules on a suite."""
