"""Cloth: draped over a thing, crumpled, folded, hanging, stuffed. Sheets have a thickness and are closed.

Draping is position-based dynamics (Müller et al. 2007): threads keep their lengths, points stay outside of
the thing and above the ground. Positions are rounded to a grid every step, so that a last bit that differs
between two machines cannot grow into another fall of the folds.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from manifold3d import CrossSection, Manifold

from datagen.world.shapes.shape import Kind
from datagen.world.shapes.solids import Noise, Parts, Solid, between, count, rounded_box, sheet, slab, turned

GRID = 41
STEPS = 90
SWEEPS = 5
SNAP = 2.0**-24

Push = Callable[[np.ndarray], np.ndarray]
"""Moves points (..., 3) that lie inside a thing to its surface."""


def _out_of_ball(centre: np.ndarray, radius: float) -> Push:
    def push(points: np.ndarray) -> np.ndarray:
        away = points - centre
        distance = np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), 1e-9)
        return np.where(distance < radius, centre + away / distance * radius, points)

    return push


def _out_of_box(centre: np.ndarray, half: np.ndarray) -> Push:
    def push(points: np.ndarray) -> np.ndarray:
        away = points - centre
        depth = half - np.abs(away)
        inside = (depth > 0).all(axis=-1, keepdims=True)
        nearest = depth == depth.min(axis=-1, keepdims=True)
        moved = np.where(nearest, np.copysign(half, away), away)
        return np.where(inside, centre + moved, points)

    return push


def _out_of_drum(centre: np.ndarray, radius: float, half: float) -> Push:
    def push(points: np.ndarray) -> np.ndarray:
        away = points - centre
        flat = np.maximum(np.linalg.norm(away[..., :2], axis=-1, keepdims=True), 1e-9)
        above, aside = half - np.abs(away[..., 2:]), radius - flat
        lifted = np.concatenate([away[..., :2], np.copysign(half, away[..., 2:])], axis=-1)
        shoved = np.concatenate([away[..., :2] / flat * radius, away[..., 2:]], axis=-1)
        inside = (above > 0) & (aside > 0)
        return np.where(inside, centre + np.where(above < aside, lifted, shoved), points)

    return push


def _fallen(points: np.ndarray, push: Push, ground: float) -> np.ndarray:
    """Sheet (n, n, 3) after it fell from rest over a thing onto the ground."""
    rest = float(np.linalg.norm(points[1, 0] - points[0, 0]))
    velocity = np.zeros_like(points)
    dt = 0.04
    for _ in range(STEPS):
        velocity[..., 2] -= 2.0 * dt
        before, points = points, points + dt * velocity
        for _ in range(SWEEPS):
            for step, length in (
                ((1, 0), 1.0),
                ((0, 1), 1.0),
                ((1, 1), 2**0.5),
                ((1, -1), 2**0.5),
                ((2, 0), 2.0),
                ((0, 2), 2.0),
            ):
                _keep_length(points, step, length * rest, stiff=1.0 if length < 1.1 else 0.35)
            points = push(points)
            points[..., 2] = np.maximum(points[..., 2], ground)
        # What touches the ground sticks to it.
        resting = points[..., 2:] <= ground + 1e-6
        points = np.where(resting & (before[..., 2:] <= ground + 1e-6), before, points)
        points = np.round(points / SNAP) * SNAP
        velocity = 0.96 * (points - before) / dt
    return points


def _keep_length(points: np.ndarray, step: tuple[int, int], rest: float, stiff: float) -> None:
    """Move the ends of all threads of one direction half way each to their rest length, in place."""
    i, j = step
    n, m = points.shape[:2]
    a = points[: n - i, max(0, -j) : m - max(0, j)]
    b = points[i:, max(0, j) : m - max(0, -j)]
    along = b - a
    length = np.maximum(np.sqrt((along * along).sum(axis=-1, keepdims=True)), 1e-9)
    # An over-relaxed Jacobi step of all threads at once would overshoot: a point is the end of two of them.
    move = (0.25 * stiff) * (1.0 - rest / length) * along
    a_move, b_move = move.copy(), -move
    points[: n - i, max(0, -j) : m - max(0, j)] += a_move
    points[i:, max(0, j) : m - max(0, -j)] += b_move


def _square(half: float, turn: float, height: float) -> np.ndarray:
    line = np.linspace(-half, half, GRID)
    x, y = np.meshgrid(line, line, indexing="ij")
    c, s = np.cos(turn), np.sin(turn)
    return np.stack([c * x - s * y, s * x + c * y, np.full_like(x, height)], axis=-1)


def draped(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Cloth over a ball, a block or a drum that shows below it."""
    high, wide = between(p[0], 0.6, 1.1), between(p[1], 0.5, 0.8)
    middle = np.array([0.0, 0.0, 0.5 * high])
    margin = 0.05
    choice = count(p[2], 0, 2)
    solid: Solid
    if choice == 0:
        solid = Manifold.sphere(wide, 64).translate((0.0, 0.0, wide))
        push, top = _out_of_ball(np.array([0.0, 0.0, wide]), wide + margin), 2 * wide
    elif choice == 1:
        half = np.array([wide, wide * rng.uniform(0.6, 1.0), 0.5 * high])
        solid = rounded_box(2 * half, 0.05, middle)
        push, top = _out_of_box(middle, half + margin), high
    else:
        solid = turned(np.array([[wide, 0.0], [wide, high]]), 64)
        push, top = _out_of_drum(middle, wide + margin, 0.5 * high + margin), high
    half_side = between(p[3], 0.9, 1.5)
    cloth = _square(half_side, rng.uniform(0.0, np.pi), top + 0.06)
    cloth[..., 2] += 0.01 * Noise(rng, octaves=2)(cloth.reshape(-1, 3) * 2.0).reshape(GRID, GRID)
    # Pushed once more: evening out draws threads through the edges of a block.
    cloth = push(_smoothed(_fallen(cloth, push, 0.02)))
    return [(solid, 0), (sheet(cloth, 0.02).refine(2), 1)]


