"""Surfels held by torch, rendered by Dr.Jit: torch's losses and optimisers drive the tracer.

One step of a reconstruction::

    surfels = tensors_of(scene)                                   # or dict(an nn.ParameterDict)
    optimiser = torch.optim.Adam(surfels.values(), 1e-3, eps=1e-15)
    for camera, photo in views:
        seen = render(surfels, camera)
        loss = (seen["rgb"] - photo).abs().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()

Nothing is copied on the way in: Dr.Jit reads the tensors' own memory, so they may be changed in place between
steps, as optimisers do, but not between a rendering and its backward pass. Kernels are compiled at the first
step and for no later view. A new number of surfels recompiles the small kernel that unpacks gradients, and,
after growth by a quarter octave, the kernel that replays hits.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import torch

from tron.errors import TronError
from tron.gaussians.fields import FIELDS, PARAMETERS
from tron.runtime import torch_device
from tron.tracing.gbuffer import trace_gbuffer
from tron.tracing.parameters import SurfelParameters, pack
from tron.tracing.tiled.tiles import build_tiles

if TYPE_CHECKING:
    from tron.cameras import Camera
    from tron.gaussians.scene import GaussianScene

IMAGES = (
    *("rgb", "opacity", "normal", "normal_sum", "base_color", "roughness", "metallic", "depth", "position"),
)


def tensors_of(scene: GaussianScene) -> dict[str, torch.Tensor]:
    """A scene's parameters as leaf tensors that require gradients, on the device of the active variant.

    The keys are the names in :data:`PARAMETERS`.
    """
    on = {"device": torch_device(), "requires_grad": True}
    return {name: torch.tensor(getattr(scene, name), **on) for name in PARAMETERS}


def render(
    surfels: Mapping[str, torch.Tensor], camera: Camera, *, kernel_degree: int = 2, sh_degree: int = 3
) -> dict[str, torch.Tensor]:
    """Render the view of ``camera``, differentiable by every tensor that requires gradients.

    Args:
        surfels: contiguous float32 tensors on the device of the active variant, named and shaped as the
            arrays of ``GaussianScene``: means (M, 3), quats (M, 4), log_scales (M, 2), opacity_logits (M,),
            sh (M, 16, 3), base_color (M, 3), roughness (M,), metallic (M,). Quaternions need no unit length.
        camera: the view.
        kernel_degree: 2 or 4.
        sh_degree: harmonics beyond it are not evaluated and get no gradient.

    Returns:
        The fields of :class:`tron.tracing.surface.Surface`: rgb, normal, normal_sum, base_color and position
        (H, W, 3); opacity, roughness, metallic and depth (H, W). rgb is premultiplied by opacity, over black.
        depth has no gradient; position has one where it lies at the mean depth. If tensors have gradients,
        the normal is the mean over a pixel.

    Raises:
        TronError: a tensor is missing, or has another shape, dtype, layout or device than the ones above.
    """
    count = _check(surfels)

    def traced(arrays: dict[str, Any]) -> dict[str, Any]:
        parameters = SurfelParameters(
            **{name: arrays[name].array for name in PARAMETERS},
            count=count,
            kernel_degree=kernel_degree,
            sh_degree=sh_degree,
        )
        records = pack(parameters)
        seen = trace_gbuffer(records, build_tiles(records.detached(), camera), camera).rows()
        return {name: _image(getattr(seen, name), camera) for name in IMAGES}

    # Dr.Jit's bridge rejects subclasses of Tensor such as nn.Parameter: a view is a plain tensor.
    plain = {name: surfels[name].view(surfels[name].shape) for name in PARAMETERS}
    return dr.wrap(source="torch", target="drjit")(traced)(plain)


def _image(value: Any, camera: Camera) -> mi.TensorXf:
    """Row-major pixels -> (H, W) or (H, W, 3)."""
    shape = (camera.height, camera.width, *([3] if dr.depth_v(value) == 2 else []))
    return mi.TensorXf(dr.ravel(value), shape)  # pyright: ignore[reportArgumentType]


def _check(surfels: Mapping[str, torch.Tensor]) -> int:
    """Check that the tracer can read every tensor in place; return the number of surfels."""
    device = torch_device()
    for name in PARAMETERS:
        if name not in surfels:
            raise TronError(f"the surfels have no {name}")
    count = len(surfels["means"])
    for name in PARAMETERS:
        tensor, shape = surfels[name], (count, *FIELDS[name].shape)
        if tuple(tensor.shape) != shape:
            raise TronError(f"{name} has shape {tuple(tensor.shape)}, expected {shape}")
        if tensor.dtype != torch.float32 or not tensor.is_contiguous():
            raise TronError(f"{name} is not contiguous float32", mend="call .float().contiguous()")
        if tensor.device.type != device:
            raise TronError(
                f"{name} is on {tensor.device}, but the active variant {mi.variant()} computes on {device}",
                mend=f"call .to({device!r}) or activate another variant",
            )
    if count == 0:
        raise TronError("there are no surfels to render")
    return count
