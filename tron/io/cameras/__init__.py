"""Cameras of other programs, in and out: one table of their formats."""
