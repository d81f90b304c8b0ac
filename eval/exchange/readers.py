"""Independent readers of splat files: each converts a file into a plain 3DGS PLY.

They share no code with TRON. PlayCanvas's splat-transform (npm) converts by itself; usd-core and trimesh read
a USD or a glTF, and the PLY is written here as 3DGS's own reader needs it (Kerbl et al. 2023).
"""

# usd-core has no types.
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import plyfile
import trimesh
from scipy.special import logit
from trimesh.exchange.gltf.extensions import register_handler

from tron.errors import TronError
from tron.io.optional import usd

INSTALL = "npm install -g @playcanvas/splat-transform, or give benchmark.splat_transform"
EXTENSION = "KHR_gaussian_splatting"
_PATIENCE = 300
"""Seconds that a program has for a file."""
_HARMONICS = [f"SH_DEGREE_{degree}_COEF_{n}" for degree in range(4) for n in range(2 * degree + 1)]


def find_splat_transform(given: Path | None) -> Path | None:
    """Return the given program, or the one on PATH; None if there is none.

    Raises:
        TronError: the given program does not exist.
    """
    if given is None:
        found = shutil.which("splat-transform")
        return None if found is None else Path(found)
    if not given.is_file():
        raise TronError("no such program", given, INSTALL)
    return given.absolute()


def splat_transform(program: Path, source: Path, target: Path) -> None:
    """Convert a file by splat-transform, which recognises both formats by their suffixes.

    Raises:
        TronError: it fails; the error has its last output.
    """
    words = [str(program), "-w", "-q", "-g", "cpu", str(source), str(target)]
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=_PATIENCE, errors="replace")
    except (OSError, subprocess.TimeoutExpired) as error:
        raise TronError(f"cannot be run: {error}", program, INSTALL) from error
    if done.returncode or not target.is_file():
        said = (done.stderr or done.stdout).strip().splitlines()
        raise TronError(
            f"splat-transform cannot convert it: {said[-1] if said else 'without a word'}", source
        )


def splat_transform_version(program: Path) -> str:
    """Return the version that the program prints.

    Raises:
        TronError: it cannot be run.
    """
    try:
        done = subprocess.run([str(program), "--version"], capture_output=True, text=True, timeout=60)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise TronError(f"cannot be run: {error}", program, INSTALL) from error
    said = (done.stdout + done.stderr).strip().splitlines()
    if done.returncode or not said or "splat-transform" not in said[0]:
        raise TronError("is not splat-transform", program, INSTALL)
    return said[0]


def usd_core(source: Path, target: Path) -> None:
    """Convert the only splat prim of a USD into a PLY, by the schema's own accessors.

    Raises:
        TronError: usd-core is not installed, or the stage has no such prim.
    """
    usd(str(source))
    from pxr import Usd, UsdVol

    stage = Usd.Stage.Open(str(source))
    prims = [prim for prim in stage.Traverse() if prim.IsA(UsdVol.ParticleField3DGaussianSplat)]
    if len(prims) != 1:
        raise TronError(f"holds {len(prims)} prims of splats", source)
    field = UsdVol.ParticleField3DGaussianSplat(prims[0])
    turns = [(q.GetReal(), *q.GetImaginary()) for q in field.GetOrientationsAttr().Get()]
    means = np.array(field.GetPositionsAttr().Get())
    harmonics = np.array(field.GetRadianceSphericalHarmonicsCoefficientsAttr().Get())
    write_3dgs(
        target,
        means=means,
        quats=np.array(turns),
        scales=np.array(field.GetScalesAttr().Get()),
        opacities=np.array(field.GetOpacitiesAttr().Get()),
        sh=harmonics.reshape(len(means), -1, 3),
    )


_CAUGHT: list[dict[str, np.ndarray]] = []


@register_handler(EXTENSION, scope="primitive_preprocess")
def _catch(context: Mapping[str, Any]) -> None:
    """Receive a primitive and its decoded accessors from trimesh's hook for unknown extensions."""
    attributes = context["primitive"]["attributes"]
    _CAUGHT.append({name: np.array(context["accessors"][k]) for name, k in attributes.items()})


def trimesh_gltf(source: Path, target: Path) -> None:
    """Convert the only splat primitive of a glTF into a PLY, by trimesh's accessors.

    Raises:
        TronError: the file has no splat primitive, or several.
    """
    _CAUGHT.clear()
    trimesh.load_scene(source)
    if len(_CAUGHT) != 1:
        raise TronError(f"holds {len(_CAUGHT)} primitives of splats", source)
    held = _CAUGHT.pop()
    write_3dgs(
        target,
        means=held["POSITION"],
        quats=held[f"{EXTENSION}:ROTATION"][:, [3, 0, 1, 2]],
        scales=held[f"{EXTENSION}:SCALE"],
        opacities=held[f"{EXTENSION}:OPACITY"].ravel(),
        sh=np.stack([held[f"{EXTENSION}:{name}"] for name in _HARMONICS], axis=1),
    )


def write_3dgs(
    path: Path,
    *,
    means: np.ndarray,
    quats: np.ndarray,
    scales: np.ndarray,
    opacities: np.ndarray,
    sh: np.ndarray,
) -> None:
    """Write splats as 3DGS's reference code does.

    Args:
        path: the PLY.
        means: (M, 3).
        quats: (M, 4) (w, x, y, z).
        scales: (M, 3), not their logarithms.
        opacities: (M,) in [0, 1].
        sh: (M, 16, 3); files have them channel by channel.
    """
    end = np.finfo(np.float32).eps
    columns = dict(zip("xyz", means.T))
    columns |= {f"f_dc_{k}": sh[:, 0, k] for k in range(3)}
    columns |= {f"f_rest_{k}": each for k, each in enumerate(sh[:, 1:].transpose(2, 1, 0).reshape(45, -1))}
    columns["opacity"] = logit(np.clip(opacities.astype(np.float64), end, 1 - end))
    columns |= {f"scale_{k}": each for k, each in enumerate(np.log(scales.astype(np.float64)).T)}
    columns |= {f"rot_{k}": each for k, each in enumerate(quats.T)}
    rows = np.empty(len(means), [(name, "<f4") for name in columns])
    for name, values in columns.items():
        rows[name] = values
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")], byte_order="<").write(str(path))
