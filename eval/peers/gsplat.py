"""A peer for camera rays on NVIDIA GPUs: gsplat's rasteriser of 2D Gaussians (2DGS), where it is installed.

It projects where we trace, composites both sides of a surfel, ends at transmittance 1e-4, and gathers colour,
normal and depth. It comes with the extra ``gpu-peers``, which a machine without a GPU has no use for.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np

from tron.cameras import Camera
from tron.gaussians.scene import GaussianScene


def available() -> bool:
    """Whether gsplat is installed, torch sees a GPU, and the tracer runs on it too."""
    if not (mi.variant() or "").startswith("cuda") or importlib.util.find_spec("gsplat") is None:
        return False
    import torch

    return torch.cuda.is_available()


def renderer(scene: GaussianScene, camera: Camera) -> Callable[[], Any]:
    """A call that renders one frame with harmonics of degree 0 and waits for the device."""
    import torch
    from gsplat import rasterization_2dgs  # pyright: ignore

    def device(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, np.float32)).cuda()

    scales = scene.scales()
    arguments = {
        "means": device(scene.means),
        "quats": device(scene.quats),
        "scales": device(np.concatenate([scales, np.ones_like(scales[:, :1])], 1)),
        "opacities": device(scene.opacities()),
        "colors": device(scene.sh[:, :1]),
        "sh_degree": 0,
        "viewmats": device(camera.world_to_camera)[None],
        "Ks": device(np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]))[None],
        "width": camera.width,
        "height": camera.height,
    }

    def render() -> None:
        with torch.no_grad():
            rasterization_2dgs(**arguments)
        torch.cuda.synchronize()

    return render
