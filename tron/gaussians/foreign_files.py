"""Splats by other programs: what is refused, expanded, made usable, and which way is up."""

from __future__ import annotations

import gzip
import logging
import re
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from shlex import quote

import numpy as np
from scipy.special import log_expit

from tron.errors import TronError
from tron.gaussians.fields import FIELDS, LOG_SCALE_LIMIT, third_scales
from tron.gaussians.formats.registry import FORMATS
from tron.gaussians.packed_files import PACKED_SPLATS, conversion
from tron.io.recognised import refuse_by_sight, refuse_placeholder

VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".mts")


def refuse_foreign(path: Path) -> None:
    """Raise TronError if a file, by its name or what it begins with, needs a step before it is a scene."""
    refuse_placeholder(path)
    suffix = path.suffix.lower()
    if suffix in VIDEOS:
        mend = f"tron-reconstruct capture={quote(path.name)} output_dir=OUT makes a scene of its frames"
        raise TronError("a video is no scene", path, mend)
    if suffix == ".ksplat":
        raise TronError("mkkellogg's .ksplat is not read", path, f"{conversion(path)} makes a PLY of it")
    known = PACKED_SPLATS.get(suffix) or FORMATS.get(suffix)
    if known is None or not known.begins(path):  # .spz, .sog, .usdz and checkpoints begin as archives do
        refuse_by_sight(path, "a scene is a file of splats")


ROUND = 0.9
"""Thinnest over middle axis from which neither is a normal."""


