"""Whether the peer draws the same picture, and how much the rays of the benchmark's scene meet."""

from __future__ import annotations

from typing import Any

import numpy as np

from eval.peers import volprim
from eval.peers.contenders import Contenders
from eval.peers.scene import camera
from tron import metrics, seeds
from tron.gaussians.scene import GaussianScene
from tron.tracing import reference
from tron.tracing.kernel import MAX_ALPHA, MIN_ALPHA, MIN_RESPONSE, T_MIN

RAYS = 300
ERROR_GAIN = 4


def compare_images(contenders: Contenders, size: int, integrator: Any) -> dict[str, Any]:
    """Our image, the peer's along the same rays, their difference enlarged, and ``psnr`` in dB."""
    view = camera(size)
    ours = np.clip(contenders.tracer.gbuffer(view).numpy()["rgb"], 0, 1)
    peer = np.clip(volprim.through_centres(contenders.primitives, integrator, view), 0, 1)
    difference = np.clip(ERROR_GAIN * np.abs(ours - peer), 0, 1)
    return {"tron": ours, "volprim": peer, "difference": difference, "psnr": metrics.psnr(ours, peer)}


def hits_a_ray(scene: GaussianScene, size: int, seed: int) -> tuple[float, float, float]:
    """Means over random camera rays: surfels met, those met from the front, those composited."""
    view = camera(size)
    chosen = seeds.generator(seed, "tracing", "hits").choice(
        size * size, min(RAYS, size * size), replace=False
    )
    directions = view.rays().reshape(-1, 3)[chosen].astype(np.float64)
    normals, opacities, scales = scene.normals(), scene.opacities(), scene.scales()
    tangents = scene.tangents()
    offset = view.position - scene.means
    met = front = 0
    for direction in directions:
        facing = normals @ direction
        t = -(offset * normals).sum(1) / facing
        point = offset + t[:, None] * direction
        q = sum(((point * axis).sum(1) / scales[:, k]) ** 2 for k, axis in enumerate(tangents))
        response = np.exp(-q / 2) if scene.kernel_degree == 2 else np.exp(-q * q / 18)
        alpha = np.minimum(opacities * response, MAX_ALPHA)
        counted = (response >= MIN_RESPONSE) & (alpha >= MIN_ALPHA) & (t > T_MIN)
        met += counted.sum()
        front += (counted & (facing < 0)).sum()
    origins = np.tile(view.position, (len(directions), 1))
    hits = reference.composite(scene, origins, directions).hits
    return float(met / len(chosen)), float(front / len(chosen)), float(hits.mean())
