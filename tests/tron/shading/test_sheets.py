"""Thin sheets with a surface on either side: no blotches, and no light through them."""

from __future__ import annotations

import numpy as np
import pytest

from tron.cameras import Camera
from tron.estimation import FINEST, PREVIEW, Estimation
from tron.gaussians.scene import GaussianScene, quats_from_normals
from tron.relighting import Relighter
from tron.seeds import generator
from tron.shading.environments.environment import EnvironmentMap

SPACING = 0.02
VIEW = Camera.look_at((0.9, -0.7, 1.4), (0, 0, 0), fov_deg=28, width=64, height=64)


def sheet(gap: float, jitter: float, below: float = 0.05) -> GaussianScene:
    """A white layer above one of base color ``below``, back to back; ``gap`` and ``jitter`` in spacings."""
    random = generator(2, "tests", "sheet")
    side = np.arange(-0.5, 0.5, SPACING)
    place = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
    points, normals = [], []
    for height, up in ((0.0, 1.0), (-gap * SPACING, -1.0)):
        aside = place + random.normal(0, SPACING / 4, place.shape)
        points.append(np.c_[aside, random.normal(height, jitter * SPACING, len(place))])
        bent = np.c_[random.normal(0, 0.8 * jitter, place.shape), np.full(len(place), up)]
        normals.append(bent / np.linalg.norm(bent, axis=1, keepdims=True))
    means, count = np.concatenate(points).astype(np.float32), 2 * len(place)
    return GaussianScene(
        means=means,
        quats=quats_from_normals(np.concatenate(normals).astype(np.float32)),
        log_scales=np.full((count, 2), np.log(0.5 * SPACING), np.float32),
        opacity_logits=np.full(count, 4.6, np.float32),
        sh=np.zeros((count, 16, 3), np.float32),
        base_color=np.repeat([[0.8] * 3, [below] * 3], len(place), axis=0).astype(np.float32),
        roughness=np.full(count, 0.6, np.float32),
        metallic=np.zeros(count, np.float32),
        object_id=np.ones(count, np.int32),
        kernel_degree=4,
        spacing=SPACING,
    ).validate()


def shown(scene: GaussianScene, light: EnvironmentMap, estimation: Estimation) -> np.ndarray:
    """Luminance of ``lit`` where the sheet is solid."""
    frame = Relighter(scene, estimation, proxy="never").under(light).render(VIEW)
    return frame.lit[frame.mask > 0.99].mean(-1)


@pytest.mark.parametrize("estimation", [PREVIEW, FINEST], ids=["preview", "final"])
@pytest.mark.parametrize(("gap", "jitter"), [(0.0, 0.1), (0.0, 0.25), (0.25, 0.25)])
def test_a_sheet_is_as_bright_as_a_floor(variant: str, gap: float, jitter: float, estimation) -> None:
    """Under even light; before the rule up to 79 % of the pixels were far too dark, and the mean 0.37."""
    seen = shown(sheet(gap, jitter), EnvironmentMap.constant(1.0), estimation)
    assert seen.mean() == pytest.approx(0.81, rel=0.2 if jitter > gap else 0.1)
    assert (seen < 0.5).mean() < (0.04 if jitter > gap else 0.01)


@pytest.mark.parametrize("estimation", [PREVIEW, FINEST], ids=["preview", "final"])
@pytest.mark.parametrize(("gap", "below"), [(0.25, 0.05), (0.25, 0.8), (0.0, 0.8)])
def test_a_lamp_behind_a_sheet_stays_behind_it(variant: str, gap: float, below: float, estimation) -> None:
    """Bounced light too: of a white back and no gap 4 % came through."""
    image = np.zeros((64, 128, 3), np.float32)
    image[40:] = 1.0  # from below alone
    seen = shown(sheet(gap, 0.25, below), EnvironmentMap(image), estimation)
    assert seen.mean() < 0.005 * 0.81
