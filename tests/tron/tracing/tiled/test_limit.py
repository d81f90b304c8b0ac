"""Camera rays that end somewhere: as if nothing lay behind."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tron import seeds
from tron.cameras import Camera
from tron.gaussians.edit import subset
from tron.gaussians.fields import PARAMETERS
from tron.gaussians.scene import GaussianScene
from tron.tracing import SurfelTracer, gbuffer, reference
from tron.tracing.gbuffer import tile_rays
from tron.tracing.parameters import SurfelParameters

pytestmark = pytest.mark.usefixtures("variant")

PLANE = -0.13


@pytest.fixture
def camera() -> Camera:
    return Camera.look_at((0.02, 0.01, 1), (0, 0, 0), up=(0, 1, 0), fov_deg=30, width=9, height=7)


def to_plane(camera: Camera) -> mi.Float:
    """Distance to the level z = PLANE along each ray, in tile order."""
    return (PLANE - float(camera.position[2])) / tile_rays(camera).direction.z


def levels(disks, kind: str) -> GaussianScene:
    """Horizontal disks at heights that ids say nothing about: some a ray, or more than can wait at a time."""
    count, alike, opacity = (240, 1, 0.05) if kind == "some" else (12, 90, 0.006)
    rng = seeds.generator(0, "tests", "limit", kind)
    heights = rng.permutation(np.repeat(np.linspace(-0.5, 0.5, count), alike))
    means = np.stack([*rng.uniform(-0.2, 0.2, (2, len(heights))), heights], axis=1)
    scene = disks(means, [False] * len(means), opacity=opacity, sigma=0.3)
    return replace(scene, base_color=rng.random((len(means), 3)).astype(np.float32))


@pytest.mark.parametrize("kind", ["some", "all wait"])
def test_what_lies_beyond_a_limit_does_not_count(disks, camera, kind, monkeypatch):
    scene, again = levels(disks, kind), []
    rounds = gbuffer.composite_rounds
    monkeypatch.setattr(gbuffer, "composite_rounds", lambda *args: again.append(1) or rounds(*args))
    found = SurfelTracer(scene).gbuffer(camera, limit=to_plane(camera)).rows()
    assert bool(again) == (kind == "all wait")
    directions = camera.rays().reshape(-1, 3)
    origins = np.tile(camera.position, (len(directions), 1))
    truth = reference.composite(subset(scene, scene.means[:, 2] > PLANE), origins, directions)
    every = reference.composite(scene, origins, directions)
    assert (truth.transmittance > 1.2 * every.transmittance).mean() > 0.9
    steady = truth.margin > 1e-6
    assert steady.mean() > 0.7
    opacity = 1 - truth.transmittance
    np.testing.assert_allclose(np.array(found.opacity)[steady], opacity[steady], atol=1e-5)
    np.testing.assert_allclose(np.array(found.depth)[steady], truth.median_depth[steady], atol=1e-5)
    color = np.array(found.base_color).T * opacity[:, None]
    np.testing.assert_allclose(color[steady], truth.base_color[steady], atol=1e-5)


@pytest.mark.parametrize("kind", ["some", "all wait"])
def test_a_limit_that_nothing_reaches_changes_no_bit(disks, camera, kind):
    tracer = SurfelTracer(levels(disks, kind))
    plain, far = (tracer.gbuffer(camera, limit=end).numpy() for end in (None, to_plane(camera) + 5))
    for name, values in plain.items():
        np.testing.assert_array_equal(far[name], values, err_msg=name)


@pytest.mark.parametrize("kind", ["some", "all wait"])
def test_gradients_are_those_of_what_counts(disks, camera, kind):
    scene = levels(disks, kind)
    near = scene.means[:, 2] > PLANE

    def gradients(surfels: GaussianScene, limit: mi.Float | None) -> dict[str, np.ndarray]:
        parameters = SurfelParameters.from_scene(surfels)
        for name in PARAMETERS:
            dr.enable_grad(getattr(parameters, name))
        seen = SurfelTracer(surfels, parameters=parameters).gbuffer(camera, limit=limit)
        dr.backward(dr.sum(seen.opacity + dr.sum(seen.base_color * dr.arange(mi.Float, 96) / 96)))
        grads = {name: np.array(dr.grad(getattr(parameters, name))) for name in PARAMETERS}
        return {name: grad.reshape(len(surfels), -1) for name, grad in grads.items()}

    limited, alone = gradients(scene, to_plane(camera)), gradients(subset(scene, near), None)
    for name in ("means", "opacity_logits", "base_color"):
        np.testing.assert_allclose(
            limited[name][near], alone[name], rtol=1e-3, atol=1e-4 * np.abs(alone[name]).max()
        )
        assert not limited[name][~near].any()
