"""The renderer benchmark: the shipped checkpoints on data that nobody trained on."""
