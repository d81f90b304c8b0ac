"""Thin structures: grilles, baskets, loops of wire, cages, chains."""

from __future__ import annotations

import numpy as np

from datagen.world.shapes.shape import Kind
from datagen.world.shapes.solids import Parts, between, count, post, rod, tube, union


def _ring(radius: float, height: float, wire: float, n: int = 64):
    angle = np.arange(n) * 2 * np.pi / n
    ring = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(n, height)])
    return tube(ring, wire, sections=8, loop=True)


def grille(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Standing frame of flat bar with round rods across, straight or crossed; two feet."""
    wide, high = between(p[0], 1.0, 2.2), between(p[1], 1.2, 2.0)
    bar, rods = 0.07, count(p[2], 5, 12)
    section = (bar, bar)
    corners = [(-wide / 2, 0.0, 0.0), (wide / 2, 0.0, 0.0), (wide / 2, 0.0, high), (-wide / 2, 0.0, high)]
    parts = [post(corners[0], corners[3], section), post(corners[1], corners[2], section)]
    for z in (0.12, high):
        parts.append(post((-wide / 2, 0, z - bar / 2), (-wide / 2, 0, z + bar / 2), section))
        beam = post((0, 0, z - bar / 2), (0, 0, z + bar / 2), (wide + bar, bar))
        parts.append(beam)
    wire = between(p[3], 0.015, 0.03)
    for k in range(1, rods):
        x = wide * (k / rods - 0.5)
        parts.append(rod((x, 0, 0.12), (x, 0, high), wire))
    if rng.random() < 0.6:
        for k in range(1, rods):
            z = 0.12 + (high - 0.12) * k / rods
            parts.append(rod((-wide / 2, wire, z), (wide / 2, wire, z), wire))
    for x in (-wide / 2, wide / 2):
        parts.append(post((x, 0, 0), (x, 0, bar), (bar, 0.6)))
    return [(union(parts), 0)]


def basket(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Wire basket: ribs that run from a floor of rings over a curved side to a thick rim."""
    ribs, hoops = count(p[0], 14, 26), count(p[1], 3, 6)
    low, high = between(p[2], 0.5, 0.85), between(p[3], 0.6, 1.3)
    wire = 0.018 + 0.012 * rng.random()

    def radius(t: np.ndarray | float) -> np.ndarray | float:
        return low + (1.0 - low) * np.asarray(t) ** 0.7

    parts = []
    for k in range(ribs):
        angle = 2 * np.pi * k / ribs
        t = np.linspace(0.0, 1.0, 12)
        out = np.concatenate([[0.0], np.asarray(radius(t))])
        z = np.concatenate([[0.0], high * t])
        path = np.column_stack([out * np.cos(angle), out * np.sin(angle), z])
        parts.append(tube(path, wire, sections=6))
    for t in np.linspace(0.0, 1.0, hoops + 1)[:-1]:
        parts.append(_ring(float(radius(t)) + 0.5 * wire, high * float(t), wire))
    parts += [_ring(low * share, 0.0, wire, 40) for share in (0.33, 0.66)]
    parts.append(_ring(1.0, high, 2.2 * wire))
    return [(union(parts), 0)]


def loops(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """One wire bent to a closed curve of a few waves in space."""
    angle = np.arange(360) * 2 * np.pi / 360
    orders = np.arange(1, count(p[0], 3, 5) + 1)
    size = rng.normal(size=(3, len(orders), 2)) / orders[:, None] ** between(p[1], 0.6, 1.4)
    waves = np.stack([np.cos(orders[:, None] * angle), np.sin(orders[:, None] * angle)], axis=1)
    path = np.einsum("dkc,kcn->nd", size, waves)
    path /= np.linalg.norm(path, axis=1).max()
    path[:, 2] *= between(p[2], 0.5, 1.0)
    # The points lie evenly along the wire, so that slow stretches of the curve do not bunch its rings.
    closed = np.concatenate([path, path[:1]])
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    even = np.arange(360) * length[-1] / 360
    path = np.column_stack([np.interp(even, length, closed[:, k]) for k in range(3)])
    return [(tube(path, between(p[3], 0.02, 0.045), sections=10, loop=True), 0)]


def cage(p: np.ndarray, _rng: np.random.Generator) -> Parts:
    """Bird cage: vertical wires that close in a dome, hoops, a floor and a ring on top."""
    wires, high = count(p[0], 16, 28), between(p[1], 0.7, 1.6)
    wire, hoops = between(p[2], 0.014, 0.025), count(p[3], 2, 4)
    angle = np.linspace(0.0, np.pi / 2, 14)
    out = np.concatenate([[1.0], np.cos(angle) + 0.02])
    z = np.concatenate([[0.0], high + 0.8 * np.sin(angle)])
    parts = []
    for k in range(wires):
        turn = 2 * np.pi * k / wires
        parts.append(tube(np.column_stack([out * np.cos(turn), out * np.sin(turn), z]), wire, sections=6))
    parts += [_ring(1.0, high * k / hoops, 1.4 * wire) for k in range(1, hoops + 1)]
    hook = np.arange(32) * 2 * np.pi / 32
    ring = np.column_stack([0.14 * np.cos(hook), 0 * hook, high + 0.92 + 0.14 * np.sin(hook)])
    parts.append(tube(ring, 0.03, sections=8, loop=True))
    base = post((0, 0, -0.1), (0, 0, 0.0), (0.1, 0.1))
    rim = rod((0, 0, -0.1), (0, 0, 0.02), 1.06, sections=64)
    return [(union(parts), 0), (rim + base, 1)]


def chain(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Links of chain laid along a curve on the ground, tilted one way and the other in turn."""
    links, wire = count(p[0], 7, 13), between(p[1], 0.1, 0.16)
    long, wide = between(p[2], 0.75, 1.0), 0.26 + wire
    turn = np.arange(48) * 2 * np.pi / 48
    straight = np.clip(1.6 * np.cos(turn), -1.0, 1.0)
    x = straight * (long - wide) / 2 + wide * np.cos(turn) * 0.5
    link = np.column_stack([x * 1.15, wide * np.sin(turn) * 0.72, 0 * turn])
    heading = np.cumsum(rng.normal(0.0, 0.12 + 0.25 * p[3], links))
    step = 2.0 * link[:, 0].max() - 3.0 * wire
    ahead = np.column_stack([np.cos(heading), np.sin(heading)])
    at = np.concatenate([[[0.0, 0.0]], np.cumsum(0.5 * step * (ahead[1:] + ahead[:-1]), axis=0)])
    solids = []
    for k in range(links):
        tilt = np.radians(40.0 if k % 2 else -40.0)
        c, s = ahead[k]
        y, z = link[:, 1] * np.cos(tilt), link[:, 1] * np.sin(tilt)
        path = np.column_stack([at[k, 0] + c * link[:, 0] - s * y, at[k, 1] + s * link[:, 0] + c * y, z])
        solids.append(tube(path, wire, sections=14, loop=True))
    return [(union(solids), 0)]


WIRES: dict[str, Kind] = {
    "grille": Kind(grille, upright=True, roles=("metal",)),
    "basket": Kind(basket, upright=True, roles=("metal",)),
    "loops": Kind(loops, roles=("metal",)),
    "cage": Kind(cage, upright=True, roles=("metal", "wood")),
    "chain": Kind(chain, upright=True, roles=("metal",)),
}