def thin_last(quats: np.ndarray, log_scales: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Part the smallest scale from the others: (M, 4), (M, 2 or 3) -> unit quats, (M, 2), (M,).

    The thin axis becomes the last. Its scale is -infinity of splats of two scales, and of flat ones
    (:data:`tron.gaussians.fields.FLATNESS`). Quaternions are finite and not zero.
    """
    lengths = np.linalg.norm(quats, axis=1, keepdims=True)
    # Unit quaternions are left alone to the last bit: a scene written and read is the same scene.
    quats = np.where(np.abs(lengths - 1) > 1e-6, quats / lengths, quats)
    if log_scales.shape[1] == 2:
        return quats, log_scales, np.full(len(quats), -np.inf, np.float32)
    thin = 2 - log_scales[:, ::-1].argmin(axis=1)  # the last of equals: what we wrote is not turned
    # A third turn about (1, 1, 1) cycles the axes (u, v, n) -> (v, n, u), two of them -> (n, u, v): the thin
    # axis becomes the third column and the frame stays right-handed.
    w, x, y, z = quats.T
    cycled = np.stack([w - x - y - z, w + x + y - z, w - x + y + z, w + x - y + z], axis=-1) / 2
    twice = np.stack([w + x + y + z, -w + x - y + z, -w + x + y - z, -w - x + y + z], axis=-1) / 2
    kept = np.array([[1, 2], [2, 0], [0, 1]])[thin]
    quats = np.choose(thin[:, None], [cycled, twice, quats])
    wide, least = np.take_along_axis(log_scales, kept, axis=1), log_scales.min(axis=1)
    return quats.astype(np.float32), wide, np.where(least > third_scales(wide), least, np.float32(-np.inf))


def round_ones(log_scales: np.ndarray) -> np.ndarray:
    """(M,) bool: Gaussians of (M, 2 or 3) scales whose thinnest axis is hardly thinner than the next."""
    if log_scales.shape[1] == 2:
        return np.zeros(len(log_scales), bool)
    thin, middle, _ = np.sort(log_scales, axis=1).T
    with np.errstate(invalid="ignore"):  # broken splats are left out later
        return thin - middle > np.log(ROUND)


_PROPERTIES = {
    r"beta(_\d+)?": "kernels of another shape, as in Deformable Beta Splatting",
    r"shape(_\d+)?": "kernels of another shape, as in Generalized Exponential Splatting",
    r"sb_params_.*": "colours by spherical Beta functions",
    r"sg_.*": "colours by spherical Gaussians",
    r"sv_.*": "colours by spherical Voronoi cells",
    r"trbf_.*|motion_\d+|omega_\d+": "splats that move, as in Spacetime Gaussians",
}
"""Properties by a pattern of their names, and what they change."""
_MODE = "splatrendermode:"
_PLAIN_MODES = ("default", "classic", "2dgs", "mip")
"""Modes that are read (:mod:`tron.gaussians.projections`)."""


def foreign_kernels(properties: Iterable[str], comments: Sequence[str]) -> list[str]:
    """Parts of a file that are not read and change how its splats look: "beta (kernels of another shape)".

    Args:
        properties: names of the vertex element's properties.
        comments: of the header.
    """
    names = list(properties)
    found = []
    for pattern, meaning in _PROPERTIES.items():
        matching = [name for name in names if re.fullmatch(pattern, name)]
        if matching:
            more = f" and {len(matching) - 1} more" if len(matching) > 1 else ""
            found.append(f"{matching[0]}{more} ({meaning})")
    for comment in comments:
        words = comment.split()
        if len(words) > 1 and words[0].lower() == _MODE and words[1].lower() not in _PLAIN_MODES:
            found.append(f"{comment.strip()[:60]} (splats filtered by the viewer's pixels)")
    return found


# Yu et al. 2024, "Mip-Splatting: Alias-free 3D Gaussian Splatting", section 4.1: each Gaussian, of
# covariance S, is convolved with an isotropic one of standard deviation f, its ``filter_3D``, and keeps its
# integral,
#
#     S' = S + f^2 I        opacity' = opacity sqrt(det S / det S')
#
# Files of its training hold f beside the unfiltered Gaussian; only the filtered one looks like the photos.


def smoothed(
    log_scales: np.ndarray, opacity_logits: np.ndarray, deviations: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Filtered logarithmic scales (M, A) and opacity logits (M,), float64.

    Args:
        log_scales: (M, A) natural logarithms; an axis of -infinity, of a flat splat, stays flat.
        opacity_logits: (M,).
        deviations: (M,) standard deviations f of the filter, in the units of the scales.
    """
    log_scales = np.asarray(log_scales, np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        filtered = 0.5 * np.logaddexp(2 * log_scales, 2 * np.log(np.abs(deviations))[:, None])
        filtered = np.where(np.isneginf(log_scales), log_scales, filtered)
        shrink = np.where(np.isneginf(log_scales), 0, log_scales - filtered).sum(1)
        log_opacity = log_expit(np.asarray(opacity_logits, np.float64)) + shrink
        logits = log_opacity - np.log(-np.expm1(log_opacity))
    return filtered, np.where(shrink == 0, opacity_logits, logits)


_MAGIC = b"\x1f\x8b"
_MOST_EXPANDED = 100
"""Times its size that a file may expand to; splats expand to 2 to 10 times theirs."""
_ALWAYS_ALLOWED = 1 << 26


def is_gzipped(path: Path) -> bool:
    """Whether a file begins as gzip's do; OSError if it cannot be read."""
    with open(path, "rb") as stream:
        return stream.read(len(_MAGIC)) == _MAGIC


def beginning(path: Path, n_bytes: int) -> bytes:
    """The first bytes of what a gzipped file holds, fewer if it holds less; TronError if it is damaged."""
    return _expanded(path, n_bytes)


def largest(path: Path) -> int:
    """The most bytes that a gzipped file may expand to."""
    return max(_ALWAYS_ALLOWED, _MOST_EXPANDED * path.stat().st_size)


def whole(path: Path) -> bytes:
    """Content of a gzipped file; TronError if it is damaged or expands beyond :func:`largest`."""
    limit = largest(path)
    data = _expanded(path, limit + 1)
    if len(data) > limit:
        raise TronError(f"expands to more than {_MOST_EXPANDED} times its size", path, "gunzip it yourself")
    return data


def _expanded(path: Path, n_bytes: int) -> bytes:
    try:
        with gzip.open(path) as stream:
            return stream.read(n_bytes)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise TronError(f"gzip file is cut short or damaged: {error}", path) from error


log = logging.getLogger(__name__)

OPAQUE_LOGIT = 15.0
"""What an opacity of exactly 1, whose logit is infinite, is stored as: 3e-7 below 1."""
_SHORTEST = 1e-6
"""Quaternions below this length are zero."""


def usable_splats(
    columns: Mapping[str, np.ndarray], scales: Sequence[str], colors: Sequence[str], path: Path
) -> dict[str, np.ndarray]:
    """The rows that are splats, infinite opacity logits clipped; one line in the log counts the others.

    Left out are rows whose opacity is 0 or NaN, whose position, rotation or colour is not finite, whose
    rotation is a zero quaternion, and whose extent is not finite or beyond float32. Of three scales the
    smallest may be zero, a logarithm of -infinity: a flat splat, as of 2DGS.

    Args:
        columns: of the file, (M,) each.
        scales: names of its two or three logarithmic scales.
        colors: names of its harmonics.
        path: the file, for the line.
    """

    def stack(names: Sequence[str]) -> np.ndarray:
        return np.stack([np.asarray(columns[name], np.float64) for name in names])

    logits = np.asarray(columns["opacity"], np.float32)
    opaque = np.isposinf(logits)
    rotations = stack(FIELDS["quats"].properties)
    extents = np.sort(stack(scales), axis=0)[-2:]  # NaN is sorted last
    with np.errstate(invalid="ignore", over="ignore"):
        turned = np.linalg.norm(rotations, axis=0) >= _SHORTEST
        sized = (np.abs(extents) <= LOG_SCALE_LIMIT).all(0)
    bad = {
        "opacity 0 or NaN": np.isnan(logits) | np.isneginf(logits),
        "position not finite": ~np.isfinite(stack(FIELDS["means"].properties)).all(0),
        "scale not finite or absurd": ~(sized & ~np.isnan(stack(scales)).any(0)),
        "zero or not finite rotation": ~(turned & np.isfinite(rotations).all(0)),
        "colour not finite": ~np.logical_and.reduce([np.isfinite(columns[name]) for name in colors]),
    }
    left_out = np.any(list(bad.values()), axis=0)
    if not (opaque.any() or left_out.any()):
        return dict(columns)
    said = []
    if opaque.any():
        said.append(f"{opaque.sum()} infinite opacities taken as opaque")
    if left_out.any():
        reasons = [f"{which.sum()} of {why}" for why, which in bad.items() if which.any()]
        said.append(f"{left_out.sum()} surfels left out ({', '.join(reasons)})")
    log.warning("%s: %s", path, ", ".join(said))
    clipped = dict(columns) | {"opacity": np.where(opaque, np.float32(OPAQUE_LOGIT), logits)}
    return {name: values[~left_out] for name, values in clipped.items()}


# nerfstudio's exporter writes ``Vertical Axis: z`` and means +z. Brush (ArthurBrussee/brush, brush-serde's
# export.rs and import.rs) spells it ``Vertical axis:``, after ``Exported from Brush``, and means -y by ``y``,
# -z by ``z`` and +x by ``x``; its newer files give the direction in three numbers.

_LETTERS = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
_BRUSH = _LETTERS | {"y": (0.0, -1.0, 0.0), "z": (0.0, 0.0, -1.0)}


def stated_up(comments: Sequence[str]) -> np.ndarray | None:
    """(3,) float64 unit up direction that a PLY's comments state; None where they state none."""
    brush = any(comment.lower().startswith("exported from brush") for comment in comments)
    for comment in comments:
        words = comment.split()
        if [word.lower() for word in words[:2]] != ["vertical", "axis:"]:
            continue
        letters = _BRUSH if brush or words[1] == "axis:" else _LETTERS
        up = letters.get(words[2].lower()) if len(words) == 3 else _numbers(words[2:])
        if up is not None:
            return np.array(up)
    return None


def _numbers(words: Sequence[str]) -> np.ndarray | None:
    """A (3,) unit vector of three words; None where they are no direction."""
    try:
        vector = np.array([float(word) for word in words])
    except ValueError:
        return None
    length = np.linalg.norm(vector)
    if vector.shape != (3,) or not (np.isfinite(length) and length > 0):
        return None
    return vector / length
