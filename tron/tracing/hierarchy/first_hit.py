"""Stochastic first hits: one surfel a ray, met with exactly the weight that compositing gives it.

A surfel stops a ray with probability alpha, whatever the others do, and the nearest that does is found. So
surfel i is found with the probability that it stops the ray and none before it does,

    P(i) = alpha_i prod_{j < i} (1 - alpha_j) = T_i alpha_i,

which is its weight in front-to-back compositing: the value of the surfel that is found is an unbiased
estimate of the composited value (stochastic transparency: Enderton et al. 2010). Nothing is sorted, no list
is kept, and what lies behind a stop is culled. Sides count as they do for shadow rays
(:mod:`tron.tracing.hierarchy.transmittance`), so a ray meets nothing with its transmittance's probability.

Whether a surfel stops a ray is decided by a hash of the ray's seed and of the surfel's place in the scene:
in which order a walk meets surfels, and how a hierarchy sorts them, changes nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from tron.tracing.hierarchy.bvh import Bvh
from tron.tracing.hierarchy.transmittance import BackFaces, Fans, Products, blocks, multiply, remaining
from tron.tracing.hierarchy.traversal import Descent, State, any_of, look, search, slopes_of, walk
from tron.tracing.kernel import intersect, recorded

NOTHING = 0xFFFFFFFF
"""In place of a surfel where a ray meets none."""
_NO_FAN = 0xFFFFFFFF


@dataclass
class FirstHit:
    """The surfel that stops each ray, one lane a ray.

    Attributes:
        surfel: mi.UInt32, in the scene's order; ``NOTHING`` where there is none.
        front: mi.Bool, the ray meets the side that its normal points to.
        distance: mi.Float, along the unit ray, world units; infinity where there is none.
    """

    surfel: mi.UInt32
    front: mi.Bool
    distance: mi.Float


def hashed(word: mi.UInt32) -> mi.UInt32:
    """A permutation of all words that looks random (``lowbias32``, Wellons 2018)."""
    word = (word ^ (word >> 16)) * mi.UInt32(0x7FEB352D)
    word = (word ^ (word >> 15)) * mi.UInt32(0x846CA68B)
    return word ^ (word >> 16)


def ray_seeds(root: mi.UInt32, lane: mi.UInt32, ray: mi.UInt32) -> mi.UInt32:
    """Seeds for :func:`first_hits`: of ray ``ray`` of ``lane``, below ``root`` of :mod:`tron.seeds`.

    All three opaque, or kernels are compiled for each.
    """
    return hashed(hashed(hashed(root) + lane) + ray)


@dataclass
class Stops:
    """The nearest stop so far of each ray of a fan.

    Attributes:
        nearest, farthest: as walks have them; farthest is where the ray is stopped.
        surfel: in the scene's order, or ``NOTHING``. front: which side. seed: the ray's.
    """

    nearest: list[mi.Float]
    farthest: list[mi.Float]
    surfel: list[mi.UInt32]
    front: list[mi.Bool]
    seed: list[mi.UInt32]

    @staticmethod
    def none(active: Sequence[mi.Bool], seeds: Sequence[mi.UInt32]) -> Stops:
        """Nothing met yet, by the rays that are traced."""
        return Stops(
            nearest=[mi.Float(0) for _ in active],
            farthest=[dr.select(mi.Bool(lanes), mi.Float(dr.inf), -dr.inf) for lanes in active],
            surfel=[mi.UInt32(NOTHING) for _ in active],
            front=[mi.Bool(False) for _ in active],
            seed=[mi.UInt32(seed) for seed in seeds],
        )


def stop(
    bvh: Bvh,
    origin: mi.Point3f,
    directions: Sequence[mi.Vector3f],
    back_faces: BackFaces,
    normal: mi.Vector3f,
) -> Callable[[Stops, mi.UInt32, mi.Bool], Stops]:
    """Visitor of a walk: a surfel may stop each ray."""

    def visit(state: Stops, place: mi.UInt32, active: mi.Bool) -> Stops:
        surfel = dr.gather(mi.UInt32, bvh.order, place, active)
        for ray, direction in enumerate(directions):
            hit = intersect(bvh.geometry, place, origin, direction, bvh.degree)
            chance = mi.Float(hashed(surfel * mi.UInt32(0x9E3779B1) + state.seed[ray]) >> 8) * float(2.0**-24)
            before, found = state.farthest[ray], state.surfel[ray]
            nearer = (hit.t < before) | ((hit.t == before) & (surfel < found))
            stops = blocks(hit, back_faces, normal) & nearer & (chance < hit.alpha)
            state.farthest[ray] = dr.select(stops, hit.t, before)
            state.surfel[ray] = dr.select(stops, surfel, found)
            state.front[ray] = dr.select(stops, hit.front, state.front[ray])
        return state

    return visit


def first_hits(bvh: Bvh, fans: Fans, back_faces: BackFaces, seeds: Sequence[mi.UInt32]) -> list[FirstHit]:
    """The stop of each ray: a :class:`FirstHit` for each direction of the fans.

    Evaluated at once, unless within a recorded loop.

    Args:
        bvh: the hierarchy.
        fans: the rays; inactive ones meet nothing.
        back_faces: from where on they stop rays.
        seeds: of each direction, one a lane, no two rays' alike (:func:`ray_seeds`).
    """
    if dr.flag(dr.JitFlag.SymbolicScope):
        start = Stops.none(fans.active, seeds)
        visit = stop(bvh, fans.origin, fans.directions, back_faces, fans.normal)
        end = walk(bvh, fans.origin, fans.directions, start, visit, any_of(fans.active))
        return [
            FirstHit(surfel, front, dr.select(surfel != NOTHING, distance, dr.inf))
            for surfel, front, distance in zip(end.surfel, end.front, end.farthest)
        ]
    count = dr.width(fans, seeds)
    fans, seeds = spread(fans, count), [spread(mi.UInt32(seed), count) for seed in seeds]
    found = [
        FirstHit(dr.zeros(mi.UInt32, count), dr.zeros(mi.Bool, count), dr.zeros(mi.Float, count))
        for _ in seeds
    ]
    dr.make_opaque(fans, seeds, found)
    return _trace(bvh, fans, back_faces, seeds, Line.of(count), found)


@recorded
def _trace(
    bvh: Bvh,
    fans: Fans,
    back_faces: BackFaces,
    seeds: Sequence[mi.UInt32],
    line: Line,
    found: Sequence[FirstHit],
) -> Sequence[FirstHit]:
    """Trace all fans; ``found`` receives what stops each ray."""

    def begin(fan: mi.UInt32, going: mi.Bool) -> Stops:
        return Stops.none(
            [dr.gather(mi.Bool, lanes, fan, going) for lanes in fans.active],
            [dr.gather(mi.UInt32, seed, fan, going) for seed in seeds],
        )

    def visitor(origin: mi.Point3f, along: Sequence[mi.Vector3f], normal: mi.Vector3f) -> Callable:
        return stop(bvh, origin, along, back_faces, normal)

    def write(state: Stops, fan: mi.UInt32, done: mi.Bool) -> None:
        for ray, hit in enumerate(found):
            met = state.surfel[ray] != NOTHING
            dr.scatter(hit.surfel, state.surfel[ray], fan, done)
            dr.scatter(hit.front, state.front[ray], fan, done)
            dr.scatter(hit.distance, dr.select(met, state.farthest[ray], dr.inf), fan, done)

    nothing = [mi.UInt32(0) for _ in seeds]
    serve(bvh, fans, line, Stops.none([mi.Bool(False) for _ in seeds], nothing), begin, visitor, write)
    return found


@dataclass
class Line:
    """Fans that wait: their number and how many were taken, one lane each; ``lane`` counts those who take."""

    lane: mi.UInt32
    fans: mi.UInt32
    taken: mi.UInt32

    @staticmethod
    def of(count: int) -> Line:
        """A line of ``count`` fans, none of them taken."""
        line = Line(dr.arange(mi.UInt32, count), dr.opaque(mi.UInt32, count), dr.opaque(mi.UInt32, 0))
        dr.make_opaque(line)
        return line


def spread(values: Any, width: int) -> Any:
    """``width`` numbers of each array in ``values``, which may be a tree: one for all is repeated."""
    if isinstance(values, Fans):
        return Fans(
            mi.Point3f(*[spread(dr.detach(v), width) for v in values.origin]),
            [mi.Vector3f(*[spread(dr.detach(v), width) for v in along]) for along in values.directions],
            [spread(mi.Bool(lanes), width) for lanes in values.active],
            mi.Vector3f(*[spread(dr.detach(v), width) for v in values.normal]),
        )
    if dr.width(values) == width:
        return values
    return dr.gather(type(values), values, dr.zeros(mi.UInt32, width))


@dr.syntax
def serve(
    bvh: Bvh,
    fans: Fans,
    line: Line,
    state: State,
    begin: Callable[[mi.UInt32, mi.Bool], State],
    visitor: Callable[
        [mi.Point3f, Sequence[mi.Vector3f], mi.Vector3f], Callable[[State, mi.UInt32, mi.Bool], State]
    ],
    write: Callable[[State, mi.UInt32, mi.Bool], None],
) -> State:
    """Walk all fans of ``line``: many fans of rays for the lanes that trace them.

    Some fans pass twice as many nodes as their neighbours. With a lane for each, the lanes of a packet wait
    for the slowest, and only 60 % of them work. Here a lane that is done takes the next fan in line, by a
    counter that all lanes share, until none is left (persistent threads: Aila and Laine 2009). What a fan
    finds is written at its own place, so the result does not depend on who traced it.

    Args:
        bvh: the hierarchy. fans: as many rays each as ``state`` has intervals. line: their line.
        state: of a walk that is over.
        begin: the state in which the walk of a fan begins, in the lanes given.
        visitor: of the walk of a fan from its origin along its directions, of its surface's normal.
        write: takes the state in which the walk of a fan ended, in the lanes given.
    """
    rays = range(len(fans.directions))
    fan, going = mi.UInt32(_NO_FAN), line.lane < line.fans
    origin, normal, along = mi.Point3f(0), mi.Vector3f(0), [mi.Vector3f(0) for _ in rays]
    slopes = [mi.Vector3f(0) for _ in rays]
    at = Descent.begun()
    while going:
        if ~at.unfinished(state):
            write(state, fan, fan < line.fans)
            fan = dr.scatter_inc(line.taken, mi.UInt32(0))
            going = fan < line.fans
            origin = mi.Point3f(*[dr.gather(mi.Float, v, fan, going) for v in fans.origin])
            normal = mi.Vector3f(*[dr.gather(mi.Float, v, fan, going) for v in fans.normal])
            for ray in rays:
                along[ray] = mi.Vector3f(*[dr.gather(mi.Float, v, fan, going) for v in fans.directions[ray]])
                slopes[ray] = slopes_of(along[ray])
            at = Descent.begun()
            state = begin(fan, going)
        at = search(bvh, origin, slopes, state, at, going)
        at, state = look(at, state, visitor(origin, along, normal), going)
    return state


def queued_transmittance(bvh: Bvh, fans: Fans, back_faces: BackFaces) -> list[mi.Float]:
    """`tron.tracing.hierarchy.transmittance` of fans, at once; not inside a recorded loop."""
    count = dr.width(fans)
    fans = spread(fans, count)
    found = [dr.zeros(mi.Float, count) for _ in fans.directions]
    dr.make_opaque(fans, found)
    found = _products(bvh, fans, back_faces, Line.of(count), found)
    return [dr.select(lanes, value, 1) for value, lanes in zip(found, fans.active)]


# Tracing the walk takes Python as long as tracing 10,000 rays takes a core, so it is recorded once for each
# kind of arguments: kernel degree, levels, rays in a fan. Other sizes are free.
@recorded
def _products(
    bvh: Bvh, fans: Fans, back_faces: BackFaces, line: Line, found: Sequence[mi.Float]
) -> Sequence[mi.Float]:
    """Trace all fans; ``found`` receives what is left of each ray."""

    def begin(fan: mi.UInt32, going: mi.Bool) -> Products:
        return Products.clear([dr.gather(mi.Bool, lanes, fan, going) for lanes in fans.active])

    def visitor(origin: mi.Point3f, along: Sequence[mi.Vector3f], normal: mi.Vector3f) -> Callable:
        return multiply(bvh, origin, along, back_faces, normal)

    def write(state: Products, fan: mi.UInt32, done: mi.Bool) -> None:
        for value, product in zip(found, state.product):
            dr.scatter(value, remaining(product), fan, done)

    serve(bvh, fans, line, Products.clear([mi.Bool(False) for _ in found]), begin, visitor, write)
    return found
