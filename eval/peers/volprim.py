"""The peer for camera rays: Mitsuba's ``volprim_rf_basic`` on its ellipsoids, with the same surfels.

The shipped integrator stops where transmittance falls below 0.01, and its density is the Gaussian of degree
2, both written in its source. For equal work :func:`load_integrator` can run that source with that number
and the line of the density replaced; nothing else of it changes. What cannot be made equal: its primitives
are 3D Gaussians, here very flat ones, met in the order in which rays enter their hulls; they have no front
side, so both sides are composited; it gathers radiance alone, no normals, materials or depths; and it starts
again 1e-4 behind each hit, which skips primitives that nearly coincide.
"""

from __future__ import annotations

import importlib.util
import inspect
import tempfile
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from tron.cameras import Camera, mitsuba_sensor
from tron.errors import TronError
from tron.gaussians.scene import GaussianScene
from tron.tracing.compositing import STOP_TRANSMITTANCE

SHAPES = ("ellipsoids", "ellipsoidsmesh")
SHIPPED_STOP = 0.01
OUR_STOP = STOP_TRANSMITTANCE
THINNESS = 0.02
"""Third scale over the smaller of the surfel's two: as flat as the peer's own arithmetic bears."""
MAX_DEPTH = 128
_STOP_LINE = "dr.max(β) > 0.01"
_GAUSSIAN = "dr.exp(-0.5 * (p.x**2 / scale.x**2 + p.y**2 / scale.y**2 + p.z**2 / scale.z**2))"
_DENSITIES = {
    2: _GAUSSIAN,
    # As in tron.tracing.kernel: both reach the same value at three sigma, where the hull ends.
    4: "dr.exp(-(4.5 / 81) * dr.square(p.x**2 / scale.x**2 + p.y**2 / scale.y**2 + p.z**2 / scale.z**2))",
}
"""Kernel degree -> how the peer's source computes density."""


def load_integrator(stop: float = SHIPPED_STOP, degree: int = 2) -> Any:
    """The shipped integrator, or the same source with another stop or kernel; it takes colours as they are.

    Args:
        stop: transmittance below which a ray ends.
        degree: of the kernel, 2 (as shipped) or 4.

    Raises:
        TronError: this Mitsuba's source no longer holds the lines to be replaced.
    """
    from mitsuba.ad.integrators import volprim_rf_basic as shipped  # pyright: ignore[reportMissingImports]

    name = "volprim_rf_basic"
    if (stop, degree) != (SHIPPED_STOP, 2):
        name = f"volprim_rf_basic_{stop:g}_degree{degree}"
        source = inspect.getsource(shipped)
        if source.count(_STOP_LINE) != 1 or source.count(_GAUSSIAN) != 1:
            raise TronError(
                "this Mitsuba's volprim_rf_basic ends rays, or computes density, in another way",
                shipped.__file__,
            )
        source = source.replace(_STOP_LINE, f"dr.max(β) > {stop:g}").replace(_GAUSSIAN, _DENSITIES[degree])
        source = source.replace('register_integrator("volprim_rf_basic"', f'register_integrator("{name}"')
        _import_beside(shipped, source, name.replace(".", "_").replace("-", "_"))
    return mi.load_dict({"type": name, "max_depth": MAX_DEPTH, "srgb_primitives": False})


def _import_beside(shipped: Any, source: str, name: str) -> None:
    """Run changed source as a sibling of a module; Dr.Jit reads it again, so it must stand in a file."""
    package = shipped.__name__.rpartition(".")[0]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{name}.py"
        path.write_text(source, encoding="utf-8")
        spec = importlib.util.spec_from_file_location(f"{package}.{name}", path)
        assert spec is not None
        assert spec.loader is not None
        spec.loader.exec_module(importlib.util.module_from_spec(spec))


def primitives(scene: GaussianScene, sh_degree: int, shape: str = "ellipsoids") -> mi.Scene:
    """The surfels as flat ellipsoids in a Mitsuba scene, harmonics up to ``sh_degree``."""
    scales = scene.scales()
    flat = np.concatenate([scales, THINNESS * scales.min(1, keepdims=True)], 1)
    coefficients = scene.sh[:, : (sh_degree + 1) ** 2].reshape(len(scene), -1)
    tensors = {
        "centers": scene.means,
        "scales": flat,
        "quaternions": scene.quats[:, [1, 2, 3, 0]],
        "opacities": scene.opacities()[:, None],
        "sh_coeffs": coefficients,
    }
    columns = {name: mi.TensorXf(np.ascontiguousarray(v, np.float32)) for name, v in tensors.items()}
    return mi.load_dict({"type": "scene", "surfels": {"type": shape, "extent": 3.0, **columns}})


def sensor(camera: Camera) -> mi.Sensor:
    """The camera with a box filter and one sample a pixel."""
    return mi.load_dict(mitsuba_sensor(camera, spp=1))


def render(scene: mi.Scene, view: mi.Sensor, integrator: Any) -> mi.TensorXf:
    """One frame as a user renders it: one ray a pixel, somewhere in the pixel."""
    return mi.render(scene, sensor=view, integrator=integrator, spp=1)


def through_centres(scene: mi.Scene, integrator: Any, camera: Camera) -> np.ndarray:
    """(H, W, 3) float32 radiance along the rays through the pixel centres: for comparing, not for timing."""
    import drjit as dr

    rays = np.ascontiguousarray(camera.rays().reshape(-1, 3).T, np.float32)
    origin = dr.repeat(mi.Point3f([float(x) for x in camera.position]), rays.shape[1])
    sampler = mi.load_dict({"type": "independent", "sample_count": 1})
    sampler.seed(0, rays.shape[1])
    color, *_ = integrator.sample(
        dr.ADMode.Primal, scene, sampler, mi.Ray3f(origin, mi.Vector3f(rays)), None, None, mi.Bool(True)
    )
    return np.array(color).T.reshape(camera.height, camera.width, 3)