def _smoothed(points: np.ndarray) -> np.ndarray:
    """Points with the saw teeth of single threads evened out."""
    inner = points.copy()
    inner[1:-1] = 0.25 * points[:-2] + 0.5 * points[1:-1] + 0.25 * points[2:]
    rows = inner.copy()
    inner[:, 1:-1] = 0.25 * rows[:, :-2] + 0.5 * rows[:, 1:-1] + 0.25 * rows[:, 2:]
    return inner


def rumpled(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Cloth left on the ground: ridges of folds that cross, flat where there are none."""
    noise, swell = Noise(rng, octaves=2, gain=0.5), Noise(rng, octaves=1)
    n = 90
    x, y = np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n), indexing="ij")
    flat = np.column_stack([x.ravel(), y.ravel() * between(p[0], 0.6, 1.0), np.zeros(n * n)])
    height = between(p[1], 0.1, 0.22)
    ridges = np.exp(-((noise(flat * between(p[2], 0.9, 1.5)) / 0.32) ** 2))
    bulges = np.maximum(0.0, swell(flat * 0.9 + 7.3))
    points = flat.copy()
    points[:, 2] = height * ridges * (0.35 + 0.65 * np.tanh(bulges)) + 0.04 * p[3] * bulges
    # Material drawn into a ridge is missing at the rim: the outline wanders.
    points[:, :2] *= 1.0 + 0.05 * swell(flat * 0.8 + 3.1)[:, None]
    return [(sheet(points.reshape(n, n, 3), 0.025), 0)]


def folded(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Towel or blanket folded into a stack of layers, soft at the turns."""
    layers = 2 * count(p[0], 1, 3) + 1
    thick, long = between(p[1], 0.09, 0.16), between(p[2], 1.0, 1.6)
    wide, gap = between(p[3], 0.8, 1.4), 0.18
    line = []
    pitch = thick * (1.0 + gap)
    for k in range(layers):
        sign = 1 if k % 2 == 0 else -1
        line += [(-sign * long / 2, k * pitch), (sign * long / 2, k * pitch)]
        if k + 1 < layers:
            turn = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 9)[1:-1]
            reach = 0.5 * pitch * rng.uniform(0.9, 1.3)
            line += [
                (sign * (long / 2 + reach * np.cos(a)), (k + 0.5 + 0.5 * np.sin(a)) * pitch) for a in turn
            ]
    dot = CrossSection.circle(0.5 * thick, 16)
    strokes = [CrossSection.batch_hull([dot.translate(a), dot.translate(b)]) for a, b in pairwise(line)]
    outline = strokes[0]
    for stroke in strokes[1:]:
        outline += stroke
    noise = Noise(rng, octaves=2, gain=0.4)
    solid = outline.extrude(wide).rotate((90.0, 0.0, 0.0)).refine_to_length(0.06)

    def soften(points: np.ndarray) -> np.ndarray:
        # Layers sag and shift a little together: smooth in space, so they never cross.
        sag = 0.06 * thick * noise(points * 1.3) * np.minimum(points[:, 2] / thick + 0.5, 3.0)
        return points + np.column_stack([0.5 * sag, 0.5 * noise(points * 0.9 + 3.0) * 0.08 * thick, sag])

    return [(solid.warp_batch(soften), 0)]


