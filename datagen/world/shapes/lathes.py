"""Lathes of drawn profiles: vessels with a wall and turned solids. They stand upright, z is their axis."""

from __future__ import annotations

import numpy as np
from manifold3d import Manifold

from datagen.world.shapes.shape import Kind
from datagen.world.shapes.solids import (
    Parts,
    between,
    rounded_box,
    smooth_profile,
    tube,
    turned,
    union,
    vessel,
)


def bottle(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Body, shoulder, neck and lip."""
    height, neck = between(p[0], 2.2, 3.4), between(p[1], 0.22, 0.4)
    shoulder = between(p[2], 0.4, 0.65)
    heights = [0.0, 0.04, shoulder - 0.04, shoulder, shoulder + between(p[3], 0.12, 0.25), 0.95, 0.955, 1.0]
    belly = rng.uniform(0.85, 1.05)
    radii = [0.88, 0.97, belly, belly - 0.03, neck, neck, neck + 0.06, neck + 0.06]
    return [(vessel(smooth_profile(np.array(heights) * height, radii, 96), 0.07), 0)]


def bowl(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Bowl on a foot ring."""
    height, foot = between(p[0], 0.5, 1.0), between(p[1], 0.3, 0.5)
    curve = between(p[2], 0.35, 0.75)
    t = np.linspace(0.0, 1.0, 40)
    radii = foot + (1.0 - foot) * t**curve + 0.06 * rng.uniform(-1, 1) * np.sin(np.pi * t)
    profile = np.column_stack([radii, 0.08 + height * t])
    profile = np.concatenate([[[foot * 0.92, 0.0]], profile])
    return [(vessel(profile, between(p[3], 0.04, 0.08)), 0)]


def dish(p: np.ndarray, _rng: np.random.Generator) -> Parts:
    """Flat plate with a well and a rim."""
    well, rise, rim = between(p[0], 0.5, 0.75), between(p[1], 0.06, 0.16), between(p[2], 0.02, 0.1)
    outline = [
        (well * 0.9, 0.0),
        (well, 0.03),
        (well + 0.06, rise),
        (0.97, rise + rim),
        (1.0, rise + rim + 0.02),
    ]
    return [(vessel(np.array(outline), between(p[3], 0.03, 0.05), sections=96), 0)]


def goblet(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Cup on a turned stem with a foot."""
    cup, stem = between(p[0], 0.5, 0.8), between(p[1], 0.07, 0.14)
    knob = rng.uniform(1.2, 2.2) * stem
    foot = smooth_profile(
        [0.0, 0.06, 0.16, 0.5, 0.62, 0.74, 1.0], [0.6, 0.58, 2.0 * stem, stem, knob, stem, 1.4 * stem], 64
    )
    t = np.linspace(0.0, 1.0, 32)
    radii = cup * (0.25 + 0.75 * t ** between(p[2], 0.35, 0.6)) - 0.12 * p[3] * t**4
    bowl_profile = np.column_stack([radii, 0.95 + between(p[3], 0.8, 1.3) * t])
    return [(union([turned(foot), vessel(bowl_profile, 0.05)]), 0)]


def jar(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Jar with a lid and its knob, a slot for each."""
    height, mouth = between(p[0], 1.2, 2.2), between(p[1], 0.55, 0.85)
    belly = rng.uniform(0.9, 1.1)
    body = smooth_profile(
        np.array([0.0, 0.05, between(p[2], 0.35, 0.65), 0.9, 1.0]) * height, [0.66, 0.72, belly, mouth, mouth]
    )
    rise = between(p[3], 0.08, 0.3)
    lid = smooth_profile([0.0, 0.08, 0.09 + rise], [mouth + 0.07, mouth + 0.07, 0.12], 32)
    knob = smooth_profile([0.0, 0.08, 0.18, 0.26], [0.08, 0.07, 0.15, 0.05], 24)
    cover = union([turned(lid), turned(knob).translate((0.0, 0.0, 0.08 + rise))])
    return [(vessel(body, 0.07), 0), (cover.translate((0.0, 0.0, height)), 1)]


def urn(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Vase of a freely drawn profile: five radii, none steeper than clay would stand."""
    radii = np.concatenate([[0.45 + 0.25 * p[0]], rng.uniform(0.4, 1.0, 3), [0.3 + 0.4 * p[1]]])
    radii[2] = between(p[2], 0.8, 1.1)
    height = between(p[3], 1.6, 2.8)
    profile = smooth_profile(np.linspace(0.0, height, 5), radii, 80)
    lip = profile[-1] + [[0.05, 0.04], [0.08, 0.07]]
    return [(vessel(np.concatenate([profile, lip]), 0.06), 0)]


def baluster(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Turned wooden column of beads and coves: chess piece, candlestick, table leg."""
    n = 7 + int(5 * p[0])
    edges = np.cumsum(rng.uniform(0.5, 1.5, n))
    edges = np.concatenate([[0.0], edges / edges[-1]])
    radii = np.where(np.arange(n + 1) % 2, rng.uniform(0.4, 0.75, n + 1), rng.uniform(0.18, 0.4, n + 1))
    radii[:2] = 0.95, 0.9
    radii[-1] = between(p[1], 0.15, 0.6)
    height = between(p[2], 2.0, 3.6)
    return [(turned(smooth_profile(edges * height, radii, 120)), 0)]


def turned_leg(height: float, radius: float) -> Manifold:
    """Leg of a table or chair with beads, from z = 0."""
    heights = np.array([0.0, 0.08, 0.12, 0.5, 0.72, 0.76, 0.8, 0.84, 1.0]) * height
    return turned(
        smooth_profile(heights, radius * np.array([0.4, 0.6, 0.45, 0.75, 0.5, 0.85, 0.5, 0.9, 0.9]), 60), 24
    )


def mug(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Cup with a handle, in one piece."""
    height, taper = between(p[0], 1.5, 2.5), between(p[1], -0.15, 0.2)
    t = np.linspace(0.0, 1.0, 24)
    profile = np.column_stack([1.0 + taper * (t - 0.5) - 0.08 * np.exp(-t / 0.04), t * height])
    cup = vessel(profile, 0.09)
    angle = np.linspace(-0.62 * np.pi, 0.62 * np.pi, 40)
    reach, tall = between(p[2], 0.55, 0.8), between(p[3], 0.28, 0.36) * height
    path = np.column_stack(
        [0.85 + reach * (np.cos(angle) + 0.25), np.zeros(40), 0.52 * height + tall * np.sin(angle)]
    )
    handle = tube(path, 0.1 + 0.03 * rng.random(), sections=16) - turned(profile)
    return [(union([cup, handle]), 0)]


def kettle(p: np.ndarray, _rng: np.random.Generator) -> Parts:
    """Closed pot with a spout, a lid knob and an arched handle: metal, and wood where one holds it."""
    height = between(p[0], 1.1, 1.6)
    body = smooth_profile(np.array([0.0, 0.06, 0.4, 0.85, 1.0]) * height, [0.8, 0.9, 1.0, 0.6, 0.35])
    knob = smooth_profile([0.0, 0.07, 0.16, 0.22], [0.08, 0.06, 0.13, 0.04], 24)
    t = np.linspace(0.0, 1.0, 24)[:, None]
    spout = np.hstack([0.75 + (0.85 + 0.3 * p[1]) * t, 0 * t, 0.35 * height + 0.6 * height * t ** (1 + p[2])])
    pot = union([turned(body), tube(spout, np.linspace(0.2, 0.09, 24), sections=20)])
    angle = np.linspace(0.06, 0.94, 40) * np.pi
    arch = np.column_stack(
        [0.72 * np.cos(angle), 0 * angle, 0.72 * height + between(p[3], 0.7, 1.0) * np.sin(angle)]
    )
    grip = rounded_box((0.6, 0.17, 0.17), 0.07, (0.0, 0.0, float(arch[:, 2].max())))
    return [
        (union([pot, tube(arch, 0.05)]), 0),
        (union([turned(knob).translate((0.0, 0.0, height - 0.01)), grip]), 1),
    ]


LATHES: dict[str, Kind] = {
    "bottle": Kind(bottle, upright=True, roles=("plastic",)),
    "bowl": Kind(bowl, upright=True, roles=("ceramic",)),
    "plate": Kind(dish, upright=True, roles=("ceramic",)),
    "goblet": Kind(goblet, upright=True, roles=("metal",)),
    "jar": Kind(jar, upright=True, roles=("ceramic", "wood")),
    "urn": Kind(urn, upright=True, roles=("ceramic",)),
    "baluster": Kind(baluster, upright=True, roles=("wood",)),
    "mug": Kind(mug, upright=True, roles=("ceramic",)),
    "kettle": Kind(kettle, upright=True, roles=("metal", "wood")),
}
