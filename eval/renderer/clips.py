"""Flicker and PSNR of frames averaged along the motion of clips."""

from __future__ import annotations

import logging
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from eval.confidence import interval, scene_sums
from eval.relighting.buffers import MEMBERS, SURFELS_DEPTH, Buffers, region_mask
from eval.relighting.networks import Network
from eval.renderer.pictures import KIND_TITLES, LEAST_WIDTH, enlarge
from eval.report.outcome import Outcome
from eval.results import Row, mean_row
from eval.video.steadiness import Difference, Step, steps, warping_error
from tron import metrics
from tron.cameras import Camera
from tron.errors import TronError
from tron.flow import surface_motion
from tron.io.video import VideoWriter
from tron.neural.clips import averaged_frames
from tron.report.page import Film, Films
from tron.shards.moving import Moving
from tron.shards.reader import read_clips
from tron.shards.schema import Clip

log = logging.getLogger("tron.eval")

TRUTH, LIT, LIT_AVERAGED = "truth", "lit_buffer", "lit_buffer_averaged"
SINGLE, AVERAGED = "k1", "averaged"
"""Single frames; the same averaged along their motion, as tron-relight draws films."""
PLAIN = {TRUTH: "path-traced truth", LIT: "lit, no network", LIT_AVERAGED: "lit, no network, averaged alike"}
WAYS = {SINGLE: "single frames", AVERAGED: "five frames averaged"}
WINDOW = 5
"""Frames that are averaged, as many as a pass of the paper's has."""
FILM_FPS = 10.0
DEPTH = "depth_ref"
"""Member that the flow needs, with the foreground."""


@dataclass(frozen=True)
class ClipScore:
    """One clip by one method: its warping error, and the foreground PSNR of each frame in dB."""

    scene: str
    warping: Difference
    psnr: Sequence[float]


Scored = Mapping[str, Sequence[ClipScore]]
"""Method -> a score a clip; methods are TRUTH, LIT, LIT_AVERAGED and ``KIND.WAY``."""


def clip_rows(scores: Scored, kinds: Sequence[str], seed: int) -> Iterator[Row]:
    """Yield RMS warping errors of methods, and ratios and gains of averages over single frames.

    Figures without a checkpoint's name are of the checkpoint that starts from lit, tron-relight's default.
    Its averages are also compared with averages of lit.
    """
    for method, found in scores.items():
        mean = sum(each.warping.squared for each in found) / sum(each.warping.pixels for each in found)
        yield Row(
            metric=f"renderer.warp_rms.{method}", value=float(np.sqrt(mean)), unit="fraction", n=len(found)
        )
    for kind in kinds:
        single = scores[f"{kind}.{SINGLE}"]
        averaged, prefix = scores[f"{kind}.{AVERAGED}"], "renderer" if kind == "lit" else f"renderer.{kind}"
        yield _ratio(f"{prefix}.warp_error_ratio", averaged, single, seed)
        yield _gain(f"{prefix}.clip_gain_db", averaged, single, seed)
    if "lit" in kinds:
        averaged = scores[f"lit.{AVERAGED}"]
        yield _gain("renderer.lit.clip_gain_over_lit_db", averaged, scores[LIT_AVERAGED], seed)


def _ratio(metric: str, many: Sequence[ClipScore], single: Sequence[ClipScore], seed: int) -> Row:
    """Divide a mean square by the mean square of single frames on the same pixels."""
    sums = np.array([[a.warping.squared, b.warping.squared] for a, b in zip(many, single)])

    def ratio(sums: np.ndarray) -> np.ndarray:
        return sums[..., 0] / np.maximum(sums[..., 1], 1e-12)

    row = Row(metric=metric, value=float(ratio(sums.sum(0))), unit="x", n=len(sums))
    return row.within(interval(scene_sums([each.scene for each in many], sums), ratio, seed))


def _gain(metric: str, many: Sequence[ClipScore], single: Sequence[ClipScore], seed: int) -> Row:
    """Return the mean difference of PSNR on the same frames."""
    found = [(a.scene, x - y) for a, b in zip(many, single) for x, y in zip(a.psnr, b.psnr)]
    return mean_row(metric, "dB", found, seed)


