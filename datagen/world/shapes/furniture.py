"""Furniture in metres, books and boxes of board: compounds of parts in the proportions of real things."""

from __future__ import annotations

from itertools import product

import numpy as np
from manifold3d import CrossSection, Manifold

from datagen.world.shapes.lathes import turned_leg
from datagen.world.shapes.shape import Kind
from datagen.world.shapes.solids import (
    Parts,
    between,
    count,
    post,
    rod,
    rounded_box,
    smooth_profile,
    tube,
    turned,
    union,
)

SIGNS = list(product((-1.0, 1.0), repeat=2))


def _legs(
    half_x: float, half_y: float, height: float, width: float, splay: float, style: int
) -> list[Manifold]:
    """Four legs from the ground to ``height``: square and tapering, round and splayed, or turned."""
    legs = []
    for sx, sy in SIGNS:
        top = np.array([sx * half_x, sy * half_y, height])
        foot = np.array([sx * (half_x + splay), sy * (half_y + splay), 0.0])
        if style == 0:
            legs.append(post(foot, top, (0.7 * width, 0.7 * width), (width, width)))
        elif style == 1:
            legs.append(rod(foot, top, 0.32 * width, 0.5 * width, sections=20))
        else:
            x, y = top[:2]
            legs.append(turned_leg(height, 0.6 * width).translate((float(x), float(y), 0.0)))
    return legs


def _rails(half_x: float, half_y: float, z: float, section: tuple[float, float]) -> list[Manifold]:
    """Four rails between the legs; section is (thickness, height)."""
    thick, high = section
    rails = [rounded_box((2 * half_x, thick, high), 0.004, (0.0, s * half_y, z)) for s in (-1, 1)]
    return rails + [rounded_box((thick, 2 * half_y, high), 0.004, (s * half_x, 0.0, z)) for s in (-1, 1)]


