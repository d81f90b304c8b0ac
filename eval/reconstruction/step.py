"""One whole optimisation step, of TRON and of a user of Mitsuba's ``volprim_rf_basic``, on the same surfels.

A step renders a view, compares it with a photo by 0.8 L1 + 0.2 (1 - SSIM), differentiates by positions,
rotations, scales, opacities and all harmonics, and updates them by Adam. Both sides hold the same tensors
under the same Adam and call the same loss; they differ in what draws the picture. The kernel is the same on
both sides: of degree 2, as the peer ships, or of degree 4, with the peer's line of density replaced. TRON's
step is that of stage 1 (:class:`tron.reconstruction.training.Stage`), without priors and without density
control. The peer's picture comes through ``dr.wrap``, as Mitsuba's documentation has it; that Mitsuba builds
its hierarchy anew for the surfels that have moved is counted, because no step goes without it.

What stays unequal is said in :mod:`eval.peers.volprim`: the peer composites radiance alone, of flat
ellipsoids that are seen from both sides.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import torch
from torch import Tensor

from eval.peers import volprim
from eval.peers.timing import Rounds, fastest, interleaved
from eval.reconstruction.measured import SHIPPED, TRON, VOLPRIM, Growth, Steps
from tron import metrics
from tron.captures import View
from tron.gaussians.scene import GaussianScene
from tron.reconstruction.losses import photometric_loss
from tron.reconstruction.settings import RadianceSettings
from tron.reconstruction.surfels import LearntSurfels
from tron.reconstruction.training import Plan, Stage, radiance_plan
from tron.tracing import SurfelTracer

TRIED = Rounds(2, 2)
"""Rounds in which the peer's two plugins are compared, to take the faster one for this kernel and size."""


def step_plan(extent: float, seed: int) -> Plan:
    """Stage 1 with its default rates, pictures alone compared, all harmonics learnt from the first step."""
    plan = radiance_plan(RadianceSettings(normal=0, mask=0), extent, seed)
    return replace(plan, density=None, sh_every=1)


def surfel_step(scene: GaussianScene, view: View, plan: Plan, seed: int) -> Callable[[], Any]:
    """A call that takes one of TRON's steps, from the surfels that the last one left."""
    surfels = LearntSurfels.of_scene(scene, plan.rates, _device())
    stage = Stage(plan, [view], surfels, scene.kernel_degree, seed)
    stage.step = plan.sh_degree  # the schedule of the harmonics is over

    return stage.advance


def volprim_step(
    scene: GaussianScene, view: View, plan: Plan, shape: str, integrator: Any
) -> Callable[[], None]:
    """A call that takes one of the peer's steps, from the surfels that the last one left."""
    surfels = LearntSurfels.of_scene(scene, plan.rates, _device())
    draw = peer_picture(volprim.primitives(scene, plan.sh_degree, shape), view, integrator)
    target = torch.from_numpy(view.read()).to(surfels.device)

    def step() -> None:
        loss = photometric_loss(draw(surfels), target, ssim_weight=plan.weights.ssim)
        surfels.clear_gradients()
        loss.backward()
        surfels.step()

    return step


def peer_picture(primitives: mi.Scene, view: View, integrator: Any) -> Callable[[LearntSurfels], Tensor]:
    """Surfels -> (H, W, 3) picture by the peer, one ray a pixel, differentiable; changes ``primitives``."""
    parameters, sensor = mi.traverse(primitives), volprim.sensor(view.camera)

    @dr.wrap(source="torch", target="drjit")
    def traced(data: Any, opacities: Any, harmonics: Any) -> Any:
        parameters["surfels.data"] = data.array
        parameters["surfels.opacities"] = opacities.array
        parameters["surfels.sh_coeffs"] = harmonics.array
        parameters.update()
        return mi.render(primitives, parameters, sensor=sensor, integrator=integrator, spp=1)

    return lambda surfels: traced(*ellipsoids(surfels))


def ellipsoids(surfels: LearntSurfels) -> tuple[Tensor, Tensor, Tensor]:
    """The peer's parameters of surfels, differentiable.

    Returns:
        Centres, scales and quaternions (M, 10), opacities (M,), harmonics (M, 48).
    """
    scales = surfels["log_scales"].exp()
    flat = volprim.THINNESS * scales.amin(1, keepdim=True)
    quats = torch.nn.functional.normalize(surfels["quats"])[:, [1, 2, 3, 0]]
    data = torch.cat([surfels["means"], scales, flat, quats], dim=1)
    harmonics = torch.cat([surfels["sh_dc"], surfels["sh_rest"]], dim=1)
    return data, surfels["opacity_logits"].sigmoid(), harmonics.reshape(len(surfels), -1)


def measure_steps(
    scene: GaussianScene, view: View, extent: float, seed: int, rounds: Rounds, shape: str | None = None
) -> Steps:
    """Time both sides in turns on one view; the peer has the scene's kernel and stops rays where TRON does.

    Where the kernel is the one that the peer ships, the peer as shipped runs beside it.

    Args:
        scene: surfels, each side learns from there on.
        view: square, display values.
        extent: world units.
        shape: the peer's plugin for its primitives; None takes the one whose step is faster here.
    """
    plan = step_plan(extent, seed)
    same_stop = volprim.load_integrator(volprim.OUR_STOP, scene.kernel_degree)
    agreement = _agreement(scene, view, same_stop)
    if shape is None:
        peers = {name: volprim_step(scene, view, plan, name, same_stop) for name in volprim.SHAPES}
        shape = fastest(interleaved(peers, TRIED))
    contestants = {
        TRON: surfel_step(scene, view, plan, seed),
        VOLPRIM: volprim_step(scene, view, plan, shape, same_stop),
    }
    if scene.kernel_degree == 2:
        contestants[SHIPPED] = volprim_step(scene, view, plan, shape, volprim.load_integrator())
    times = interleaved(contestants, rounds)
    return Steps(len(scene), view.camera.width, times, scene.kernel_degree, agreement, shape)


def measure_growth(scene: GaussianScene, view: View, extent: float, seed: int, repetitions: int) -> Growth:
    """Times of TRON's own step."""
    step = surfel_step(scene, view, step_plan(extent, seed), seed)
    times = interleaved({TRON: step}, Rounds(repetitions, repetitions))
    return Growth(len(scene), view.camera.width, times)


def _agreement(scene: GaussianScene, view: View, integrator: Any) -> float:
    """PSNR between our picture of the view and the peer's, along the same rays."""
    ours = SurfelTracer(scene).gbuffer(view.camera).numpy()["rgb"]
    primitives = volprim.primitives(scene, 3)
    peer = volprim.through_centres(primitives, integrator, view.camera)
    return metrics.psnr(np.clip(ours, 0, 1), np.clip(peer, 0, 1))


def _device() -> str:
    return "cuda" if dr.backend_v(mi.Float) == dr.JitBackend.CUDA else "cpu"
