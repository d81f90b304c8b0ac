"""Extrusions of drawn profiles: gears, brackets, letters, cut boards; twisted and bent solids."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from manifold3d import CrossSection, Manifold, OpType

from datagen.world.shapes.shape import Kind
from datagen.world.shapes.solids import Parts, between, count, rounded_box, tube

LETTERS: dict[str, tuple[tuple[tuple[float, float], ...], ...]] = {
    "A": (((0, 0), (2, 6), (4, 0)), ((0.8, 2.2), (3.2, 2.2))),
    "E": (((4, 0), (0, 0), (0, 6), (4, 6)), ((0, 3), (3.2, 3))),
    "F": (((0, 0), (0, 6), (4, 6)), ((0, 3), (3, 3))),
    "H": (((0, 0), (0, 6)), ((4, 0), (4, 6)), ((0, 3), (4, 3))),
    "K": (((0, 0), (0, 6)), ((4, 6), (0, 2.6)), ((1.4, 3.8), (4, 0))),
    "M": (((0, 0), (0, 6), (2.2, 2.4), (4.4, 6), (4.4, 0)),),
    "N": (((0, 0), (0, 6), (4, 0), (4, 6)),),
    "P": (((0, 0), (0, 6), (3, 6), (4, 5), (4, 4), (3, 3), (0, 3)),),
    "R": (((0, 0), (0, 6), (3, 6), (4, 5), (4, 4), (3, 3), (0, 3)), ((2, 3), (4, 0))),
    "S": (((4, 5.2), (3, 6), (1, 6), (0, 5), (0.6, 3.4), (3.4, 2.6), (4, 1), (3, 0), (1, 0), (0, 0.8)),),
    "T": (((2, 0), (2, 6)), ((0, 6), (4, 6))),
    "W": (((0, 6), (1.1, 0), (2.4, 4.5), (3.7, 0), (4.8, 6)),),
    "X": (((0, 0), (4, 6)), ((0, 6), (4, 0))),
    "Z": (((0, 6), (4, 6), (0, 0), (4, 0)),),
    "2": (((0, 4.8), (0.8, 6), (3.2, 6), (4, 4.8), (3.6, 3.6), (0, 0), (4, 0)),),
    "5": (((3.8, 6), (0.3, 6), (0, 3.4), (2.8, 3.7), (4, 2.6), (4, 1.2), (3, 0), (0, 0.2)),),
    "8": (((1, 3), (0, 5), (1, 6), (3, 6), (4, 5), (3, 3), (1, 3), (0, 2), (1, 0), (3, 0), (4, 2), (3, 3)),),
}  # fmt: skip
"""Strokes of letters and figures, 4 wide and 6 high."""


def beveled(outline: CrossSection, thickness: float, bevel: float) -> Manifold:
    """Extrusion from z = 0 whose rims step inwards twice, as a chamfer does that has been rounded."""
    inner, middle = outline.offset(-bevel), outline.offset(-0.3 * bevel)
    layers = [
        inner.extrude(thickness),
        middle.extrude(thickness - 0.6 * bevel).translate((0.0, 0.0, 0.3 * bevel)),
        outline.extrude(thickness - 2.0 * bevel).translate((0.0, 0.0, bevel)),
    ]
    return Manifold.batch_boolean([layer for layer in layers if not layer.is_empty()], OpType.Add)


def _circle(radius: float, x: float = 0.0, y: float = 0.0) -> CrossSection:
    return CrossSection.circle(radius, 48).translate((x, y))


def gear(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Toothed wheel with a bore, a hub and lightening holes."""
    teeth = count(p[0], 10, 28)
    pitch = 2 * np.pi / teeth
    depth = min(0.2, 1.6 / teeth + 0.06)
    phases = np.array([-0.27, -0.13, 0.13, 0.27]) * pitch
    angle = (np.arange(teeth)[:, None] * pitch + phases).ravel()
    radius = np.tile([1.0 - depth, 1.0, 1.0, 1.0 - depth], teeth)
    wheel = CrossSection([np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])])
    bore = between(p[1], 0.1, 0.2)
    holes, at = count(p[2], 0, 6), 0.53
    for k in range(holes if holes > 2 else 0):
        turn = 2 * np.pi * k / holes
        wheel -= _circle(min(0.17, 0.9 / holes), at * np.cos(turn), at * np.sin(turn))
    thickness = between(p[3], 0.15, 0.5)
    hub = _circle(bore + 0.12).extrude(thickness + rng.uniform(0.05, 0.25))
    body = beveled(wheel, thickness, 0.02) + hub
    return [(body - _circle(bore).extrude(3.0).translate((0.0, 0.0, -1.0)), 0)]


