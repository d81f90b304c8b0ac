"""Objects, materials, lights and cameras of scenes, drawn from seeds."""
