"""Variety of a dataset: histograms of its materials, lights and pictures, one frame per clip.

A scene's histograms are counted when it is made, from the true G-buffer and its frame, and stored in its
record; the histograms of a dataset are sums over scenes. Datasets without them are counted from their shards,
as far as the members allow.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tron.cameras import Camera
from tron.color import luminance
from tron.gaussians.initialize import GBufferView
from tron.shards.manifest import Manifest
from tron.shards.reader import decode_clip, group_clips, tar_files
from tron.shards.schema import clip_members

Histograms = dict[str, list[int]]
"""Name of a measure -> counts in its bins."""

VARIETY_NAME = "variety.png"

SILHOUETTE_STEP = 0.05
"""Least jump of inverse depth at a silhouette, as a share of the nearer pixel's."""


@dataclass(frozen=True)
class Measure:
    """One histogram of the report.

    Attributes:
        title: title of the axis, with the unit.
        counted: unit of the counts.
        edges: edges of the bins, ascending; values outside count in the first or the last bin.
        logarithmic: whether the bins widen by a factor.
    """

    title: str
    counted: str
    edges: tuple[float, ...]
    logarithmic: bool = False

    def count(self, values: np.ndarray) -> np.ndarray:
        """Count values of any shape in the bins, (B,)."""
        inside = np.clip(np.asarray(values, np.float64).ravel(), self.edges[0], self.edges[-1])
        return np.histogram(inside, bins=np.asarray(self.edges))[0]


def _share(title: str, counted: str) -> Measure:
    return Measure(title, counted, tuple(np.round(np.linspace(0.0, 1.0, 21), 6).tolist()))


def _by_factor(title: str, counted: str, low: float, high: float) -> Measure:
    return Measure(title, counted, tuple(np.round(np.geomspace(low, high, 25), 6).tolist()), True)


MEASURES: dict[str, Measure] = {
    "albedo": _share("albedo (luminance of the base color)", "pixels"),
    "roughness": _share("roughness", "pixels"),
    "metallic": _share("metallic", "pixels"),
    "contrast": _share("light contrast (share of its brightest hundredth)", "clips"),
    "depth": _by_factor("distance from the camera, world units", "pixels", 0.1, 100.0),
    "coverage": _share("coverage (share of the frame)", "clips"),
    "silhouettes": _by_factor("silhouettes, frame widths", "clips", 0.1, 100.0),
    "shadow": _share("light that shadows take, share", "clips"),
    "bounce": _share("light that bounced, share of lit", "clips"),
}
"""All histograms, in the order of the report."""


_SURFACE = ("base_color_ref", "roughness_ref", "metallic_ref", "depth_ref")
_LIGHT = ("foreground", "irradiance", "unshadowed", "shadowed", "lit")
COUNTED_MEMBERS = (*_LIGHT, *_SURFACE)
"""Members of a frame that the measures look at."""


def surface_members(truth: GBufferView) -> dict[str, np.ndarray]:
    """Return a true G-buffer's members under their names in the schema, for :func:`frame_histograms`."""
    distance = np.linalg.norm(truth.position - truth.camera.position, axis=-1)
    images = (truth.base_color, truth.roughness, truth.metallic, distance)
    return dict(zip(_SURFACE, images))


