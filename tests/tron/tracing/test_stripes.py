"""Views whose lists of tiles would take gigabytes are drawn in stripes: as they are drawn at once."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tron.cameras import Camera
from tron.gaussians.scene import GaussianScene
from tron.tracing import SurfelTracer, gbuffer
from tron.tracing.parameters import SurfelParameters
from tron.tracing.tiled.tiles import TooManyEntries, build_tiles

pytestmark = pytest.mark.usefixtures("variant")

CAMERA = Camera.look_at((0.3, -4, 0.6), (0, 0, 0), fov_deg=40, width=45, height=62)


def scan(random_scene, projection: str) -> GaussianScene:
    scene = replace(random_scene(200), log_scales=np.full((200, 2), np.log(0.3), np.float32))
    return replace(scene, oriented=False, projection=projection).facing(CAMERA.position)


def drawn(scene: GaussianScene, nearer: bool) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Fields of a view, and gradients of its opacities."""
    parameters = SurfelParameters.from_scene(scene)
    dr.enable_grad(parameters.opacity_logits)
    tracer, count = SurfelTracer(scene, parameters=parameters), len(scene)
    lanes = 16 * 12 * 16
    limit = 3.5 + dr.arange(mi.Float, lanes) / lanes if nearer else None
    values = [mi.Float(np.arange(count, dtype=np.float32))]
    seen = tracer.gbuffer(CAMERA, values, limit)
    assert (seen.width, seen.height) == (45, 62)
    weights = mi.Float(np.linspace(0, 1, 45 * 62, dtype=np.float32))
    dr.backward(dr.sum(seen.rows().opacity * weights))
    return seen.numpy(), np.array(dr.grad(parameters.opacity_logits))


@pytest.mark.parametrize(("projection", "nearer"), [("disks", True), ("3dgs", False)])
def test_stripes_are_the_view(random_scene, monkeypatch, projection, nearer):
    scene, built = scan(random_scene, projection), []
    whole, gradient = drawn(scene, nearer)
    monkeypatch.setattr(gbuffer, "MOST_ENTRIES", 2000)
    monkeypatch.setattr(
        gbuffer, "build_tiles", lambda records, camera, *most: built.append(camera.height)
        or build_tiles(records, camera, *most),
    )  # fmt: skip
    striped, found = drawn(scene, nearer)
    assert len(built) > 6, "it was drawn in several stripes"
    assert sum(height > 4 for height in built) > 4
    for name, values in whole.items():
        np.testing.assert_allclose(striped[name], values, atol=1e-5, err_msg=name)
    np.testing.assert_allclose(found, gradient, atol=1e-4 * np.abs(gradient).max())
    assert np.abs(gradient).max() > 0


def test_lists_are_no_longer_than_was_asked_for(random_scene):
    records = SurfelTracer(scan(random_scene, "disks")).records
    entries = dr.width(build_tiles(records, CAMERA).entries)
    build_tiles(records, CAMERA, 2 * entries)
    with pytest.raises(TooManyEntries, match="too many to list"):
        build_tiles(records, CAMERA, entries // 2)
