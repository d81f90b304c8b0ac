"""Laws of moving surfels: a rigid body stays one, and what is not selected stays where it is."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tron.errors import TronError
from tron.gaussians.edit import joined, moved, removed, scaled, subset, with_kernel
from tron.gaussians.harmonics import eval_sh
from tron.gaussians.scene import GaussianScene

TURN = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
SHIFT = np.array([0.5, -2.0, 1.0])


@pytest.fixture
def scene(random_scene) -> GaussianScene:
    return random_scene()


def test_centres_normals_and_radiance_turn_together(scene: GaussianScene) -> None:
    part = scene.object_id == 1
    after = moved(scene, part, TURN, SHIFT, pivot=np.zeros(3)).validate()
    np.testing.assert_allclose(after.means[part], scene.means[part] @ TURN.T + SHIFT, atol=1e-5)
    np.testing.assert_allclose(after.normals()[part], scene.normals()[part] @ TURN.T, atol=1e-5)
    seen_from = np.tile([0.6, 0.0, 0.8], (part.sum(), 1))
    np.testing.assert_allclose(
        eval_sh(after.sh[part], seen_from @ TURN.T), eval_sh(scene.sh[part], seen_from), atol=1e-5
    )
    for name in ("means", "quats", "sh"):
        np.testing.assert_array_equal(getattr(after, name)[~part], getattr(scene, name)[~part])
    assert after.base_color is scene.base_color


def test_a_body_turns_about_its_own_middle_unless_told_otherwise(scene: GaussianScene) -> None:
    part = np.flatnonzero(scene.object_id == 2)
    after = moved(scene, part, TURN)
    np.testing.assert_allclose(after.means[part].mean(0), scene.means[part].mean(0), atol=1e-5)


def test_moving_back_restores(scene: GaussianScene) -> None:
    there = moved(scene, np.arange(len(scene)), TURN, SHIFT, pivot=np.zeros(3))
    back = moved(there, np.arange(len(scene)), TURN.T, -TURN.T @ SHIFT, pivot=np.zeros(3))
    np.testing.assert_allclose(back.means, scene.means, atol=1e-5)
    np.testing.assert_allclose(back.rotations(), scene.rotations(), atol=1e-5)
    np.testing.assert_allclose(back.sh, scene.sh, atol=1e-4)


@pytest.mark.parametrize(
    ("which", "rotation", "what"),
    [
        ([], np.eye(3), "no surfel is selected"),
        ([0], 2 * np.eye(3), "not a rotation"),
        ([0], np.eye(4), "not a rotation"),
        ([0], np.diag([1.0, 1, -1]), "mirrors"),
        ([40], np.eye(3), "neither a mask nor indices"),
        ([-1], np.eye(3), "neither a mask nor indices"),
        ([0.0, 1.0], np.eye(3), "neither a mask nor indices"),
        ([True, False], np.eye(3), "mask has shape"),
    ],
)
def test_what_cannot_be_moved_is_refused(scene: GaussianScene, which, rotation, what) -> None:
    with pytest.raises(TronError, match=what):
        moved(scene, np.array(which), rotation)


@pytest.mark.parametrize("vector", [2.0, [1.0, 2.0], [np.nan, 0, 0]])
@pytest.mark.parametrize("name", ["translation", "pivot"])
def test_where_to_is_three_finite_numbers(scene: GaussianScene, name: str, vector) -> None:
    with pytest.raises(TronError, match=name):
        moved(scene, np.array([0]), **{name: vector})


def test_thickness_stays_with_the_surfels(scene: GaussianScene) -> None:
    part = scene.object_id == 1
    thick = scene.log_thickness
    halves = subset(scene, part), removed(scene, part)
    np.testing.assert_array_equal(halves[0].log_thickness, thick[part])
    both = joined(*halves).validate()
    np.testing.assert_array_equal(both.log_thickness, np.concatenate([thick[part], thick[~part]]))
    larger = np.where(part, np.log(3), 0)
    found = scaled(scene, part, 3, np.zeros(3)).validate()
    np.testing.assert_allclose(found.log_thickness, thick + larger, atol=1e-5)
    found = with_kernel(scene, 4).validate()
    ratio = thick - scene.log_scales.min(1)
    np.testing.assert_allclose(found.log_thickness - found.log_scales.min(1), ratio, atol=1e-5)
