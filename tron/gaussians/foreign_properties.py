"""Properties that other programs give their splats: names, colours as bytes, and materials of their own.

CloudCompare writes ``scalar_`` before every name. nerfstudio's ``ns-export gaussian-splat --ply-color-mode
rgb`` writes red, green and blue in place of f_dc. Programs that relight splats keep materials beside them,
which are numbers of their training (logits), in conventions of their own: their splats are read as a plain
scan, whose materials are found here.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.special import expit

from tron.errors import TronError
from tron.gaussians.fields import FIELDS, MATERIALS
from tron.gaussians.harmonics import rgb_to_dc

log = logging.getLogger(__name__)

_PREFIX = "scalar_"
_BYTES = ("red", "green", "blue")
_COLORS = FIELDS["sh"].properties
_OURS = tuple(name for material in MATERIALS for name in FIELDS[material].properties)
_SHAPE = ("opacity", *FIELDS["log_scales"].properties, *FIELDS["quats"].properties)


class Relighter(NamedTuple):
    """A program that keeps materials with its splats.

    Attributes:
        title: of the program and its kind.
        has: properties by which it is known, the first of each numbered one.
    """

    title: str
    has: tuple[str, ...]


_RELIGHTERS = (
    Relighter("Relightable3DGaussian", ("base_color_0", "roughness", "incidents_dc_0")),
    Relighter("Ref-Gaussian", ("base_color_0", "roughness", "metallic", "ind_dc_0")),
    Relighter("GS-IR", ("albedo_0", "roughness", "metallic", "normal_0")),
    Relighter("GaussianShader", ("roughness", "specular0", "nx2")),
    Relighter("3DGS-DR or one of its kind", ("refl_strength",)),
    Relighter("a program of the kind of GS-IR", ("albedo_0", "roughness")),
    Relighter("a program of the kind of Relightable3DGaussian", ("base_color_0", "roughness")),
)
"""Of several the first holds. Names are those of the programs' save_ply: NJU-3DV/Relightable3DGaussian,
fudan-zvg/ref-gaussian, lzhnb/GS-IR, Asparagus15/GaussianShader, gapszju/3DGS-DR."""
_SHADER = "GaussianShader"


def plain_name(name: str) -> str:
    """The name that 3DGS has for a property: without CloudCompare's prefix."""
    bare = name.removeprefix(_PREFIX)
    known = (*FIELDS["means"].properties, *_COLORS, *_SHAPE, "scale_2")
    return bare if bare in known or bare.startswith("f_rest_") else name


def plain_names(names: Collection[str]) -> set[str]:
    """Names of a file's columns once :func:`plain_columns` has read them."""
    found = {plain_name(name) for name in names}
    return found | set(_COLORS) if found.issuperset(_BYTES) and found.issuperset(_SHAPE) else found


def refuse_points(elements: Sequence[str], names: Collection[str], path: Path) -> None:
    """Raise TronError if the elements and vertex properties of a PLY are those of a mesh or of points."""
    found = plain_names(names)
    if not found.isdisjoint((*_SHAPE, *_COLORS)) or not found.issuperset(FIELDS["means"].properties):
        return
    if "face" in elements or "tristrips" in elements:
        mend = "as .glb it is put beside a scene: tron-relight meshes=[{file: MODEL.glb}]"
        raise TronError("a mesh, not splats", path, mend)
    mend = "give the splats that were trained from them, or reconstruct the photos: tron-reconstruct"
    raise TronError("a cloud of points, not splats", path, mend)


def plain_columns(columns: Mapping[str, np.ndarray], ours: bool, path: Path) -> dict[str, np.ndarray]:
    """The columns of a file by the names of 3DGS, without materials that are not TRON's.

    Args:
        columns: as the file has them.
        ours: whether TRON wrote the file, whose materials are kept.
        path: the file, for the line.
    """
    found = {plain_name(name): values for name, values in columns.items()}
    if not found.keys() >= set(_COLORS) and found.keys() >= {*_BYTES, *_SHAPE}:
        stored = np.stack([found[name] for name in _BYTES], axis=-1)
        values = stored.astype(np.float32) / (255 if np.issubdtype(stored.dtype, np.integer) else 1)
        found |= dict(zip(_COLORS, rgb_to_dc(values).astype(np.float32).T))
        log.info("%s: its colours are red, green and blue, the same from all sides", path)
    program = None if ours else _relighter(found.keys())
    if program is None:
        return found
    if program == _SHADER:
        found = _of_shader(found)
    log.warning(
        "%s has materials of %s, whose numbers mean something else here: it is read as a plain scan%s",
        path, program,
        ", in its diffuse colours without its light" if program == _SHADER else "",
    )  # fmt: skip
    return {name: values for name, values in found.items() if name not in _OURS}


def _relighter(names: Collection[str]) -> str | None:
    """Which program wrote these properties; None of plain scans and of materials as TRON has them."""
    program = next((each.title for each in _RELIGHTERS if set(each.has) <= set(names)), None)
    return program if program != _RELIGHTERS[-1].title or "metallic" not in names else None


def _of_shader(columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Diffuse colours of GaussianShader's f_dc, which are no harmonics: display values sigmoid(f_dc - ln 3).

    Its scene/NVDIFFREC/light.py, ``shade``: what its light adds to them is not in the file.
    """
    kept = {name: values for name, values in columns.items() if not name.startswith("f_rest_")}
    colors = {
        name: rgb_to_dc(expit(np.asarray(columns[name], np.float64) - np.log(3))).astype(np.float32)
        for name in _COLORS
    }
    return kept | colors
