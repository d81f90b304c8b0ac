"""Scenes on which optimisation steps are timed: a reconstructed one, and drawn surfels of any number."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from eval.peers.scene import camera, surfels
from eval.reconstruction.pictures import middle_view
from tron.captures import View
from tron.captures.folder import read_capture_folder
from tron.errors import TronError
from tron.gaussians.scene import GaussianScene
from tron.reconstruction.evaluation import wanted_picture
from tron.reconstruction.initial import extent_of
from tron.tracing import SurfelTracer

_DIMMED = 0.8


def first_trained(folder: Path, way: str) -> str:
    """Name of the first scene reconstructed in a way below the benchmark's folder.

    Raises:
        TronError: none is there.
    """
    scenes = sorted((folder / "scenes").glob(f"*/{way}/scene.ply"))
    if not scenes:
        raise TronError(
            "no reconstructed scene to take steps on", folder, "measure part scenes too, or before"
        )
    return scenes[0].parent.parent.name


def trained(folder: Path, way: str, size: int) -> tuple[GaussianScene, View, float]:
    """The first scene reconstructed in a way, a held-out view of it, and its extent.

    Args:
        folder: of the benchmark.
        size: width and height to which the view is resized, pixels.

    Raises:
        TronError: none is there.
    """
    name = first_trained(folder, way)
    capture = read_capture_folder(folder / "dataset" / "captures" / name)
    view = middle_view(capture.test_views)
    photo = Image.fromarray(np.round(255 * wanted_picture(view)).astype(np.uint8))
    photo = photo.resize((size, size), Image.Resampling.BICUBIC)
    pixels = np.asarray(photo, np.float32) / 255
    resized = View(view.name, view.camera.resized(size, size), pixels, "display")
    return (
        GaussianScene.load(folder / "scenes" / name / way / "scene.ply"),
        resized,
        extent_of(capture.train_views),
    )


def drawn(count: int, size: int, seed: int) -> tuple[GaussianScene, View, float]:
    """The tracing benchmark's surfels and view, with a photo that is their own picture, dimmed."""
    scene, view = surfels(count, seed), camera(size)
    rendered = SurfelTracer(scene).gbuffer(view).numpy()["rgb"]
    photo = np.clip(_DIMMED * rendered + (1 - _DIMMED) / 2, 0, 1)
    extent = float(np.linalg.norm(view.position - np.median(scene.means, axis=0)))
    return scene, View("drawn", view, photo, "display"), extent
