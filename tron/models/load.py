"""Models of meshes, glTF and OBJ, as textured parts that surfels can represent.

Textures become linear float32 images; materials are glTF's metallic-roughness, which :mod:`tron.brdf` has.
Surfels and shadow rays know opaque surfaces only, so transparency is decided once, here: what is below the
cut-off of alpha (one half where the material blends) is cut away, the rest becomes opaque. Path tracer,
G-buffers and reference then agree on what is there.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from tron.errors import TronError
from tron.io.recognised import refuse_placeholder
from tron.models.gltf.meshes import read_parts
from tron.models.obj import read_obj
from tron.models.parts import Part, split_mirrored, without_slivers

READERS = {".gltf": read_parts, ".glb": read_parts, ".obj": read_obj}
SUFFIXES = tuple(READERS)
MOST_TRIANGLES = 5_000_000

NEEDLE = 1e-3
"""Least width over length of a model: below it no pixel and no surfel would find it."""

_Y_UP_TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def load_model(path: str | Path, up: str = "y", *, fitted: bool = True) -> list[Part]:
    """Read a model; it comes out standing (z up) and fitted into the unit ball around the origin.

    Args:
        path: .gltf, .glb or .obj.
        up: the file's own up axis, ``y`` (glTF's rule, OBJ's habit) or ``z``.
        fitted: into the ball; otherwise it keeps its place and its units, metres in glTF.

    Raises:
        TronError: a file that is missing, damaged, too large, refers to what lies outside its folder, needs
            what is not read, or has nothing to show.
    """
    path = Path(path)
    if not path.is_file():
        raise TronError("model not found", path)
    refuse_placeholder(path)
    try:
        parts = READERS.get(path.suffix.lower(), read_parts)(path, MOST_TRIANGLES)
        return _standing(parts, up, fitted)
    except TronError as error:
        raise TronError(error.what, error.where or path, error.mend) from error
    except Exception as error:  # trimesh, DracoPy and damaged JSON raise whatever they stumble over
        raise TronError(f"model cannot be read: {type(error).__name__}: {error}", path) from error


def _standing(parts: list[Part], up: str, fitted: bool) -> list[Part]:
    """Parts with area, z up, in the unit ball or as they are."""
    with np.errstate(all="ignore"):  # overflow is found below
        parts = [part for part in map(without_slivers, parts) if len(part.faces)]
    if not parts:
        raise TronError("model has no opaque triangles")
    if sum(len(part.faces) for part in parts) > MOST_TRIANGLES:
        raise TronError(f"model has more than {MOST_TRIANGLES:,} triangles", mend="simplify it")
    if not all(np.isfinite(part.vertices).all() for part in parts):
        raise TronError("model has vertices that are not finite")
    if any(part.uv is not None and not np.isfinite(part.uv).all() for part in parts):
        raise TronError("model has texture coordinates that are not finite")
    turn = _Y_UP_TO_Z_UP if up == "y" else np.eye(3)
    parts = [replace(p, vertices=p.vertices @ turn.T, normals=p.normals @ turn.T) for p in parts]
    used = np.concatenate([part.vertices for part in parts])
    centre = 0.5 * used.min(axis=0) + 0.5 * used.max(axis=0)
    with np.errstate(over="ignore"):
        radius = float(np.linalg.norm(used - centre, axis=1).max())
    if not 0 < radius < np.inf:
        raise TronError("model has no extent, or more than numbers hold")
    if fitted:
        parts = [replace(part, vertices=(part.vertices - centre) / radius) for part in parts]
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(((used - centre) / radius).T)), 0.0))
    if spread[1] < NEEDLE * spread[2]:
        raise TronError(f"model is {spread[2] / max(spread[1], 1e-30):,.0f} times longer than wide: a needle")
    return [piece for part in parts for piece in split_mirrored(part)]
