"""Errors of the tracer against the float64 reference, on random rays of the benchmark's view.

A ray whose float64 value stands within ``MARGIN`` of a threshold (alpha cut, stop, median, sides) may fall on
either side of it in float32, and two hits within ``GAP`` of one another in either order: both are left out.
The share of such rays is a figure of its own, and so is the share of all deviating rays.
"""

from __future__ import annotations

import numpy as np

from eval.results import Row
from eval.tracing import peers
from eval.tracing.peers import Contenders, RestartedShadows
from eval.tracing.scene import camera
from eval.tracing.speed import random_rays
from tron import metrics, seeds
from tron.report.page import Picture, Pictures
from tron.tracing import reference

MARGIN = 1e-5
GAP = 1e-6
"""World units; at the distances of the benchmark's view, two steps of a float32."""
OFF = 1e-4
ERROR_GAIN = 4


def camera_errors(contenders: Contenders, size: int, rays: int, seed: int) -> list[Row]:
    """Return the largest error of unnormalised sums and of depth (relative) over ``rays`` random pixels."""
    view = camera(size)
    gbuffer = contenders.tracer.gbuffer(view)
    found = {name: values.reshape(size * size, -1) for name, values in gbuffer.numpy().items()}
    rng = seeds.generator(seed, "tracing", "error", "camera")
    chosen = rng.choice(size * size, min(rays, size * size), replace=False)
    directions = found["direction"][chosen]
    origins = np.tile(view.position.astype(np.float32), (len(chosen), 1))
    truth = reference.composite(contenders.scene, origins, directions)
    steady = (truth.margin > MARGIN) & (truth.gap > GAP)
    opacity = (1 - truth.transmittance)[:, None]
    pairs = {
        "opacity": (found["opacity"][chosen], opacity),
        "rgb": (found["rgb"][chosen], truth.rgb),
        "base_color": (found["base_color"][chosen] * opacity, truth.base_color),
        "roughness": (found["roughness"][chosen] * opacity, truth.roughness[:, None]),
        "metallic": (found["metallic"][chosen] * opacity, truth.metallic[:, None]),
        "depth": _relative(found["depth"][chosen], truth.median_depth[:, None]),
    }
    differences = {name: np.abs(a - b).max(1) for name, (a, b) in pairs.items()}
    errors = {name: float(each[steady].max(initial=0)) for name, each in differences.items()}
    return [
        Row(metric="primary.max_error", value=max(errors.values()), unit="abs", n=int(steady.sum())),
        *(
            Row(metric=f"primary.max_error_{name}", value=value, unit="abs", n=int(steady.sum()))
            for name, value in errors.items()
        ),
        *_excluded("primary", steady, np.max(list(differences.values()), 0)),
    ]


def shadow_errors(contenders: Contenders, size: int, rays: int, seed: int) -> list[Row]:
    """Return the largest transmittance error over ``rays`` random shadow rays, and the restarting peer's."""
    scene = contenders.scene
    gbuffer = contenders.tracer.gbuffer(camera(size))
    origin, direction = random_rays(gbuffer, scene.spacing, rays, seed)
    ours = np.array(contenders.tracer.transmittance(origin, direction))
    restarted = np.array(RestartedShadows(scene, contenders.quads).transmittance(origin, direction))
    truth, margin = reference.transmittance(scene, np.array(origin).T, np.array(direction).T)
    steady = margin > MARGIN
    n = int(steady.sum())
    error, peer = np.abs(ours - truth)[steady], np.abs(restarted - truth)[steady]
    return [
        Row(metric="shadow.max_error", value=float(error.max(initial=0)), unit="abs", n=n),
        Row(metric="shadow.embree_restart_max_error", value=float(peer.max(initial=0)), unit="abs", n=n),
        Row(
            metric="shadow.embree_restart_wrong_rays", value=float((peer > 1e-3).mean()), unit="fraction", n=n
        ),
        *_excluded("shadow", steady, np.abs(ours - truth)),
    ]


def _relative(found: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    scale = np.maximum(truth, 1.0)
    return found / scale, truth / scale


def _excluded(kind: str, steady: np.ndarray, difference: np.ndarray) -> list[Row]:
    """Return the share of rays near a threshold, and the share that fell on the other side of it."""
    shares = {"rays_at_a_threshold": ~steady, "rays_off": difference > OFF}
    return [
        Row(metric=f"{kind}.{name}", value=float(which.mean()), unit="fraction", n=len(steady))
        for name, which in shares.items()
    ]


def compare_images(contenders: Contenders, size: int) -> Pictures:
    """Show our image, the peer's image with the same rays and stop, and their difference."""
    view, integrator = camera(size), peers.load_integrator(peers.OUR_STOP)
    ours = np.clip(contenders.tracer.gbuffer(view).numpy()["rgb"], 0, 1)
    peer = np.clip(peers.through_centres(contenders.primitives, integrator, view), 0, 1)
    words, psnr = "the same scene by Mitsuba's integrator", f"{metrics.psnr(ours, peer):.1f} dB"
    pictures = [
        Picture(ours, "TRON", "the benchmark's scene by TRON", strong=True),
        Picture(peer, "Mitsuba's volprim", words, psnr),
        Picture(
            np.clip(ERROR_GAIN * np.abs(ours - peer), 0, 1),
            f"difference ×{ERROR_GAIN}",
            "absolute difference of the two, enlarged",
        ),
    ]
    note = (
        "Radiance along the same rays, at the smallest scene's large surfels: differences show best. "
        "They lie at silhouettes, where the peer also composites surfels seen from behind."
    )
    return Pictures("The same picture", pictures, note, columns=3)
