"""Reference path tracers: Mitsuba on meshes, and Cycles in a separate Blender."""