def curtain(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Hanging cloth in folds that open towards the hem, on a rod."""
    folds, wide = count(p[0], 4, 9), between(p[1], 0.6, 1.2)
    deep = between(p[2], 0.05, 0.1)
    n, m = 140, 40
    u, v = np.meshgrid(np.linspace(0.0, 1.0, n), np.linspace(0.0, 1.0, m), indexing="ij")
    wander = Noise(rng, octaves=2, gain=0.4)
    sway = wander(np.column_stack([(u * 2.5).ravel(), (v * 0.8).ravel(), np.zeros(n * m)])).reshape(n, m)
    phase = 2 * np.pi * folds * u + 0.7 * sway * v
    amplitude = deep * (0.65 + 0.5 * v + 0.25 * p[3] * sway * v)
    points = np.stack([wide * (2 * u - 1) + 0.02 * sway * v, amplitude * np.sin(phase), 2.0 * (1.0 - v)], -1)
    bar = Manifold.cylinder(2 * wide + 0.3, 0.035, circular_segments=24).rotate((0.0, 90.0, 0.0))
    return [(sheet(points, 0.018), 0), (bar.translate((-wide - 0.15, 0.0, 2.03)), 1)]


def cushion(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Stuffed pillow: thick in the middle, pinched along its seam, dented."""
    noise = Noise(rng, octaves=3, gain=0.45)
    stuffing, narrow = between(p[0], 0.25, 0.42), between(p[1], 0.65, 1.0)
    n = 56
    x, y = np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n), indexing="ij")
    pinch = between(p[2], 0.06, 0.16)
    outline = 1.0 - pinch * (1.0 - np.stack([y, x], -1) ** 2)
    flat = np.stack([x, y], -1) * outline * (1.0, narrow)
    full = ((1 - x**2) * (1 - y**2)) ** between(p[3], 0.35, 0.55)
    spots = np.column_stack([flat.reshape(-1, 2), np.zeros(n * n)])
    wrinkle = 0.05 * noise(spots * 1.8).reshape(n, n) * full
    height = stuffing * full + 0.01
    top = np.concatenate([flat, (height + wrinkle)[..., None]], -1)
    low = np.concatenate([flat, (-height + 0.5 * wrinkle)[..., None]], -1)
    return [(slab(top, low), 0)]


CLOTH: dict[str, Kind] = {
    "draped": Kind(draped, upright=True, roles=("wood", "fabric")),
    "rumpled": Kind(rumpled, upright=True, roles=("fabric",)),
    "folded": Kind(folded, upright=True, roles=("fabric",)),
    "curtain": Kind(curtain, upright=True, roles=("fabric", "metal")),
    "cushion": Kind(cushion, roles=("fabric",)),
}
