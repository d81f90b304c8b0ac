"""Path tracers as witnesses: Mitsuba's on meshes, and Cycles in a Blender of its own."""
