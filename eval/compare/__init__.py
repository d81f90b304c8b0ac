"""Benchmark `compare`: folders of pictures, ours and anyone's, judged alike on a suite."""
