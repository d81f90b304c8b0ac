"""Stochastic first hits: one surfel per ray, whose probability is its compositing weight.

Each surfel stops a ray with probability alpha, independently of the others, and the nearest one that does is
returned. So surfel i is returned if it stops the ray and none before it does:

    P(i) = alpha_i prod_{j < i} (1 - alpha_j) = T_i alpha_i,

which is its weight in front-to-back compositing. The value of the returned surfel is therefore an unbiased
estimate of the composited value (stochastic transparency: Enderton et al. 2010). Nothing is sorted, no list
is kept, and surfels behind a stop are culled. Sides count as for shadow rays
(:mod:`tron.tracing.hierarchy.transmittance`), so the probability of no hit is the ray's transmittance.

A hash of the ray's seed and the surfel's number in the scene decides whether the surfel stops the ray, so the
result does not depend on the order of a walk or on how a hierarchy sorts the surfels.
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
"""Surfel number of a ray that meets none."""
_NO_FAN = 0xFFFFFFFF


@dataclass
class FirstHit:
    """The surfel that stops each ray, one lane per ray.

    Attributes:
        surfel: mi.UInt32, in the scene's order; ``NOTHING`` if none stops the ray.
        front: mi.Bool, the ray meets the side that its normal points to.
        distance: mi.Float, along the unit ray, world units; infinity if none stops the ray.
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
    """Seeds for :func:`first_hits`, of ray ``ray`` of ``lane``, below ``root`` of :mod:`tron.seeds`.

    All three must be opaque; a literal would compile a kernel for each of its values.
    """
    return hashed(hashed(hashed(root) + lane) + ray)


@dataclass
class Stops:
    """The nearest stop so far of each ray of a fan.

    Attributes:
        nearest, farthest: as in :class:`Intervals`; farthest is the distance of the stop.
        surfel: in the scene's order, or ``NOTHING``. front: the side met. seed: the ray's.
    """

    nearest: list[mi.Float]
    farthest: list[mi.Float]
    surfel: list[mi.UInt32]
    front: list[mi.Bool]
    seed: list[mi.UInt32]

    @staticmethod
    def none(active: Sequence[mi.Bool], seeds: Sequence[mi.UInt32]) -> Stops:
        """Initial state of the rays to trace: nothing met yet."""
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
    """Visitor of a walk: let a surfel stop each ray, by chance."""

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
    """Find the surfel that stops each ray: a :class:`FirstHit` for each direction of the fans.

    Evaluated at once, except within a recorded loop.

    Args:
        bvh: the hierarchy.
        fans: the rays; inactive ones meet nothing.
        back_faces: the distance beyond which back faces stop rays.
        seeds: of each direction, one per lane; every ray needs its own (:func:`ray_seeds`).
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
    """Trace all fans; ``found`` receives the stop of each ray."""

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
    """A queue of fans: their number and how many were taken, one lane each; ``lane`` numbers the takers."""

    lane: mi.UInt32
    fans: mi.UInt32
    taken: mi.UInt32

    @staticmethod
    def of(count: int) -> Line:
        """Queue ``count`` fans, none of them taken."""
        line = Line(dr.arange(mi.UInt32, count), dr.opaque(mi.UInt32, count), dr.opaque(mi.UInt32, 0))
        dr.make_opaque(line)
        return line


def spread(values: Any, width: int) -> Any:
    """Repeat arrays of one number to ``width`` numbers; ``values`` may be a tree of arrays."""
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
    """Trace all fans of the queue ``line``; a lane may trace many of them.

    Some fans pass twice as many nodes as their neighbours. With one lane per fan, the lanes of a packet wait
    for the slowest, and only 60 % of them work. Here a lane that is done takes the next fan from the queue,
    by a counter that all lanes share, until none is left (persistent threads: Aila and Laine 2009). A fan's
    result is written at its own place, so it does not depend on the lane that traced it.

    Args:
        bvh: the hierarchy. fans: as many rays each as ``state`` has intervals. line: their queue.
        state: of a finished walk.
        begin: gives the initial state of a fan's walk, in the lanes given.
        visitor: makes the visitor of a fan's walk from its origin, directions and surface normal.
        write: stores the final state of a fan's walk, in the lanes given.
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
    """`tron.tracing.hierarchy.transmittance` of all fans, evaluated at once; not for recorded loops."""
    count = dr.width(fans)
    fans = spread(fans, count)
    found = [dr.zeros(mi.Float, count) for _ in fans.directions]
    dr.make_opaque(fans, found)
    found = _products(bvh, fans, back_faces, Line.of(count), found)
    return [dr.select(lanes, value, 1) for value, lanes in zip(found, fans.active)]


# Python needs as long to trace this code as a core needs for 10,000 rays, so it is recorded once for each
# kind of arguments: kernel degree, levels, rays per fan. Array sizes may change freely.
@recorded
def _products(
    bvh: Bvh, fans: Fans, back_faces: BackFaces, line: Line, found: Sequence[mi.Float]
) -> Sequence[mi.Float]:
    """Trace all fans; ``found`` receives each ray's transmittance."""

    def begin(fan: mi.UInt32, going: mi.Bool) -> Products:
        return Products.clear([dr.gather(mi.Bool, lanes, fan, going) for lanes in fans.active])

    def visitor(origin: mi.Point3f, along: Sequence[mi.Vector3f], normal: mi.Vector3f) -> Callable:
        return multiply(bvh, origin, along, back_faces, normal)

    def write(state: Products, fan: mi.UInt32, done: mi.Bool) -> None:
        for value, product in zip(found, state.product):
            dr.scatter(value, remaining(product), fan, done)

    serve(bvh, fans, line, Products.clear([mi.Bool(False) for _ in found]), begin, visitor, write)
    return found
