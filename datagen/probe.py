"""Cost of a scene, measured on a small one: seconds by part of the work, bytes on disk, memory.

The probe runs the functions that make scenes, on a scene of the split, at two small sizes of frames and for
one frame and three. Seconds and bytes are taken as linear: what grows with pixels, frames, views and
optimisation steps is carried on to the recipe's numbers.
"""

from __future__ import annotations

import logging
import resource
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

from datagen import refinement
from datagen.build import Geometry
from datagen.clip_preview import preview_bytes, write_preview
from datagen.drawn_scene import draw_and_build
from datagen.pathtrace import LANES
from datagen.plan import Sources, Work
from datagen.reconstructed import reconstruction_steps
from datagen.scene import SceneSpec
from datagen.settings import Settings
from datagen.synthetic import make_clips, make_surfels
from tron.gaussians.initialize import sample_bytes
from tron.gaussians.scene import GaussianScene
from tron.shards.schema import clip_members
from tron.shards.writer import ShardWriter

SIDES = (24, 96)
"""Longer sides of the probe's frames, pixels: in smaller ones fixed costs hide what grows with pixels."""
FRAMES = (1, 3)
"""Frames of its clips."""
MOST_LIGHTS, VIEWS, STEPS = 4, 4, 10
"""Lights, views and optimisation steps of a probe, where the recipe has more."""

VIEW_BYTES = 49
"""Bytes of a pixel of a true G-buffer in memory; LANES / 2 pixels are rendered at a time, and copied."""

Result = TypeVar("Result")


@dataclass(frozen=True)
class SceneCost:
    """Cost of one scene.

    Attributes:
        seconds: of one core, kernels compiled.
        bytes: on disk, with previews.
        memory: of the worker at its largest, bytes.
        source: what was measured, in words.
    """

    seconds: float
    bytes: float
    memory: float
    source: str


@dataclass(frozen=True)
class _Clips:
    """Cost of the clips of a probe: seconds, and bytes of shards and previews."""

    seconds: float
    shards: float
    previews: float


@contextmanager
def _quietly() -> Iterator[None]:
    """Say nothing of how well a few steps on a few views fit."""
    teller = logging.getLogger(refinement.__name__)
    before = teller.level
    teller.setLevel(logging.WARNING)
    try:
        yield
    finally:
        teller.setLevel(before)


