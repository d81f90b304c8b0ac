"""Shadowed light of the environment at surface points, from few rays."""
