"""What the benchmark `reconstruction` measures: reconstructions, their lights, optimisation steps."""
