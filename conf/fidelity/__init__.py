"""Recipes that commands share: a file has a part for each command that it concerns."""
