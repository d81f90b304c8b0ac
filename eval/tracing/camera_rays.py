"""Camera rays: one frame of TRON beside one of each peer.

TRON's time counts everything a new camera costs: tile lists, tracing, sorting, compositing twelve channels
and normalising. The hits' ids, of which only gradients have need, are not kept: :mod:`eval.tracing.gradients`
times that. The peers' hierarchies are built before and not counted.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

from eval.peers import volprim
from eval.peers.contenders import PEERS, Contenders
from eval.peers.timing import Rounds, Times, interleaved
from eval.tracing.measured import BINNING, TRON, USUAL, CameraRays
from tron.tracing.tiles import build_tiles


def measure_camera_rays(
    contenders: Contenders,
    size: int,
    rounds: Rounds,
    without: Collection[str] = (),
    usual: Contenders | None = None,
) -> CameraRays:
    """Time all contestants on one view, in turns.

    Args:
        without: peers that are left out.
        usual: the same number of surfels elsewhere, of which TRON renders a frame of as many pixels beside.
    """
    view, tracer = contenders.place.camera(size), contenders.tracer
    contestants: dict[str, Callable[[], Any]] = {
        TRON: lambda: tracer.gbuffer(view),
        BINNING: lambda: build_tiles(tracer.records, view).entries,
    }
    for peer in PEERS:
        if peer.name not in without and (frame := peer.frame(contenders, view)):
            contestants[peer.name] = frame
    if usual is not None:
        other = usual.place.camera(size)
        contestants[USUAL] = lambda: usual.tracer.gbuffer(other)
    times = interleaved(contestants, rounds)
    names = contenders.place.name, contenders.recipe.name
    return CameraRays(len(contenders.scene), size, times, *names)


def time_shapes(contenders: Contenders, size: int) -> dict[str, Times]:
    """Times of a frame of this place by the peer's two plugins for its primitives."""
    sensor = volprim.sensor(contenders.place.camera(size))
    integrator = volprim.load_integrator(volprim.OUR_STOP)
    scenes = {
        shape: volprim.primitives(contenders.scene, contenders.recipe.sh_degree, shape)
        for shape in volprim.SHAPES
    }
    frames = {shape: lambda s=scene: volprim.render(s, sensor, integrator) for shape, scene in scenes.items()}
    return interleaved(frames, Rounds(3))
