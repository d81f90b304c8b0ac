"""Laws of undersides that no camera saw: they have the light of their own side."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from tron.shading.bounces.bounce import BounceTransport
from tron.shading.environments.environment import EnvironmentMap
from tron.shading.lighting import Lighting
from tron.tracing import SurfelTracer

SPACING = 0.05


def sky_above() -> Lighting:
    """Light from the upper half alone."""
    image = np.zeros((32, 64, 3), np.float32)
    image[:16] = 1.0
    return Lighting(EnvironmentMap(image))


def sheet(dense: Any, half: float, height: float, down: bool = False) -> Any:
    flat = dense.plane(half=half)
    return SimpleNamespace(
        points=flat.points + np.array([0, 0, height]), normals=-flat.normals if down else flat.normals
    )


def test_a_sunlit_sheet_is_dark_from_below_above_a_black_floor(dense_surfels) -> None:
    """Half of what its front sends out came from its back until 2026-11-25."""
    sheets = [dense_surfels.plane(half=1.0), sheet(dense_surfels, 0.4, 0.3)]
    count = [len(each.points) for each in sheets]
    black = np.repeat([[0.0] * 3, [0.8] * 3], count, axis=0)
    scene = dense_surfels.scene(*sheets, base_color=black)
    transport = BounceTransport.trace(SurfelTracer(scene))
    baked = transport.bake(sky_above())
    above = scene.means[:, 2] > 0.1
    behind, front = (np.array(value).T[above].mean() for value in (baked.behind, baked.outgoing))
    assert front > 0.5
    assert behind < 0.06 * front  # the black floor mirrors four hundredths


def test_an_underside_stands_for_one_that_is_there(dense_surfels) -> None:
    """The floor below a sheet gets what it gets below a slab whose underside has surfels of its own."""
    floor, thin = dense_surfels.plane(half=1.2), [sheet(dense_surfels, 0.6, 0.38)]
    slab = [sheet(dense_surfels, 0.6, 0.5), sheet(dense_surfels, 0.6, 0.38, down=True)]
    found = []
    for sheets in (thin, slab):
        scene = dense_surfels.scene(floor, *sheets)
        indirect = np.array(BounceTransport.trace(SurfelTracer(scene)).bake(sky_above()).indirect).T
        below = (scene.means[:, 2] < 0.01) & (np.abs(scene.means[:, :2]).max(1) < 0.5)
        found.append(indirect[below].mean())
    assert found[1] > 0.01
    np.testing.assert_allclose(found[0], found[1], rtol=0.08)
