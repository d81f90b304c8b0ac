"""Moving shadows: compare the change of a network's picture with the change of the truth.

An occluder moves between two frames, camera and light stand still. Where the surface stayed, only the
incoming light changes. x is the change of a display value in the truth, y the change by a method. Correlation
is Pearson's; the slope is of the least-squares line of y over x, cov(x, y) / var(x). Both follow from sums
over pixels.
"""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_dilation

from eval.confidence import Statistic, interval, scene_sums
from eval.relighting.buffers import MEMBERS, Buffers
from eval.relighting.networks import Network
from eval.renderer.pictures import KIND_TITLES, LEAST_WIDTH, enlarge
from eval.report.outcome import Outcome
from eval.results import Row
from tron.errors import TronError
from tron.report.page import Picture, Pictures
from tron.shards.reader import read_clips

log = logging.getLogger("tron.eval")

LIT, PBR = "lit_buffer", "pbr_buffer"
SURFACE = ("depth_ref", "normal_ref", "base_color_ref")
"""Members that say whether a pixel's surface stayed."""
SAME_DEPTH = 1e-3
"""Largest relative difference of distances of a surface that stayed."""
SAME_NORMAL = 1e-3
"""Largest 1 - cosine of its normals."""
SAME_COLOR = 5e-3
"""Largest difference of its base color, linear; half floats round by 5e-4 at most."""
CHANGE_GAIN = 3
"""Factor on changes in pictures, around middle grey."""


def measure_shadows(
    dataset: Path, split: str, networks: Mapping[str, Network], seed: int, outcome: Outcome
) -> None:
    """Compare consecutive frames of every clip: correlation and slope of every method.

    Figures without a name are of the checkpoint that starts from lit, tron-relight's default. The pair of
    frames that changes most is shown.

    Raises:
        TronError: clips have no references, or no surface stays where the truth changes.
    """
    scenes, sums, largest = list[str](), defaultdict[str, list[np.ndarray]](list), 0.0
    pictures = None
    for clip in read_clips(dataset, split, (*MEMBERS, *SURFACE)):
        if missing := [name for name in SURFACE if name not in clip.frames]:
            raise TronError(
                f"clip {clip.meta.key} has no {missing[0]}", dataset, "make it with reference_buffers=true"
            )
        buffers, truth = Buffers.of(clip), clip.displayed("rgb")
        shown = {PBR: buffers.displayed("pbr"), LIT: buffers.displayed("lit")}
        shown |= {kind: network.show(buffers) for kind, network in networks.items()}
        for now in range(1, clip.meta.frames):
            judged = stayed(clip.frames, now - 1, now)
            if not judged.any():
                continue
            change = (truth[now] - truth[now - 1])[judged]
            scenes.append(clip.meta.scene)
            for method, frames in shown.items():
                ours = (frames[now] - frames[now - 1])[judged]
                sums[method].append(change_sums(change, ours))
            if (strength := float((change**2).sum())) > largest:
                largest = strength
                pairs = {name: (each[now - 1], each[now]) for name, each in shown.items() if name != PBR}
                pairs["truth"] = truth[now - 1], truth[now]
                pictures = _pictures(f"Scene {clip.meta.scene}, light {clip.meta.light}", pairs, judged)
        log.info("changes of clip %s", clip.meta.key)
    if not scenes:
        raise TronError("no clip with two frames in which a surface stays", dataset)

    def row(metric: str, method: str, measure: Statistic) -> Row:
        found = np.stack(sums[method])
        plain = Row(metric=metric, value=float(measure(found.sum(0))), unit="1", n=len(found))
        return plain.within(interval(scene_sums(scenes, found), measure, seed))

    measures = {"correlation": correlation, "slope": slope}
    for method in sums:
        outcome.add(row(f"renderer.{method}.shadow_{name}", method, each) for name, each in measures.items())
    if "lit" in sums:
        measures["slope_error"] = slope_error
        outcome.add(row(f"renderer.shadow_{name}", "lit", each) for name, each in measures.items())
    if pictures is not None:
        outcome.show("shadows", "renderer-shadows", pictures)


