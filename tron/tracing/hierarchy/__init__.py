"""Shadow and bounce rays through a bounding volume hierarchy."""