def frame_histograms(
    frame: Mapping[str, np.ndarray], camera: Camera, contrast: float | None = None
) -> Histograms:
    """Count the histograms of one frame for which it has the members.

    Args:
        frame: members as in the schema, (H, W), (H, W, 1) or (H, W, 3), linear; ``foreground`` is among them.
        camera: camera of the frame.
        contrast: share of the light that comes from the brightest hundredth of the sphere, in [0, 1].
    """
    images = {name: np.asarray(frame[name], np.float64) for name in COUNTED_MEMBERS if name in frame}
    images = {name: x if x.shape[2:] == (3,) else x.reshape(x.shape[:2]) for name, x in images.items()}
    seen = images["foreground"] > 0.5
    found: dict[str, np.ndarray | float] = {"coverage": seen.mean()}
    if contrast is not None:
        found["contrast"] = contrast
    if "base_color_ref" in images:
        found["albedo"] = luminance(images["base_color_ref"])[seen]
    for name in ("roughness", "metallic", "depth"):
        if f"{name}_ref" in images:
            found[name] = images[f"{name}_ref"][seen]
    if "depth_ref" in images:
        found["silhouettes"] = silhouette_length(images["depth_ref"], seen, camera)
    for name, part, whole in (("shadow", "irradiance", "unshadowed"), ("bounce", "shadowed", "lit")):
        if part in images and whole in images:
            light = luminance(images[whole])[seen].sum()
            if light > 0:
                found[name] = 1.0 - luminance(images[part])[seen].sum() / light
    return {
        name: MEASURES[name].count(np.asarray(found[name])).tolist() for name in MEASURES if name in found
    }


def silhouette_length(distance: np.ndarray, seen: np.ndarray, camera: Camera) -> float:
    """Return the length of depth silhouettes, in frame widths.

    Inverse depth is affine in the pixel on every plane. A silhouette separates two neighbours if neither
    one's plane, extrapolated from its own side, comes within SILHOUETTE_STEP of the other. So a floor at a
    grazing angle has none, however far apart its pixels are.

    Args:
        distance: (H, W) from the camera, world units. seen: (H, W) bool, where there is a surface.
        camera: pinhole, pixels.
    """
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    slant = np.sqrt(((u - camera.cx) / camera.fx) ** 2 + ((v - camera.cy) / camera.fy) ** 2 + 1.0)
    inverse = np.where(seen, slant / np.where(seen, distance, 1.0), 0.0)
    pairs = 0
    for image in (inverse, inverse.T):
        padded = np.pad(image, ((0, 0), (1, 1)), mode="edge")
        before, here, there, after = (padded[:, k : padded.shape[1] - 3 + k] for k in range(4))
        miss = np.minimum(np.abs(2 * here - before - there), np.abs(2 * there - after - here))
        pairs += int((miss > SILHOUETTE_STEP * np.maximum(here, there)).sum())
    return pairs / camera.width


def total(parts: Iterable[Histograms]) -> Histograms:
    """Sum histograms; a part with another number of bins (from another version) is left out."""
    sums: dict[str, np.ndarray] = {}
    for part in parts:
        for name, counts in part.items():
            if name in MEASURES and len(counts) == len(MEASURES[name].edges) - 1:
                sums[name] = sums.get(name, 0) + np.asarray(counts, np.int64)
    return {name: sums[name].tolist() for name in MEASURES if name in sums}


def median(name: str, counts: Sequence[int]) -> float:
    """Return the median of a measure from its counts, assumed even within a bin; NaN without counts."""
    if not any(counts):
        return float("nan")
    edges, below = np.asarray(MEASURES[name].edges), np.append(0, np.cumsum(counts))
    return float(np.interp(below[-1] / 2, below, edges))


def shard_histograms(folder: Path) -> Histograms:
    """Count the histograms of a dataset from its shards: the first frame of every clip.

    Raises:
        TronError: it is no dataset of this schema, or a shard is damaged.
    """
    parts = []
    for entry in Manifest.load(folder).shards:
        wanted = {*COUNTED_MEMBERS}
        for _, files in group_clips(tar_files(folder / entry.name, wanted)):
            has_reference = "f00.depth_ref.exr" in files
            members = [name for name in clip_members(has_reference) if name in wanted]
            clip = decode_clip(files, members, frames=[0])
            frame = {name: image[0] for name, image in clip.frames.items()}
            camera = Camera.from_dict(clip.meta.cameras[0])
            parts.append(frame_histograms(frame, camera, clip.meta.extra.get("contrast_share")))
    return total(parts)