def _pictures(title: str, pairs: Mapping[str, tuple[np.ndarray, np.ndarray]], judged: np.ndarray) -> Pictures:
    """Show two frames and their change at pixels ``judged`` (H, W), one row per method."""
    pictures, scale = [], -(-LEAST_WIDTH // judged.shape[1])
    titles = {LIT: "lit, no network", **KIND_TITLES, "truth": "path-traced truth"}
    for name, (before, now) in pairs.items():
        change = np.clip(0.5 + CHANGE_GAIN * (now - before) / 2, 0, 1)
        change = np.where(judged[..., None], change, 0.5)
        for image, what in ((before, "before"), (now, "after"), (change, "change, surface that stayed")):
            words = f"{titles[name]}: {what}"
            pictures.append(Picture(enlarge(image, scale), words, words))
    return Pictures(title, pictures, columns=3)


def stayed(frames: Mapping[str, np.ndarray], before: int, now: int) -> np.ndarray:
    """(H, W) bool: foreground in two frames whose true depth, normal and base color are unchanged.

    ``frames`` are a clip's (K, H, W, C): :data:`SURFACE` and ``foreground``.

    The eight pixels around have not changed either: a pixel's picture gathers light from half a pixel beyond
    its centre and more, so that beside a silhouette that moves it shows the occluder, not its shadow.
    """
    (depth, other), (normal, turned), (color, dyed), (solid, there) = (
        (frames[name][now], frames[name][before]) for name in (*SURFACE, "foreground")
    )
    same = np.abs(depth - other)[..., 0] <= SAME_DEPTH * np.maximum(other[..., 0], 1e-6)
    same &= (normal * turned).sum(-1) >= 1 - SAME_NORMAL
    same &= np.abs(color - dyed).max(-1) <= SAME_COLOR
    now_solid, then_solid = solid[..., 0] > 0.5, there[..., 0] > 0.5
    same |= ~now_solid & ~then_solid  # sky has no normal
    changed = np.asarray(binary_dilation(~same, np.ones((3, 3), bool)), bool)
    return ~changed & now_solid & then_solid


def change_sums(truth: np.ndarray, ours: np.ndarray) -> np.ndarray:
    """Return n and the sums of x, y, xx, xy, yy over values of any shape: (6,) float64."""
    x, y = (np.asarray(each, np.float64).ravel() for each in (truth, ours))
    return np.array([x.size, x.sum(), y.sum(), x @ x, x @ y, y @ y])


def correlation(sums: np.ndarray) -> np.ndarray:
    """Return the correlation from sums (..., 6); 0 if one side never varies."""
    _, var_x, var_y, cov = _moments(sums)
    spread = np.sqrt(np.maximum(var_x * var_y, 0))
    return np.divide(cov, spread, out=np.zeros_like(cov), where=spread > 1e-15)


def slope(sums: np.ndarray) -> np.ndarray:
    """Return the slope from sums (..., 6); 0 if the truth never varies."""
    _, var_x, _, cov = _moments(sums)
    return np.divide(cov, var_x, out=np.zeros_like(cov), where=var_x > 1e-15)


def slope_error(sums: np.ndarray) -> np.ndarray:
    """Return the distance of the slope from 1."""
    return np.abs(slope(sums) - 1)


def _moments(sums: np.ndarray) -> tuple[np.ndarray, ...]:
    count = np.maximum(sums[..., 0], 1)
    mean_x, mean_y = sums[..., 1] / count, sums[..., 2] / count
    var_x, var_y = sums[..., 3] / count - mean_x**2, sums[..., 5] / count - mean_y**2
    return count, np.asarray(var_x), np.asarray(var_y), np.asarray(sums[..., 4] / count - mean_x * mean_y)
