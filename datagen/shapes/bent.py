"""Twisted and bent solids."""

from __future__ import annotations

import numpy as np
from manifold3d import CrossSection

from datagen.shapes.shape import Kind
from datagen.shapes.solids import Parts, between, count, rounded_box, tube


def _section(sides: int, round_by: float) -> CrossSection:
    """Regular polygon of radius 1 with rounded corners."""
    angle = np.arange(sides) * 2 * np.pi / sides
    polygon = CrossSection([np.column_stack([np.cos(angle), np.sin(angle)])])
    return polygon.offset(-round_by).offset(round_by, circular_segments=32)


def twisted(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Prism turned about its axis as it rises, wider or narrower at its top."""
    height = between(p[0], 1.8, 4.0)
    angle = between(p[1], 60.0, 320.0) * (1.0 if rng.random() < 0.5 else -1.0)
    top = between(p[2], 0.45, 1.1)
    outline = _section(count(p[3], 3, 6), 0.15)
    return [(outline.extrude(height, 64, angle, (top, top)), 0)]


def arch(p: np.ndarray, _rng: np.random.Generator) -> Parts:
    """Bar bent over an arc that stands on its two ends."""
    radius, sweep = 1.0, between(p[0], 0.55, 1.0) * np.pi
    wide, thick = between(p[1], 0.25, 0.9), between(p[2], 0.15, 0.4)
    bar = rounded_box((1.0, wide, thick), 0.04).refine_to_length(0.06)
    taper = between(p[3], -0.4, 0.1)

    def bend(vertices: np.ndarray) -> np.ndarray:
        angle = sweep * vertices[:, 0]
        shrink = 1.0 + taper * np.cos(angle)
        reach = radius + vertices[:, 2]
        return np.column_stack([reach * np.sin(angle), vertices[:, 1] * shrink, reach * np.cos(angle)])

    return [(bar.warp_batch(bend), 0)]


def spring(p: np.ndarray, _rng: np.random.Generator) -> Parts:
    """Helix of wire with flat last turns."""
    turns, wire = between(p[0], 3.0, 7.0), between(p[1], 0.08, 0.16)
    pitch = between(p[2], 2.6, 5.0) * wire
    t = np.linspace(0.0, 1.0, int(48 * turns))
    angle = 2 * np.pi * turns * t
    # The first and last turns lie nearly flat, as on a spring that has to stand.
    rise = np.clip((t * turns - 0.5) / (turns - 1.0), 0.0, 1.0) * pitch * turns
    rise = rise + wire * 2.05 * (np.clip(t * turns, 0, 0.5) + np.clip(t * turns - turns + 0.5, 0, 0.5))
    radius = 1.0 + between(p[3], -0.5, 0.0) * t
    return [(tube(np.column_stack([radius * np.cos(angle), radius * np.sin(angle), rise]), wire), 0)]


def horn(p: np.ndarray, _rng: np.random.Generator) -> Parts:
    """Snail or ram's horn: a tube that widens along a spiral."""
    turns, growth = between(p[0], 1.2, 2.4), between(p[1], 0.14, 0.22)
    t = np.linspace(0.0, 1.0, 160)
    angle = 2 * np.pi * turns * t
    size = np.exp(growth * angle)
    size = size / size[-1]
    climb = between(p[2], 0.2, 1.0)
    path = np.column_stack([size * np.cos(angle), size * np.sin(angle), -climb * (size - size[0])])
    radii = between(p[3], 0.3, 0.42) * size
    return [(tube(path, radii, sections=28), 0)]


BENT: dict[str, Kind] = {
    "twisted": Kind(twisted, upright=True),
    "arch": Kind(arch, upright=True, roles=("stone",)),
    "spring": Kind(spring, roles=("metal",)),
    "horn": Kind(horn, roles=("any",)),
}
