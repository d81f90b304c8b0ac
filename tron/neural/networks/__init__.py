"""Networks that are parts of a renderer."""
