"""Checklists that are shipped."""
