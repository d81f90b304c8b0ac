"""Runs: the plan, the workers that make it, failures, stores, merging, validation."""