def chair(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Chair with a slatted, barred or upholstered back; the seat is a slot of its own."""
    wide, deep, seat = between(p[0], 0.38, 0.5), between(p[1], 0.38, 0.48), 0.45
    back, lean = between(p[2], 0.38, 0.6), between(p[3], 0.03, 0.12)
    x, y, leg = 0.5 * wide - 0.025, 0.5 * deep - 0.025, 0.04
    frame = _legs(x, y, seat, leg, 0.0 if rng.random() < 0.5 else 0.03, int(rng.integers(2)))
    frame += _rails(x, y, seat - 0.05, (0.02, 0.05))
    if rng.random() < 0.5:
        frame += [rod((-x, s * y, 0.2), (x, s * y, 0.2), 0.011) for s in (-1, 1)]
    posts = [((sx * x, y, seat - 0.05), (sx * x, y + lean, seat + back)) for sx in (-1, 1)]
    frame += [post(a, b, (0.036, 0.036), (0.03, 0.026)) for a, b in posts]
    style = int(rng.integers(3))
    top = (0.0, y + lean, seat + back - 0.03)
    frame.append(rounded_box((wide, 0.025, 0.075), 0.011, top))
    if style == 0:
        for k in range(2, 4):
            share = k / 4 - 0.15
            frame.append(
                rounded_box((wide - 0.05, 0.018, 0.05), 0.008, (0.0, y + share * lean, seat + share * back))
            )
    elif style == 1:
        for s in np.linspace(-0.7, 0.7, 5):
            frame.append(rod((s * x, y, seat - 0.01), (s * x, y + lean, seat + back - 0.03), 0.009))
    if style == 2:
        pad = rounded_box((wide - 0.06, 0.05, back - 0.14), 0.024)
        tilt = -float(np.degrees(np.arctan2(lean, back)))
        pad = pad.rotate((tilt, 0.0, 0.0)).translate((0.0, y + 0.5 * lean - 0.01, seat + 0.5 * back))
        cushion = [rounded_box((wide, deep, 0.07), 0.03, (0.0, 0.0, seat + 0.02)), pad]
        return [(union(frame), 0), (union(cushion), 1)]
    return [(union(frame), 0), (rounded_box((wide + 0.02, deep + 0.02, 0.03), 0.012, (0, -0.005, seat)), 1)]


def stool(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Stool with a round seat on three or four splayed legs, and a ring or rungs between them."""
    high, radius = between(p[0], 0.42, 0.75), between(p[1], 0.15, 0.2)
    number = 3 + int(rng.integers(2))
    splay, thick = between(p[2], 0.02, 0.09), between(p[3], 0.03, 0.06)
    edge = np.array([[radius - 0.01, 0.0], [radius, 0.01], [radius, thick - 0.01], [radius - 0.012, thick]])
    seat = turned(edge, 48).translate((0.0, 0.0, high - thick))
    parts, rung = [], []
    for k in range(number):
        out = np.array([np.cos(2 * np.pi * k / number), np.sin(2 * np.pi * k / number), 0.0])
        top, foot = 0.68 * radius * out + (0, 0, high - 0.5 * thick), (0.75 * radius + splay) * out
        parts.append(rod(foot, top, 0.014, 0.02, sections=16))
        rung.append(foot + 0.35 * (top - foot))
    if rng.random() < 0.5:
        parts += [rod(a, b, 0.009) for a, b in zip(rung, rung[1:] + rung[:1])]
    else:
        angle = np.arange(48) * 2 * np.pi / 48
        reach = float(np.hypot(rung[0][0], rung[0][1]))
        ring = np.column_stack([reach * np.cos(angle), reach * np.sin(angle), np.full(48, rung[0][2])])
        parts.append(tube(ring, 0.009, loop=True))
    return [(union(parts), 0), (seat, 1)]


def table(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Table with an apron, legs square, round or turned, and a top of its own material."""
    wide, deep, high = between(p[0], 0.7, 1.6), between(p[1], 0.55, 0.9), between(p[2], 0.42, 0.76)
    thick, leg = between(p[3], 0.02, 0.045), 0.06
    x, y = 0.5 * wide - 0.07, 0.5 * deep - 0.07
    style = int(rng.integers(3))
    frame = _legs(x, y, high - thick, leg, 0.04 if style == 1 else 0.0, style)
    frame += _rails(x, y, high - thick - 0.045, (0.022, 0.09))
    top = rounded_box((wide, deep, thick), 0.008, (0.0, 0.0, high - 0.5 * thick))
    return [(union(frame), 0), (top, 1)]


def bench(p: np.ndarray, _rng: np.random.Generator) -> Parts:
    """Garden bench of slats on two frames, with or without a back."""
    long, deep = between(p[0], 1.0, 1.8), between(p[1], 0.36, 0.46)
    slats = count(p[2], 3, 5)
    high, back = 0.44, p[3] > 0.4
    frame, wood = [], []
    for s in (-1.0, 1.0):
        x = s * (0.5 * long - 0.12)
        frame += [
            post((x, t * 0.45 * deep * 1.1, 0.0), (x, t * 0.45 * deep, high), (0.05, 0.045)) for t in (-1, 1)
        ]
        frame.append(rounded_box((0.05, 0.95 * deep, 0.05), 0.008, (x, 0.0, high - 0.025)))
        if back:
            frame.append(
                post((x, 0.45 * deep, high - 0.05), (x, 0.45 * deep + 0.12, high + 0.4), (0.05, 0.045))
            )
    pitch = deep / slats
    for k in range(slats):
        y = (k + 0.5) * pitch - 0.5 * deep
        wood.append(rounded_box((long, 0.82 * pitch, 0.03), 0.008, (0.0, y, high + 0.015)))
    for k in range(3 if back else 0):
        share = 0.3 + 0.3 * k
        y, z = 0.45 * deep + 0.12 * share - 0.035, high + 0.42 * share
        slat = rounded_box((long, 0.022, 0.08), 0.008).rotate((-15.0, 0.0, 0.0))
        wood.append(slat.translate((0.0, y, z)))
    return [(union(frame), 0), (union(wood), 1)]


def shelf(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Standing shelf with books, jars and boxes on its boards."""
    wide, high, deep = between(p[0], 0.6, 1.0), between(p[1], 0.9, 1.8), between(p[2], 0.24, 0.34)
    boards, thick = count(p[3], 3, 5), 0.022
    frame = [rounded_box((thick, deep, high), 0.003, (s * 0.5 * wide, 0.0, 0.5 * high)) for s in (-1, 1)]
    frame.append(rounded_box((wide, 0.012, high - 0.05), 0.003, (0.0, 0.5 * deep - 0.01, 0.5 * high)))
    levels = np.linspace(0.06, high - 0.5 * thick, boards)
    frame += [rounded_box((wide, deep, thick), 0.003, (0.0, 0.0, float(z))) for z in levels]
    goods: list[list[Manifold]] = [[], [], []]
    room = float(levels[1] - levels[0]) - thick
    for z in levels[:-1]:
        x = -0.5 * wide + 0.03
        while x < 0.5 * wide - 0.14:
            floor = float(z) + 0.5 * thick
            what = rng.random()
            slot = int(rng.integers(2))
            if what < 0.65:
                fat, tall = rng.uniform(0.018, 0.055), room * rng.uniform(0.6, 0.92)
                out = deep * rng.uniform(0.55, 0.75)
                at = (x + 0.5 * fat, 0.42 * deep - 0.5 * out, floor + 0.5 * tall)
                goods[slot].append(rounded_box((fat * 0.97, out, tall), 0.003, at))
                x += fat
            elif what < 0.85:
                radius, tall = rng.uniform(0.04, 0.06), room * rng.uniform(0.3, 0.75)
                pot = smooth_profile(
                    np.array([0, 0.1, 0.5, 0.9, 1]) * tall, radius * np.array([0.7, 0.85, 1, 0.6, 0.65])
                )
                goods[2].append(turned(pot, 32).translate((x + radius + 0.005, 0.0, floor)))
                x += 2 * radius + 0.02
            else:
                x += rng.uniform(0.03, 0.12)
    parts: Parts = [(union(frame), 0)]
    return parts + [(union(group), slot) for slot, group in enumerate(goods, start=1) if group]


def desk_lamp(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Lamp on two arms with a joint, a heavy foot and an open shade."""
    lower, upper = between(p[0], 0.3, 0.45), between(p[1], 0.25, 0.4)
    first, second = np.radians(between(p[2], 60.0, 85.0)), np.radians(between(p[3], 15.0, 55.0))
    foot = turned(smooth_profile([0.0, 0.012, 0.03, 0.036], [0.1, 0.1, 0.08, 0.02], 24), 48)
    knee = np.array([-lower * np.cos(first), 0.0, 0.03 + lower * np.sin(first)])
    head = knee + upper * np.array([np.cos(second), 0.0, np.sin(second)])
    aside = np.array([0.0, 0.012, 0.0])
    base = np.array([0.0, 0.0, 0.035])
    arms = [
        rod(a + s * aside, b + s * aside, 0.006) for a, b in ((base, knee), (knee, head)) for s in (-1, 1)
    ]
    pins = [rod(at - 2 * aside, at + 2 * aside, 0.016, sections=20) for at in (base, knee, head)]
    radius, deep = rng.uniform(0.07, 0.1), rng.uniform(0.1, 0.15)
    t = np.linspace(0.0, 1.0, 20)
    profile = np.column_stack([0.025 + (radius - 0.025) * t**0.6, deep * t])
    shade = _shade(profile)
    tilt = float(rng.uniform(120.0, 160.0))
    place = (float(head[0]), 0.0, float(head[2]))
    bulb = Manifold.sphere(0.028, 32).translate((0.0, 0.0, 0.55 * deep)) + rod(
        (0, 0, 0), (0, 0, 0.5 * deep), 0.014
    )
    return [
        (union([foot, *arms, *pins]), 0),
        (shade.rotate((0.0, tilt, 0.0)).translate(place), 1),
        (bulb.rotate((0.0, tilt, 0.0)).translate(place), 2),
    ]


def _shade(profile: np.ndarray) -> Manifold:
    wall = 0.003
    inside = profile - (wall, 0.0)
    ring = turned(profile, 48) - turned(inside, 48).translate((0.0, 0.0, wall))
    return ring


def floor_lamp(p: np.ndarray, _rng: np.random.Generator) -> Parts:
    """Standing lamp with a shade of cloth, open above and below."""
    high, radius = between(p[0], 1.2, 1.6), between(p[1], 0.17, 0.26)
    tall, narrow = between(p[2], 0.22, 0.34), between(p[3], 0.55, 0.95)
    foot = turned(smooth_profile([0.0, 0.015, 0.03, 0.04], [0.15, 0.15, 0.1, 0.02], 24), 48)
    stand = [foot, rod((0, 0, 0.02), (0, 0, high - 0.5 * tall), 0.012, sections=16)]
    for k in range(3):
        turn = 2 * np.pi * k / 3
        end = (
            radius * (1 + narrow) / 2 * np.cos(turn),
            radius * (1 + narrow) / 2 * np.sin(turn),
            high - 0.5 * tall,
        )
        stand.append(rod((0, 0, high - 0.5 * tall), end, 0.004, sections=8))
    cone = Manifold.cylinder(tall, radius, narrow * radius, circular_segments=64)
    inner = Manifold.cylinder(tall + 0.02, radius - 0.006, narrow * radius - 0.006, circular_segments=64)
    shade = (cone - inner.translate((0, 0, -0.01))).translate((0, 0, high - tall))
    bulb = Manifold.sphere(0.045, 32).translate((0, 0, high - 0.4 * tall))
    return [(union(stand), 0), (shade, 1), (bulb, 2)]


def crate(p: np.ndarray, _rng: np.random.Generator) -> Parts:
    """Open crate of boards with gaps between, nailed to corner posts."""
    x, y, z = 0.5, 0.5 * between(p[0], 0.6, 1.0), between(p[1], 0.4, 0.8)
    boards, gap = count(p[2], 3, 5), between(p[3], 0.12, 0.3)
    thick = 0.028
    solids = [
        post((sx * (x - 0.04), sy * (y - 0.04), 0.0), (sx * (x - 0.04), sy * (y - 0.04), z), (0.06, 0.06))
        for sx, sy in SIGNS
    ]
    pitch = z / boards
    for k in range(boards):
        at, tall = (k + 0.5) * pitch, (1 - gap) * pitch
        for s in (-1.0, 1.0):
            solids.append(
                rounded_box((2 * x + 2 * thick, thick, tall), 0.005, (0.0, s * (y + 0.4 * thick), at))
            )
            solids.append(rounded_box((thick, 2 * y, tall), 0.005, (s * (x + 0.4 * thick), 0.0, at)))
    floor = count(p[2], 4, 6)
    for k in range(floor):
        at = (2 * (k + 0.5) / floor - 1) * x
        solids.append(rounded_box((2 * x / floor * 0.88, 2 * y, thick), 0.005, (at, 0.0, 0.05)))
    return [(union(solids), 0)]


def sofa(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Upholstered seat for one to three, with arms, cushions and short legs."""
    places = count(p[0], 1, 3)
    seat, deep = between(p[1], 0.52, 0.64), between(p[2], 0.72, 0.86)
    arm, back = between(p[3], 0.1, 0.2), between(rng.random(), 0.68, 0.86)
    wide = places * seat
    body = [rounded_box((wide, deep, 0.2), 0.03, (0.0, 0.0, 0.2))]
    body.append(
        rounded_box((wide + 2 * arm, 0.18, back - 0.1), 0.07, (0.0, 0.5 * deep - 0.07, 0.5 * back + 0.05))
    )
    arms = [rounded_box((arm, deep, 0.5), 0.05, (s * 0.5 * (wide + arm), 0.0, 0.35)) for s in (-1, 1)]
    pads = []
    for k in range(places):
        x = (k + 0.5) * seat - 0.5 * wide
        pads.append(rounded_box((seat - 0.012, deep - 0.2, 0.15), 0.055, (x, -0.07, 0.365)))
        rest = rounded_box((seat - 0.02, 0.16, back - 0.4), 0.065).rotate((-10.0, 0.0, 0.0))
        pads.append(rest.translate((x, 0.5 * deep - 0.2, 0.5 * back + 0.2)))
    x, y = 0.5 * wide + 0.3 * arm, 0.5 * deep - 0.07
    legs = [rod((sx * x, sy * y, 0.0), (sx * x, sy * y, 0.12), 0.018, 0.025) for sx, sy in SIGNS]
    return [(union(body + arms), 0), (union(pads), 1), (union(legs), 2)]


def cabinet(p: np.ndarray, rng: np.random.Generator) -> Parts:
    """Chest of drawers or doors on a plinth, with handles."""
    wide, high, deep = between(p[0], 0.6, 1.2), between(p[1], 0.6, 1.1), between(p[2], 0.36, 0.5)
    rows, columns = count(p[3], 2, 4), 1 + int(rng.integers(2))
    body = rounded_box((wide, deep, high - 0.08), 0.006, (0.0, 0.0, 0.5 * high + 0.04))
    body += rounded_box((wide - 0.06, deep - 0.06, 0.12), 0.004, (0.0, 0.0, 0.06))
    body += rounded_box((wide + 0.04, deep + 0.03, 0.03), 0.008, (0.0, 0.0, high))
    fronts, handles = [], []
    tall, broad = (high - 0.16) / rows, (wide - 0.04) / columns
    for i, j in product(range(rows), range(columns)):
        x, z = (j + 0.5) * broad - 0.5 * (wide - 0.04), 0.12 + (i + 0.5) * tall
        fronts.append(rounded_box((broad - 0.012, 0.03, tall - 0.012), 0.006, (x, -0.5 * deep - 0.008, z)))
        grip = 0.22 * broad
        y = -0.5 * deep - 0.05
        handles.append(rod((x - grip, y, z), (x + grip, y, z), 0.007))
        handles += [
            rod((x + s * grip * 0.9, y, z), (x + s * grip * 0.9, y + 0.04, z), 0.006) for s in (-1, 1)
        ]
    return [(body, 0), (union(fronts), 1), (union(handles), 2)]


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


FURNITURE: dict[str, Kind] = {
    "chair": Kind(chair, upright=True, roles=("wood", "fabric")),
    "stool": Kind(stool, upright=True, roles=("metal", "wood")),
    "table": Kind(table, upright=True, roles=("wood", "wood")),
    "bench": Kind(bench, upright=True, roles=("metal", "wood")),
    "shelf": Kind(shelf, upright=True, roles=("wood", "paper", "leather", "ceramic")),
    "desk_lamp": Kind(desk_lamp, upright=True, roles=("metal", "plastic", "ceramic")),
    "floor_lamp": Kind(floor_lamp, upright=True, roles=("metal", "fabric", "ceramic")),
    "crate": Kind(crate, upright=True, roles=("wood",)),
    "sofa": Kind(sofa, upright=True, roles=("fabric", "fabric", "wood")),
    "cabinet": Kind(cabinet, upright=True, roles=("wood", "wood", "metal")),
    "book": Kind(book, upright=True, roles=("leather", "paper")),
    "books": Kind(books, upright=True, roles=("leather", "fabric", "plastic", "paper")),
    "parcel": Kind(parcel, upright=True, roles=("paper", "plastic")),
    "carton": Kind(carton, upright=True, roles=("paper",)),
}
