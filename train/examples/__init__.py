"""Training examples: read from shards, cropped, varied, mixed."""
