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
    directions = view.rays().reshape(-1, 3)[chosen]
    found = reference.composite(scene, np.tile(view.position, (len(chosen), 1)), directions)
    return float(found.candidates.mean()), float(found.front.mean()), float(found.hits.mean())
