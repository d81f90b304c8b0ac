"""Scenes in Mitsuba: meshes, textures, G-buffers, path tracing."""
