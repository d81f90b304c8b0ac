"""Hydra configuration: one folder a command; `experiment/` in each holds whole recipes."""
