"""Light that bounces between surfels: traced once, baked once a light."""
