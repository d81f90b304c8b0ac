"""Networks that a renderer is made of."""