def bracket(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Rolled section, L, U, T or I, with bolt holes through its web."""
    t, length = between(p[0], 0.1, 0.2), between(p[1], 0.8, 2.6)
    wide, high = between(p[2], 0.7, 1.2), 1.0
    foot = CrossSection.square((wide, t))
    left = CrossSection.square((t, high))
    right, middle = left.translate((wide - t, 0.0)), left.translate((0.5 * (wide - t), 0.0))
    top = foot.translate((0.0, high - t))
    section = (foot + left, foot + left + right, foot + middle, foot + middle + top)[count(p[3], 0, 3)]
    rolled = section.offset(-0.03 * t).offset(0.03 * t)
    solid = rolled.extrude(length)
    holes = 1 + int(rng.integers(3))
    for k in range(holes):
        drill = Manifold.cylinder(4.0, 0.17 * wide, circular_segments=32).rotate((-90.0, 0.0, 0.0))
        across = 0.25 * wide if p[3] >= 0.5 else 0.55 * wide
        solid -= drill.translate((across, -2.0, length * (k + 0.5) / holes)).trim_by_plane((0, -1, 0), -2 * t)
    return [(solid.rotate((90.0, 0.0, 0.0)), 0)]


def letter(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Letter or figure that stands, as on a shop front."""
    names = list(LETTERS)
    strokes = LETTERS[names[int(rng.integers(len(names)))]]
    width = between(p[0], 0.4, 0.7)
    pen = CrossSection.circle(width, 32) if p[1] < 0.5 else CrossSection.square((2 * width, 2 * width), True)
    marks = [
        CrossSection.batch_hull([pen.translate(a), pen.translate(b)])
        for stroke in strokes
        for a, b in pairwise(stroke)
    ]
    outline = CrossSection.batch_boolean(marks, OpType.Add)
    slant = np.array([[1.0, between(p[2], -0.05, 0.25), 0.0], [0.0, 1.0, 0.0]])
    solid = beveled(outline.transform(slant), between(p[3], 0.8, 2.4), 0.08)
    return [(solid.rotate((90.0, 0.0, 0.0)), 0)]


def cutout(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Board sawn along a smooth closed curve, with a hole."""
    waves = np.arange(2, 6)
    size, phase = rng.normal(0.0, between(p[0], 0.05, 0.13), 4), rng.uniform(0.0, 2 * np.pi, 4)
    angle = np.arange(160) * 2 * np.pi / 160
    radius = 1.0 + (size[:, None] * np.cos(waves[:, None] * angle + phase[:, None])).sum(axis=0)
    radius = np.maximum(radius, 0.4)
    outline = CrossSection(
        [np.column_stack([radius * np.cos(angle), between(p[1], 0.6, 1.0) * radius * np.sin(angle)])]
    )
    outline -= _circle(between(p[2], 0.06, 0.2), 0.25 * rng.uniform(-1, 1), 0.2 * rng.uniform(-1, 1))
    return [(beveled(outline, between(p[3], 0.1, 0.5), 0.025), 0)]


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


EXTRUSIONS: dict[str, Kind] = {
    "gear": Kind(gear, roles=("metal",)),
    "bracket": Kind(bracket, roles=("metal",)),
    "letter": Kind(letter, upright=True, roles=("plastic",)),
    "cutout": Kind(cutout, roles=("wood",)),
    "twisted": Kind(twisted, upright=True),
    "arch": Kind(arch, upright=True, roles=("stone",)),
    "spring": Kind(spring, roles=("metal",)),
    "horn": Kind(horn, roles=("any",)),
}
