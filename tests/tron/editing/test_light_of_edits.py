"""What an edit does to light, and what it leaves alone to the bit.

Bitwise is what no random number of the bounces reaches: rays between surfels are drawn by the surfels' places
in the hierarchy, so that an edit that adds or removes any gives all of them other noise.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from examples.stage import BALL, RING, make_light
from tron.cameras import Camera
from tron.editing import Insert, Material, Remove, Selection, Views
from tron.estimation import Estimation
from tron.gaussians.scene import GaussianScene
from tron.relighting import EnvironmentMap, Guidance, Relighter
from tron.shading.direct.visibility import visibility

pytestmark = pytest.mark.usefixtures("variant")
CAMERA = Camera.look_at((3, -3, 2), (0, 0, 0.3), fov_deg=40, width=48, height=48)
DIRECT, BOUNCED = Estimation(rays=16, bounces=0), Estimation(rays=16)


@pytest.fixture(scope="module")
def light() -> EnvironmentMap:
    return make_light(32)


def frame(scene: GaussianScene, light: EnvironmentMap, estimation: Estimation) -> Guidance:
    return Relighter(scene, estimation, 3, proxy="never").under(light).render(CAMERA, seed=1)


def differing(one: Guidance, other: Guidance) -> set[str]:
    return {name for name in Guidance.BUFFERS if not np.array_equal(one[name], other[name])}


def relative(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.abs(one - other).mean() / np.abs(one).mean())


def test_hidden_is_removed(scene, light):
    """Direct light to the rounding of a product; bounced light to its noise."""
    removed = Remove(select=Selection(object=RING)).apply(scene, Views())
    logits = np.where(scene.object_id == RING, np.float32(-80), scene.opacity_logits)
    hidden = replace(scene, opacity_logits=logits)
    one, other = (frame(each, light, DIRECT) for each in (removed, hidden))
    assert differing(one, other) <= {"irradiance", "shadowed", "lit"}
    for name in ("irradiance", "shadowed", "lit"):
        np.testing.assert_allclose(one[name], other[name], rtol=0, atol=5e-7)
    assert relative(one.lit, frame(scene, light, DIRECT).lit) > 0.01, "it was seen"
    one, other = (frame(each, light, BOUNCED) for each in (removed, hidden))
    assert relative(one.lit, other.lit) < 0.01


def test_a_scene_far_away_changes_nothing(scene, light, tmp_path: Path):
    """Every buffer of direct light bitwise; and each scene is seen as it is alone."""
    scene.save(tmp_path / "other.ply")
    far = Insert(file=tmp_path / "other.ply", at=(1000, 0, 0), standing=False, object=9)
    both = far.apply(scene, Views())
    assert differing(frame(scene, light, DIRECT), frame(both, light, DIRECT)) == set()
    alone, beside = frame(scene, light, BOUNCED), frame(both, light, BOUNCED)
    assert differing(alone, beside) <= {"indirect", "lit"}
    assert relative(alone.indirect, beside.indirect) < 0.01

    shift = both.means[len(scene)].astype(float) - scene.means[0]
    there = replace(CAMERA, world_to_camera=CAMERA.world_to_camera @ translation(-shift))
    seen = Relighter(both, DIRECT, 3, proxy="never").under(light).render(there, seed=1)
    assert relative(frame(scene, light, DIRECT).lit, seen.lit) < 0.01, "float32 at 1,000 units"


def translation(by: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = by
    return matrix


def test_a_material_edit_leaves_geometry_transport_and_arriving_light_as_they_were(scene, light):
    edit = Material(select=Selection(object=BALL), hue=200, metallic=1, roughness=0.2)
    before = Relighter(scene, BOUNCED, 3, proxy="never").prepare()
    painted = edit.apply(scene, Views())
    for after in (before.changed(painted), Relighter(painted, BOUNCED, 3, proxy="never")):
        one, other = before.gbuffer(CAMERA), after.gbuffer(CAMERA)
        for name in ("position", "depth", "normal", "opacity"):
            assert np.array_equal(np.array(getattr(one, name)), np.array(getattr(other, name))), name
        assert np.array_equal(np.array(before.transport.rays.met), np.array(after.transport.rays.met))
        lit, relit = before.under(light), after.under(light)
        assert lit.bounced is not None
        assert relit.bounced is not None
        assert np.array_equal(np.array(lit.bounced.direct), np.array(relit.bounced.direct))
        share, after_share = (
            np.array(visibility(each.tracer(CAMERA), view, lit.lighting, BOUNCED, 3))
            for each, view in ((before, one), (after, other))
        )
        assert np.array_equal(share, after_share)
        first, second = lit.render(CAMERA, seed=1), relit.render(CAMERA, seed=1)
        assert {"lit", "pbr"} <= differing(first, second) <= {"lit", "pbr", "shadowed", "indirect"}
