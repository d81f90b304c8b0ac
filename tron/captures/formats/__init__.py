"""Formats of posed captures, one a file."""
