"""Whether the peer draws the same picture, and how many surfels the rays of the benchmark's scene hit."""

from __future__ import annotations

import numpy as np

from eval.peers import volprim
from eval.peers.contenders import Contenders
from eval.peers.scene import camera
from eval.tracing.measured import SamePicture
from tron import metrics, seeds
from tron.gaussians.scene import GaussianScene
from tron.tracing import reference
from tron.tracing.kernel import MAX_ALPHA, MIN_ALPHA, MIN_RESPONSE, T_MIN

RAYS = 300


def compare_images(contenders: Contenders, size: int) -> SamePicture:
    """Our image and the peer's along the same rays, where the peer stops rays where we do."""
    view, integrator = camera(size), volprim.load_integrator(volprim.OUR_STOP)
    ours = np.clip(contenders.tracer.gbuffer(view).numpy()["rgb"], 0, 1)
    peer = np.clip(volprim.through_centres(contenders.primitives, integrator, view), 0, 1)
    return SamePicture(ours, peer, metrics.psnr(ours, peer))


def hits_a_ray(scene: GaussianScene, size: int, seed: int) -> tuple[float, float, float]:
    """Means over random camera rays: surfels hit, those hit from the front, those composited."""
    view = camera(size)
    chosen = seeds.generator(seed, "tracing", "hits").choice(
        size * size, min(RAYS, size * size), replace=False
    )
    directions = view.rays().reshape(-1, 3)[chosen].astype(np.float64)
    normals, opacities, scales = scene.normals(), scene.opacities(), scene.scales()
    tangents = scene.tangents()
    offset = view.position - scene.means
    hit = front = 0
    for direction in directions:
        facing = normals @ direction
        t = -(offset * normals).sum(1) / facing
        point = offset + t[:, None] * direction
        q = sum(((point * axis).sum(1) / scales[:, k]) ** 2 for k, axis in enumerate(tangents))
        response = np.exp(-q / 2) if scene.kernel_degree == 2 else np.exp(-q * q / 18)
        alpha = np.minimum(opacities * response, MAX_ALPHA)
        counted = (response >= MIN_RESPONSE) & (alpha >= MIN_ALPHA) & (t > T_MIN)
        hit += counted.sum()
        front += (counted & (facing < 0)).sum()
    origins = np.tile(view.position, (len(directions), 1))
    hits = reference.composite(scene, origins, directions).hits
    return float(hit / len(chosen)), float(front / len(chosen)), float(hits.mean())
