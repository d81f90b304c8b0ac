"""The neural renderer: guidance buffers in, the picture that path tracing would give out.

Everything here works on display-encoded values (AgX, scaled to [-1, 1] inside the networks); exposure and
tone curve are applied at the door, by `render_clip` and by the training data. No Mitsuba, no tracing.
"""
