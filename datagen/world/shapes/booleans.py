"""Boolean combinations of simple solids (manifold3d)."""

from __future__ import annotations

from itertools import product

import numpy as np
from manifold3d import Manifold

from datagen.world.shapes.shape import Kind
from datagen.world.shapes.solids import Parts, between, count, rod, rounded_box, union

AXES = np.eye(3)


def _bore(axis: np.ndarray, radius: float, centre: np.ndarray | float = 0.0) -> Manifold:
    return rod(centre - 3.0 * axis, centre + 3.0 * axis, radius, sections=40)


def die(p: np.ndarray, _rng: np.random.Generator) -> Parts:
    """Die: a cube met with a ball, pips sunk into its faces."""
    cube = rounded_box((2.0, 2.0, 2.0), between(p[0], 0.06, 0.2))
    cube ^= Manifold.sphere(between(p[1], 1.35, 1.62), 96)
    reach, size = 0.5, between(p[2], 0.16, 0.22)
    places = {
        1: [(0, 0)],
        2: [(-1, -1), (1, 1)],
        3: [(-1, -1), (0, 0), (1, 1)],
        4: list(product((-1, 1), repeat=2)),
        5: [(0, 0), *product((-1, 1), repeat=2)],
        6: list(product((-1, 1), (-1, 0, 1))),
    }
    pips = []
    for number, (axis, sign) in zip((1, 6, 2, 5, 3, 4), product(range(3), (-1.0, 1.0))):
        for u, v in places[number]:
            at = np.roll([sign * (1.0 + 0.35 * size), reach * u, reach * v], axis)
            pips.append(Manifold.sphere(size, 24).translate((float(at[0]), float(at[1]), float(at[2]))))
    return [(cube - union(pips), 0)]


def drilled(p: np.ndarray, _rng: np.random.Generator) -> Parts:
    """Ball or cube bored along its three axes, a smaller one left inside."""
    outer = Manifold.sphere(1.0, 96) if p[0] < 0.6 else rounded_box((1.6, 1.6, 1.6), 0.15)
    bores = union(_bore(axis, between(p[1], 0.35, 0.55)) for axis in AXES)
    hollow = Manifold.sphere(0.78, 80)
    body = outer - hollow - bores if p[2] < 0.5 else outer - bores
    # The ball inside hangs on a spindle, so that the whole is one thing.
    heart = Manifold.sphere(between(p[3], 0.3, 0.5), 64)
    spindle = rod((-0.6, -0.6, -0.6), (0.6, 0.6, 0.6), 0.06)
    return [(body, 0), (heart + (spindle ^ Manifold.sphere(0.95, 64)), 1)]


def joint(p: np.ndarray, _rng: np.random.Generator) -> Parts:
    """Pipe fitting: three to six flanged arms that meet in a ball, all hollow."""
    arms = [*AXES, *-AXES][: count(p[0], 3, 6)]
    radius, length = between(p[1], 0.26, 0.42), between(p[2], 0.8, 1.2)
    flange, wall = radius + between(p[3], 0.08, 0.22), 0.07
    solids = [Manifold.sphere(radius * 1.25, 64)]
    solids += [rod((0, 0, 0), length * arm, radius, sections=40) for arm in arms]
    solids += [rod((length - 0.14) * arm, length * arm, flange, sections=48) for arm in arms]
    inner = [Manifold.sphere(radius * 1.25 - wall, 64)]
    inner += [rod((0, 0, 0), (length + 1) * arm, radius - wall, sections=40) for arm in arms]
    return [(union(solids) - union(inner), 0)]


def nut(p: np.ndarray, _rng: np.random.Generator) -> Parts:
    """Hexagonal nut: prism, both ends chamfered by a cone, smooth bore."""
    height, bore = between(p[0], 0.6, 1.1), between(p[1], 0.45, 0.6)
    prism = Manifold.cylinder(height, 1.0, circular_segments=6)
    cone = Manifold.cylinder(height + 1.0, 1.55, 0.55 + 0.4 * p[2], circular_segments=64)
    flipped = cone.mirror((0, 0, 1)).translate((0.0, 0.0, height + 0.4))
    body = prism ^ cone.translate((0.0, 0.0, -0.45)) ^ flipped
    return [(body - Manifold.cylinder(4.0, bore, circular_segments=48).translate((0, 0, -1)), 0)]


def lantern(p: np.ndarray, _rng: np.random.Generator) -> Parts:
    """Shell of a ball, flat or tall, pierced all over, open below; light falls through it in spots."""
    rows, around = count(p[0], 3, 5), count(p[1], 8, 14)
    squat = between(p[2], 0.9, 1.4)
    shell = (Manifold.sphere(1.0, 96) - Manifold.sphere(0.92, 96)).trim_by_plane((0, 0, 1), -0.8)
    holes = []
    for row in range(rows):
        polar = np.radians(40.0 + 95.0 * row / max(rows - 1, 1))
        size = min(between(p[3], 0.07, 0.13), 0.62 * np.pi * np.sin(polar) / around)
        for k in range(around):
            turn = 2 * np.pi * (k + 0.5 * (row % 2)) / around
            out = np.array([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)])
            holes.append(rod(0.6 * out, 1.3 * out, size, sections=16))
    return [((shell - union(holes)).scale((1.0, 1.0, squat)), 0)]


BOOLEANS: dict[str, Kind] = {
    "die": Kind(die, roles=("plastic",)),
    "drilled": Kind(drilled, roles=("any", "metal")),
    "joint": Kind(joint, roles=("metal",)),
    "nut": Kind(nut, roles=("metal",)),
    "lantern": Kind(lantern, upright=True, roles=("ceramic",)),
}