@_quietly()
def probe(item: Work, settings: Settings, sources: Sources) -> SceneCost:
    """Cost of a scene of the recipe, from small renders of it; nothing stays on disk."""
    recipe = settings.split(item.split)
    lights = recipe.lights[:MOST_LIGHTS]
    sizes = [_scaled(recipe.width, recipe.height, side) for side in SIDES]
    pixels = [width * height for width, height in sizes]
    begun = _peak()
    spec, geometry = draw_and_build(item, settings, sources, lights)
    _, building = _timed(lambda: draw_and_build(item, settings, sources, lights))

    def surfels(steps: int) -> tuple[GaussianScene, float]:
        views = min(settings.views, VIEWS)
        with TemporaryDirectory() as folder:
            few = {"views": views, "refine_steps": steps, "output_dir": Path(folder)}
            there = settings.model_copy(update=few)
            (made, _), seconds = _timed(lambda: make_surfels(spec, geometry, there))
        return made, seconds

    surfels(1)  # compiles
    plain, viewing = surfels(0)
    viewing *= settings.views / min(settings.views, VIEWS)
    refining, shares = 0.0, settings.surfels_from
    rebuilt = shares.reconstruction / (shares.gbuffers + shares.reconstruction)
    if settings.refine_steps or rebuilt:
        (_, once), (_, often) = surfels(1), surfels(1 + STEPS)
        step = (often - once) / STEPS
        refining = (
            (once - surfels(0)[1] + (settings.refine_steps - 1) * step) if settings.refine_steps else 0.0
        )
        refining = (1 - rebuilt) * refining + rebuilt * reconstruction_steps(settings) * step

    def clips(size: tuple[int, int], frames: int) -> _Clips:
        return _clips(spec, geometry, plain, _small(settings, item.split, size, frames))

    frames = [min(count, recipe.frames) for count in FRAMES]
    clips(sizes[0], frames[0])  # compiles
    few, more = (clips(sizes[0], count) for count in frames)
    peak = _peak()
    larger, most = (clips(sizes[1], count) for count in frames)
    lanes = [min(LANES, count * recipe.path_spp) for count in pixels]
    growth = max(_peak() - peak, 0) / max(lanes[1] - lanes[0], 1)
    whole = recipe.width * recipe.height

    def carried(low: float, high: float) -> float:
        """A straight line through the two sizes, at the recipe's; it never falls."""
        slope = max(high - low, 0.0) / (pixels[1] - pixels[0]) if pixels[1] > pixels[0] else 0.0
        return max(low, 0.0) + slope * (whole - pixels[0])

    if frames[1] > frames[0]:
        further = frames[1] - frames[0]
        one_frame = [(more.seconds - few.seconds) / further, (most.seconds - larger.seconds) / further]
        fixed = max(few.seconds - one_frame[0], 0.0)
    else:  # clips of one frame
        one_frame, fixed = [few.seconds, larger.seconds], 0.0
    frame_seconds = carried(*one_frame)
    share = len(recipe.lights) / len(lights)
    frame_bytes = carried(more.shards / frames[1], most.shards / frames[1])
    members = len(clip_members(recipe.reference_buffers))
    tiles = [preview_bytes(*sizes[1], count, members) for count in (frames[1], recipe.frames)]
    preview = carried(more.previews, most.previews) * tiles[1] / tiles[0]
    with TemporaryDirectory() as folder:
        plain.save(Path(folder) / "surfels.ply")
        kept = (Path(folder) / "surfels.ply").stat().st_size
    # One frame's buffers under every light, and a clip's encoded files until they are in the shard.
    held = share * whole * 4 * 64 + recipe.frames * frame_bytes
    views_pixels = settings.views * settings.view_width * settings.view_height
    gathered = sample_bytes(settings.surfels, views_pixels) + 2 * LANES * VIEW_BYTES
    pictures = rebuilt * settings.views * settings.view_width * settings.view_height
    pictures *= settings.surfel_reconstruction.path_spp / (whole * recipe.path_spp)  # in frames of a clip
    return SceneCost(
        seconds=building
        + viewing
        + refining
        + share * (fixed + recipe.frames * frame_seconds)
        + pictures * frame_seconds,
        bytes=kept + share * (recipe.frames * frame_bytes + preview),
        memory=max(
            begun + gathered,
            _peak() + growth * max(min(LANES, whole * recipe.path_spp) - lanes[1], 0) + held,
        ),
        source=f"probe: {item.name}, {len(lights)} lights, {sizes[1][0]} x {sizes[1][1]}",
    )


def _scaled(width: int, height: int, side: int) -> tuple[int, int]:
    scale = min(side / max(width, height), 1.0)
    return max(round(scale * width), 8), max(round(scale * height), 8)


def _small(settings: Settings, split: str, size: tuple[int, int], frames: int) -> Settings:
    """The settings with other frames of one split."""
    changed = {"width": size[0], "height": size[1], "frames": min(frames, settings.split(split).frames)}
    return settings.model_copy(update={split: settings.split(split).model_copy(update=changed)})


def _clips(spec: SceneSpec, geometry: Geometry, surfels: GaussianScene, settings: Settings) -> _Clips:
    """Make a scene's clips in a folder that goes away."""

    def make(folder: Path) -> int:
        there = settings.model_copy(update={"output_dir": folder})
        with ShardWriter(folder, spec.split, settings.clips_per_shard) as writer:
            for meta, frames in make_clips(spec, geometry, surfels, there):
                writer.write(meta, frames)
                write_preview(folder, meta, frames)
        return sum(entry.bytes for entry in writer.entries)

    with TemporaryDirectory() as name:
        shards, seconds = _timed(lambda: make(Path(name)))
        previews = sum(path.stat().st_size for path in (Path(name) / "previews").iterdir())
    return _Clips(seconds, shards, previews)


def _timed(work: Callable[[], Result]) -> tuple[Result, float]:
    """Result of work, and its seconds of processor: what else runs on the machine does not count."""
    start = time.process_time()
    result = work()
    return result, time.process_time() - start


def _peak() -> float:
    """Largest resident memory of this process so far, bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return float(peak if sys.platform == "darwin" else 1024 * peak)
