"""Books and boxes of board: a book, a pile of them, a parcel, an open carton."""

from __future__ import annotations

import numpy as np
from manifold3d import CrossSection, Manifold

from datagen.shapes.shape import Kind
from datagen.shapes.solids import Parts, between, count, post, rounded_box, union


def _bound(wide: float, high: float, thick: float, board: float) -> tuple[Manifold, Manifold]:
    """Cover and pages of a book that lies on its back cover: spine at x = 0, pages towards +x."""
    spine = 0.5 * thick
    arc = np.linspace(0.5 * np.pi, 1.5 * np.pi, 17)
    bulge = 0.25 * thick
    outer = np.column_stack([bulge * np.cos(arc), spine + spine * np.sin(arc)])
    inner = np.column_stack([bulge * np.cos(arc), spine + (spine - board) * np.sin(arc)])[::-1]
    inner[:, 0] = inner[:, 0] * (bulge - board) / bulge
    profile = np.concatenate(
        [[(wide, thick)], outer, [(wide, 0.0), (wide, board)], inner, [(wide, thick - board)]]
    )
    cover = CrossSection([profile]).extrude(high).rotate((90.0, 0.0, 0.0))
    margin = 0.03 * high
    hollow = 0.12 * thick
    half = 0.5 * (thick - 2 * board) * 0.995
    arc = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 13)
    fore = np.column_stack([wide - margin - hollow * np.cos(arc), spine + half * np.sin(arc)])
    block = np.concatenate([[(0.02 * wide, spine + half), (0.02 * wide, spine - half)], fore])
    pages = CrossSection([block]).extrude(high - 2 * margin).rotate((90.0, 0.0, 0.0))
    return cover, pages.translate((0.0, -margin, 0.0))


def _centred(solids: tuple[Manifold, Manifold], wide: float, high: float) -> list[Manifold]:
    return [solid.translate((-0.5 * wide, 0.5 * high, 0.0)) for solid in solids]


def book(p: np.ndarray, _rng: np.random.Generator) -> Parts:
    """Hardback that lies flat: cover with a round spine, block of pages hollowed at the fore edge."""
    wide, thick = between(p[0], 0.6, 0.8), between(p[1], 0.1, 0.35)
    cover, pages = _centred(_bound(wide, 1.0, thick, between(p[2], 0.012, 0.022)), wide, 1.0)
    return [(cover, 0), (pages, 1)]


def books(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Pile of books, the largest below, each turned a little; three covers, one paper."""
    number = count(p[0], 3, 6)
    parts: Parts = []
    z = 0.0
    for k in range(number):
        high = (1.0 - 0.06 * k) * rng.uniform(0.88, 1.0)
        wide, thick = high * between(p[1], 0.62, 0.78), rng.uniform(0.08, 0.26)
        solids = _centred(_bound(wide, high, thick, 0.016), wide, high)
        angle = float(rng.normal(0.0, 4.0 + 20.0 * p[2])) + 180.0 * int(rng.integers(2))
        x, y = rng.uniform(-0.06, 0.06, 2)
        cover, pages = (solid.rotate((0.0, 0.0, angle)).translate((x, y, z)) for solid in solids)
        parts += [(cover, k % 3), (pages, 3)]
        z += thick
    return parts


def parcel(p: np.ndarray, _rng: np.random.Generator) -> Parts:
    """Closed box of board with a string or tape around it."""
    sides = np.array([1.0, between(p[0], 0.6, 1.0), between(p[1], 0.35, 0.9)])
    box = rounded_box(sides, 0.025, (0.0, 0.0, 0.5 * sides[2]))
    tape, proud = between(p[2], 0.05, 0.16), 0.006
    x, y, z = sides + 2 * proud
    bands = [rounded_box((tape, y, z), 0.02, (0.0, 0.0, 0.5 * sides[2]))]
    if p[3] > 0.4:
        bands.append(rounded_box((x, tape, z), 0.02, (0.0, 0.0, 0.5 * sides[2])))
    return [(box, 0), (union(bands) - box, 1)]


def carton(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Open box of board, its four flaps folded outwards at different angles."""
    x, y, z = 0.5, 0.5 * between(p[0], 0.6, 1.0), between(p[1], 0.45, 0.9)
    board = 0.02
    outer = Manifold.cube((2 * x, 2 * y, z), False).translate((-x, -y, 0.0))
    inner = Manifold.cube((2 * (x - board), 2 * (y - board), z), False).translate(
        (board - x, board - y, board)
    )
    parts = [outer - inner]
    for side, (reach, wide) in enumerate(((x, y), (y, x), (x, y), (y, x))):
        tilt = np.radians(rng.uniform(-50.0, 60.0) if p[2] < 0.5 else rng.uniform(5.0, 60.0))
        long = reach * between(p[3], 0.5, 0.9)
        # Local axes: x outwards, y along the edge, z up.
        tip = (reach + long * np.cos(tilt), 0.0, z - long * np.sin(tilt))
        flap = post((reach - 0.5 * board, 0.0, z - board), tip, (board, 1.94 * wide), (board, 1.8 * wide))
        parts.append(flap.rotate((0.0, 0.0, 90.0 * side)))
    return [(union(parts), 0)]


BOOKS: dict[str, Kind] = {
    "book": Kind(book, upright=True, roles=("leather", "paper")),
    "books": Kind(books, upright=True, roles=("leather", "fabric", "plastic", "paper")),
    "parcel": Kind(parcel, upright=True, roles=("paper", "plastic")),
    "carton": Kind(carton, upright=True, roles=("paper",)),
}
