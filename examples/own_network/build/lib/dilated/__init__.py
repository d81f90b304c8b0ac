"""A neural renderer of one's own."""
