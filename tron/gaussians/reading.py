"""What a file of splats becomes: values made usable, its materials guessed, its up, in a local frame."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import expit, log_expit

from tron.color import srgb_to_linear
from tron.errors import TronError
from tron.gaussians.fields import FIELDS, LOG_SCALE_LIMIT, MATERIALS, third_scales
from tron.gaussians.foreign_properties import plain_columns
from tron.gaussians.formats.registry import check_header
from tron.gaussians.harmonics import SH_COUNT, dc_to_rgb
from tron.gaussians.ply import (
    EMISSION_PROPERTIES,
    EXPORT,
    GUESSED_UP,
    MATERIAL_PROPERTIES,
    REQUIRED,
    REST,
    THIRD_SCALE,
    constants_of,
    projection_of,
)
from tron.gaussians.projections import FILTER
from tron.gaussians.stored_values import as_3dgs_stores
from tron.io.local_frame import local_origin, said

log = logging.getLogger(__name__)

# What a Gaussian without materials is taken to be made of: a rough dielectric in its own colours.
GUESSED_ROUGHNESS = 0.6
GUESSED_METALLIC = 0.0
_VISIBLE = 1 / 255
"""Opacity below which a splat is not drawn (conventions.md, 6)."""
_COARSE = 0.25
"""Steps of stored positions, in widths of splats, from which they are seen."""


def read_splats(path: str | Path) -> dict[str, Any]:
    """Attributes of the GaussianScene in a file of splats; ``spacing`` only if the file says it.

    Of three scales the smallest is the thickness, and the rotation is permuted, so that the normal is the
    axis along which the Gaussian was thinnest; ``round_ones`` (M,) bool tells where there is no such axis.
    Quaternions are normalised. f_rest of degree 0 to 3 is accepted. A file without materials gets guessed
    ones (base colour from the mean colour, rough, not metallic) and says so in `materials_guessed`; a file
    that is not TRON's has unoriented normals (`oriented` is False) and kernel degree 2. Up is what a comment
    says, TRON's or another's (:func:`stated_up`); where none does it is -y, and
    `up_guessed` is True. Mip-Splatting's ``filter_3D`` is folded in. An opacity logit of +infinity means
    opaque; splats that are broken are left out (:func:`usable_splats`). The middle of large
    coordinates is taken away in float64, and is in `offset` (:mod:`tron.io.local_frame`). Each of these says
    so in one line.

    The file is of one of :data:`tron.gaussians.formats.registry.FORMATS`. ``turn`` (3, 3) leads from the
    frame of a file of .spz into that of 3DGS' PLYs (:mod:`tron.gaussians.formats.spz`): a rotation or a
    mirror image. Where the file does not state its frame, `up_guessed` is True. glTF and USD say what is up.

    Raises:
        TronError: files that are missing, are neither a PLY nor packed splats, lack properties (named),
            declare more than they hold, expand without limit, or hold no splat.
    """
    path = Path(path)
    stored = check_header(path).splats(path)
    comments, turn = stored.comments, stored.turn
    up = stated_up(comments) if stored.up is None else stored.up
    constants = constants_of(comments, path)
    columns = plain_columns(stored.columns, bool(constants), path)
    _check_properties(columns, comments, path)
    scales = [name for name in (*FIELDS["log_scales"].properties, THIRD_SCALE) if name in columns]
    if not constants:
        columns = as_3dgs_stores(columns, scales, path)
    # Before they are smoothed: a filter much wider than a splat hides its axes, not where it faces.
    columns["round_ones"] = round_ones(np.stack([columns[name] for name in scales], axis=-1))
    if FILTER in columns:
        columns = _filtered(columns, scales, path)
    colors = [name for name in (*FIELDS["sh"].properties, *REST) if name in columns]
    columns = usable_splats(columns, scales, colors, path)

    def stack(names: Sequence[str]) -> np.ndarray:
        return np.stack([np.asarray(columns[name], dtype=np.float32) for name in names], axis=-1)

    def field(name: str) -> np.ndarray:
        values = stack(FIELDS[name].properties)
        return values if FIELDS[name].shape else values[:, 0]

    if not len(columns["x"]):
        raise TronError("the scene has no surfels", path)
    offset = constants.get("offset", [0.0, 0.0, 0.0])
    means = field("means")
    # Where a file of TRON's stands was decided when it was written, but where its coordinates were put back.
    if not constants or columns["x"].dtype == np.float64:
        means, offset = _about_local_origin(columns, path)
    quats, log_scales, log_thickness = thin_last(field("quats"), stack(scales))
    sh = _harmonics(columns, stack, path)
    guessed = MATERIAL_PROPERTIES[0] not in columns
    stated, oriented = constants.get("up", up), bool(constants.get("oriented", [0])[0])
    ours = bool(constants) and oriented
    return {
        "means": means,
        "quats": quats,
        "log_scales": log_scales,
        "log_thickness": log_thickness,
        "round_ones": columns["round_ones"],
        "opacity_logits": field("opacity_logits"),
        "sh": sh,
        **(_guess(sh) if guessed else {name: field(name) for name in MATERIALS}),
        "object_id": _object_id(columns, len(means), path),
        **({"emission": field("emission")} if EMISSION_PROPERTIES[0] in columns else {}),
        "kernel_degree": int(constants.get("kernel_degree", [2])[0]),
        **({"spacing": constants["spacing"][0]} if "spacing" in constants else {}),
        "turn": turn,
        "up": np.array(GUESSED_UP if stated is None else stated),
        "up_guessed": stated is None or not stored.up_known or bool(constants.get("up_guessed", [0])[0]),
        "materials_guessed": guessed or bool(constants.get("materials_guessed", [0])[0]),
        "oriented": oriented,
        "offset": np.array(offset),
        "projection": projection_of(columns, comments, ours, stored.antialiased, path),
    }


def _filtered(columns: dict[str, np.ndarray], scales: Sequence[str], path: Path) -> dict[str, np.ndarray]:
    """The columns with the 3D smoothing filter in scales and opacity."""
    log_scales = np.stack([columns[name] for name in scales], axis=-1)
    widened, logits = smoothed(log_scales, columns["opacity"], columns[FILTER])
    before, after = (float(np.nanmedian(expit(each))) for each in (columns["opacity"], logits))
    log.log(
        logging.INFO if after >= _VISIBLE else logging.WARNING,
        "%s: %s of Mip-Splatting is taken into scales and opacities, whose median goes from %.2g to %.2g%s",
        path, FILTER, before, after, "" if after >= _VISIBLE else ": most splats cannot be seen",
    )  # fmt: skip
    return columns | dict(zip(scales, widened.T)) | {"opacity": logits}


def _about_local_origin(columns: Mapping[str, np.ndarray], path: Path) -> tuple[np.ndarray, np.ndarray]:
    """(M, 3) float32 positions about a local origin, and the (3,) float64 offset that was taken away."""
    stored = [columns[axis] for axis in FIELDS["means"].properties]
    positions = np.stack(stored, axis=-1).astype(np.float64)
    wide = float(np.median(np.exp(np.asarray(columns["scale_0"], np.float64))))
    offset = local_origin(positions, _COARSE * wide)
    if offset.any():
        log.info("%s: large coordinates: %s is taken away from them and kept", path, said(offset))
        step = max(float(np.spacing(np.abs(each).max())) for each in stored)
        if step > _COARSE * wide:
            log.warning(
                "%s: its positions are stored in steps of %.2g, its splats are %.2g wide: surfaces fall into "
                "slices; export it with positions in doubles or about a local origin", path, step, wide,
            )  # fmt: skip
    return (positions - offset).astype(np.float32), offset


def _check_properties(columns: dict[str, np.ndarray], comments: Sequence[str], path: Path) -> None:
    foreign = ", ".join(foreign_kernels(columns, comments))
    missing = [name for name in REQUIRED if name not in columns]
    if missing:
        made = f"made for {foreign}: export it as plain 3DGS" if foreign else EXPORT
        raise TronError(f"the PLY lacks {', '.join(missing)}", path, made)
    read = (*REQUIRED, *REST, *MATERIAL_PROPERTIES, *EMISSION_PROPERTIES, THIRD_SCALE, FILTER, "object_id")
    for name, values in columns.items():
        if values.dtype == object and name in read:
            raise TronError(f"property {name} is a list", path, EXPORT)
    if foreign:
        log.warning("%s: %s: %s", path, "not read, so that it may look different here", foreign)
    for together in (MATERIAL_PROPERTIES, EMISSION_PROPERTIES):
        present = [name for name in together if name in columns]
        absent = ", ".join(name for name in together if name not in columns)
        if present and absent:
            raise TronError(f"the PLY has {present[0]} but lacks {absent}", path, "write all of them or none")


def _guess(sh: np.ndarray) -> dict[str, np.ndarray]:
    """Materials of Gaussians known by colour alone."""
    return {
        "base_color": srgb_to_linear(np.clip(dc_to_rgb(sh[:, 0]), 0, 1)),
        "roughness": np.full(len(sh), GUESSED_ROUGHNESS),
        "metallic": np.full(len(sh), GUESSED_METALLIC),
    }


def _harmonics(
    columns: dict[str, np.ndarray], stack: Callable[[Sequence[str]], np.ndarray], path: Path
) -> np.ndarray:
    """(M, 16, 3) coefficients; degrees that the file does not have are zero."""
    dc = stack(FIELDS["sh"].properties)
    sh = np.zeros((len(dc), SH_COUNT, 3), np.float32)
    sh[:, 0] = dc
    count = sum(name.startswith("f_rest_") for name in columns)
    if count not in (0, 9, 24, 45) or any(name not in columns for name in REST[:count]):
        raise TronError(f"the PLY has {count} f_rest properties", path, "degrees 0 to 3 have 0, 9, 24 or 45")
    bands = count // 3
    if bands:
        sh[:, 1 : 1 + bands] = stack(REST[: 3 * bands]).reshape(len(dc), 3, bands).transpose(0, 2, 1)
    return sh


def _object_id(columns: dict[str, np.ndarray], count: int, path: Path) -> np.ndarray:
    if "object_id" not in columns:
        return np.zeros(count, np.int32)
    values = np.asarray(columns["object_id"], dtype=np.float64)
    whole = np.abs(values) < 2**31
    if not whole.all():
        raise TronError(f"object_id of surfel {int((~whole).argmax())} is no 32-bit number", path)
    return values.astype(np.int32)


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