def measure_clips(
    dataset: Path, split: str, networks: Mapping[str, Network], seed: int, outcome: Outcome
) -> None:
    """Render every clip by single frames and by their averages; film the clip that flickers most.

    Raises:
        TronError: no clip has enough frames to average, or clips have no true depth.
    """
    scores: defaultdict[str, list[ClipScore]] = defaultdict(list)
    worst, films = 0.0, None
    for clip in read_clips(dataset, split, (*MEMBERS, DEPTH, SURFELS_DEPTH)):
        if clip.meta.frames < WINDOW:
            continue
        moves, truth, inside = clip_steps(clip), clip.displayed("rgb"), region_mask(clip, "foreground")
        if not any(move.judged.any() for move in moves):
            continue
        buffers = Buffers.of(clip)
        lit = buffers.displayed("lit")
        shown = {TRUTH: truth, LIT: lit, LIT_AVERAGED: _averaged(lit, buffers)}
        for kind, network in networks.items():
            single = network.show(buffers)
            shown |= {f"{kind}.{SINGLE}": single, f"{kind}.{AVERAGED}": _averaged(single, buffers)}
        for method, frames in shown.items():
            psnr = [
                metrics.capped_psnr(image, target, mask)
                for image, target, mask in zip(frames, truth, inside)
                if mask.any()
            ]
            scores[method].append(ClipScore(clip.meta.scene, warping_error(frames, moves), psnr))
        for kind in list(networks)[:1]:
            if films is None or scores[f"{kind}.{SINGLE}"][-1].warping.mean > worst:
                worst = scores[f"{kind}.{SINGLE}"][-1].warping.mean
                films = _films(f"Scene {clip.meta.scene}, light {clip.meta.light}", kind, shown)
        log.info("clip %s", clip.meta.key)
    if not scores:
        raise TronError(f"no clip of {WINDOW} frames whose surface is seen twice", dataset)
    outcome.add(clip_rows(scores, list(networks), seed))
    if films is not None:
        outcome.show("clips", "renderer-clips", films)


def _averaged(frames: np.ndarray, buffers: Buffers) -> np.ndarray:
    """Average pictures along the motion of their clip, as tron-relight does."""
    assert buffers.motion is not None  # the clip was read with the depth of its surfels
    return np.stack(list(averaged_frames(frames, len(frames), WINDOW, buffers.motion, "anchor")))


def _films(title: str, kind: str, shown: Mapping[str, np.ndarray]) -> Films:
    """Film a clip by lit, by a network's single frames, by their averages, and the truth."""
    words = PLAIN | {f"{kind}.{way}": f"{KIND_TITLES[kind]}, {said}" for way, said in WAYS.items()}
    films = []
    for method in (LIT, f"{kind}.{SINGLE}", f"{kind}.{AVERAGED}", TRUTH):
        frames = shown[method]
        scale = -(-LEAST_WIDTH // frames.shape[2])
        size = frames.shape[2] * scale, frames.shape[1] * scale
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "film.mp4"
            with VideoWriter(path, FILM_FPS, size) as video:
                for frame in [*frames, *frames[-2:0:-1]]:  # there and back again
                    video.write(enlarge(frame, scale))
            films.append(Film(path.read_bytes(), size, words[method], f"{title}: {words[method]}"))
    return Films(title, films, columns=2)


def clip_steps(clip: Clip) -> list[Step]:
    """Return steps of a clip with true depth from each frame's foreground to the previous frame.

    Raises:
        TronError: the clip has no true depth, or no motion of its object.
    """
    if DEPTH not in clip.frames:
        raise TronError(
            f"clip {clip.meta.key} has no {DEPTH}", mend="make the split with reference_buffers=true"
        )
    cameras = [Camera.from_dict(each) for each in clip.meta.cameras]
    depths, moving = clip.frames[DEPTH][..., 0], Moving.of(clip.meta)
    match = surface_motion(cameras, depths.__getitem__, None if moving is None else moving.between)
    foreground = clip.frames["foreground"][..., 0] > 0.5
    return steps(match, foreground, ((k, k - 1) for k in range(1, clip.meta.frames)))
