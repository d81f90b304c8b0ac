"""USD's ParticleField3DGaussianSplat (OpenUSD 26.03 and after), by usd-core.

A file is read in a process of its own (:mod:`tron.gaussians.formats.usd_process`) with a limit on memory, and
only if all that it refers to lies inside it, in its folder or below.
"""

# usd-core has no types.
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import io
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from scipy.special import expit

from tron.errors import TronError
from tron.gaussians.formats.splats import Y_UP, Z_UP, Splats, joined, logarithms, logits, one_line
from tron.gaussians.harmonics import SH_COUNT, dc_to_rgb
from tron.io import optional

_STARTS = {".usdz": (b"PK\x03\x04",), ".usdc": (b"PXR-USDC",), ".usda": (b"#usda",)}
_ANY = (b"PXR-USDC", b"#usda")
_MOST_EXPANDED = 100
"""Times a file's size that it may expand to: crates pack numbers 1 to 10 times."""
_ALWAYS_ALLOWED = 1 << 31


def check(path: Path) -> None:
    """Raise TronError unless usd-core is there and a file begins as its name says."""
    with one_line(path), path.open("rb") as stream:
        if not stream.read(8).startswith(_STARTS.get(path.suffix.lower(), _ANY)):
            raise TronError("not USD, by what it begins with", path, "copy or export it again")
    optional.usd(str(path))


def read(path: Path) -> Splats:
    """All splats of a stage, in its own up axis.

    Raises:
        TronError: it holds none, refers to what lies elsewhere, or is damaged.
    """
    check(path)
    import pxr

    memory = max(_ALWAYS_ALLOWED, _MOST_EXPANDED * path.stat().st_size)
    site, process = Path(next(iter(pxr.__path__))).parent, Path(__file__).with_name("usd_process.py")
    words = [sys.executable, "-I", str(process), str(site), str(path.resolve()), str(memory)]
    done = subprocess.run(words, capture_output=True, stdin=subprocess.DEVNULL)
    if done.returncode or not done.stdout:
        said = done.stderr.decode("utf-8", "replace").strip().splitlines()
        if done.returncode < 0 or not said:
            said = [f"it is damaged: the reader ended with signal {-done.returncode}"]
        raise TronError(said[-1].removeprefix("SystemExit: ")[:300], path)
    with one_line(path):
        held = np.load(io.BytesIO(done.stdout), allow_pickle=False)
        up = Z_UP if held["z_up"] else Y_UP
        return joined([_of_prim(held, str(k), path) for k in range(int(held["count"]))], up)


def _of_prim(held: np.lib.npyio.NpzFile, key: str, path: Path) -> Splats:
    means = held[f"{key}.positions"]
    return Splats(
        means=means,
        quats=held[f"{key}.orientations"][:, [3, 0, 1, 2]],
        log_scales=logarithms(held[f"{key}.scales"], path),
        opacity_logits=logits(held[f"{key}.opacities"], path),
        sh=held[f"{key}.coefficients"].reshape(len(means), -1, 3),
    ).placed(held[f"{key}.matrix"])


def write(splats: Splats, suffix: str) -> bytes:
    """A file of splats of degree 3, y up: .usda, .usdc, .usd or .usdz."""
    optional.usd("USD")
    from pxr import Sdf, Usd, UsdGeom, UsdUtils, UsdVol, Vt

    with tempfile.TemporaryDirectory(prefix="tron-") as folder:
        layer = Path(folder) / f"splats{'.usdc' if suffix == '.usdz' else suffix}"
        stage = Usd.Stage.CreateNew(str(layer))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        field = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/splats")
        stage.SetDefaultPrim(field.GetPrim())
        means, scales = splats.means.astype(np.float32), np.exp(splats.log_scales).astype(np.float32)
        field.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(means))
        xyzw = splats.quats[:, [1, 2, 3, 0]].astype(np.float32)
        field.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(np.ascontiguousarray(xyzw)))
        field.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(scales))
        field.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(expit(splats.opacity_logits).astype(np.float32)))
        field.CreateRadianceSphericalHarmonicsDegreeAttr(3)
        sh = np.ascontiguousarray(splats.sh.reshape(-1, 3), np.float32)
        harmonics = field.CreateRadianceSphericalHarmonicsCoefficientsAttr(Vt.Vec3fArray.FromNumpy(sh))
        UsdGeom.Primvar(harmonics).SetElementSize(SH_COUNT)
        UsdGeom.Primvar(harmonics).SetInterpolation(UsdGeom.Tokens.vertex)
        wide = 3 * scales.max(axis=1, keepdims=True)
        extent = np.stack([(means - wide).min(0), (means + wide).max(0)])
        UsdGeom.Boundable(field.GetPrim()).CreateExtentAttr(Vt.Vec3fArray.FromNumpy(extent))
        shown = np.clip(dc_to_rgb(splats.sh[:, 0]), 0, 1).astype(np.float32)
        color = UsdGeom.PrimvarsAPI(field.GetPrim()).CreatePrimvar(
            "displayColor", Sdf.ValueTypeNames.Color3fArray, UsdGeom.Tokens.vertex
        )
        color.Set(Vt.Vec3fArray.FromNumpy(shown))
        stage.GetRootLayer().Save()
        if suffix != ".usdz":
            return layer.read_bytes()
        package = Path(folder) / "splats.usdz"
        UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(layer)), str(package))
        return package.read_bytes()
