"""Base color at the truth's scale: the factor is found from sure pixels alone, one a channel."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from datagen.albedo_scale import at_true_scale
from tron.cameras import Camera
from tron.gaussians.scene import GaussianScene
from tron.shards.reader import read_clips
from tron.tracing import SurfelTracer

FACTORS = np.array([0.5, 0.8, 1.25])


@pytest.fixture(scope="module")
def surfels(small_dataset: Path) -> GaussianScene:
    return GaussianScene.load(small_dataset / "scenes/train-000000/surfels.ply")


@pytest.fixture(scope="module")
def camera(small_dataset: Path) -> Camera:
    clip = next(clip for clip in read_clips(small_dataset, "train") if clip.meta.scene == "train-000000")
    return Camera.from_dict(clip.meta.cameras[0])


def test_factors_are_those_that_the_surfels_are_off_by(surfels: GaussianScene, camera: Camera):
    true = replace(surfels, base_color=np.clip(surfels.base_color, 0.1, 0.7))
    off = replace(true, base_color=(true.base_color / FACTORS).astype(np.float32))
    buffers = SurfelTracer(true).gbuffer(camera).numpy()
    sure = buffers["opacity"] > 0.99
    half = (buffers["opacity"] > 0.02) & ~sure
    rows, columns = np.nonzero(sure)
    mask = half.copy()
    mask[rows[: half.sum() // 2], columns[: half.sum() // 2]] = True  # so that medians tell the two apart
    assert 10 < half.sum() < 2 * len(rows)
    # What is half covered, or outside the mask, decides nothing.
    elsewhere = np.where(sure[..., None], buffers["base_color"], 9.0)
    scaled, factors = at_true_scale(off, [(camera, elsewhere, mask)])
    np.testing.assert_allclose(factors, FACTORS, rtol=1e-3)
    np.testing.assert_allclose(scaled.base_color, true.base_color, rtol=2e-3)


def test_base_color_stays_a_reflectance(surfels: GaussianScene, camera: Camera):
    mask = np.ones((camera.height, camera.width), bool)
    scaled, factors = at_true_scale(surfels, [(camera, np.full((*mask.shape, 3), 50.0), mask)])
    assert (factors > 10).all()
    assert scaled.base_color.max() == 1


def test_without_a_common_pixel_nothing_changes_and_is_said(
    surfels: GaussianScene, camera: Camera, caplog: pytest.LogCaptureFixture
):
    nothing = np.zeros((camera.height, camera.width))
    scaled, factors = at_true_scale(surfels, [(camera, np.ones((*nothing.shape, 3)), nothing)])
    assert scaled is surfels
    np.testing.assert_array_equal(factors, 1)
    assert "base color is left as it is" in caplog.text
