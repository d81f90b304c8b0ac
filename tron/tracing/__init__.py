"""Rays against surfels in Dr.Jit: a camera's G-buffer and the transmittance of shadow rays."""

from tron.tracing.gbuffer import GBuffer
from tron.tracing.surface import Surface
from tron.tracing.tracer import SurfelTracer

__all__ = ["GBuffer", "Surface", "SurfelTracer"]
