"""All other rays through a bounding volume hierarchy."""
