"""One gradient step: render, compare with a target image, differentiate by every parameter of the surfels.

Both sides see the same L2 loss of the same number of rays. TRON's step packs the parameters, bins, traces
and replays, and differentiates means, quaternions, log-scales, logits, harmonics and materials; the peer's,
through ``mi.render`` and ``dr.backward``, its ellipsoids' centres, scales, quaternions, opacities and
harmonics. The peer's hierarchy stands still: that it would have to be built anew after a step is not
counted.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from eval.peers import volprim
from eval.peers.contenders import Contenders
from eval.peers.scene import camera
from eval.peers.timing import Rounds, interleaved
from eval.tracing.measured import GradientStep
from tron.gaussians.fields import PARAMETERS
from tron.tracing.gbuffer import trace_gbuffer
from tron.tracing.parameters import SurfelParameters, pack
from tron.tracing.tiles import build_tiles

TARGET = 0.5
"""The target image, a grey one: every pixel has something to learn."""


def measure_gradient(contenders: Contenders, size: int, rounds: Rounds) -> GradientStep:
    """Time both steps, in turns; the peer stops where TRON does."""
    ours, peer = surfel_step(contenders, size), volprim_step(contenders, size)
    times = interleaved({"tron": ours, "volprim": peer}, rounds)
    bands = (contenders.recipe.sh_degree + 1) ** 2
    by_color = np.array(ours()["sh"]).reshape(len(contenders.scene), -1, 3)[:, :bands].ravel()
    peer_color = np.array(peer()["surfels.sh_coeffs"]).ravel()
    cosine = by_color @ peer_color / max(np.linalg.norm(by_color) * np.linalg.norm(peer_color), 1e-30)
    return GradientStep(len(contenders.scene), size, times, float(cosine))


def surfel_step(contenders: Contenders, size: int) -> Callable[[], dict[str, Any]]:
    """A call that makes TRON's step from scratch: parameter -> gradient, evaluated by the caller."""
    view = camera(size)
    parameters = SurfelParameters.from_scene(contenders.scene)

    def step() -> dict[str, Any]:
        for name in PARAMETERS:
            value = dr.detach(getattr(parameters, name))
            dr.enable_grad(value)
            setattr(parameters, name, value)
        records = pack(parameters)
        detached = records.detached()
        lists = build_tiles(detached, view)
        image = trace_gbuffer(records, lists, view).rgb
        dr.backward(dr.mean(dr.squared_norm(image - TARGET)) / 3)
        return {name: dr.grad(getattr(parameters, name)) for name in PARAMETERS}

    return step


def volprim_step(contenders: Contenders, size: int) -> Callable[[], dict[str, Any]]:
    """A call that makes the peer's step: parameter -> gradient, evaluated by the caller."""
    scene = contenders.primitives
    integrator, sensor = volprim.load_integrator(volprim.OUR_STOP), volprim.sensor(camera(size))
    parameters = mi.traverse(scene)
    learned = [
        name
        for name in parameters.keys()  # noqa: SIM118 (not a dict)
        if name.startswith("surfels.") and name.rpartition(".")[2] in ("data", "opacities", "sh_coeffs")
    ]

    def step() -> dict[str, Any]:
        for name in learned:
            dr.disable_grad(parameters[name])
            dr.enable_grad(parameters[name])
        parameters.update()
        image = mi.render(scene, parameters, sensor=sensor, integrator=integrator, spp=1)
        dr.backward(dr.mean(dr.square(image - TARGET), axis=None))
        return {name: dr.grad(parameters[name]) for name in learned}

    return step
