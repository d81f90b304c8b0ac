"""GaussianScene: frames, facing, rotation, bounds, spacing, and what validate refuses."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tron.errors import TronError
from tron.gaussians.harmonics import eval_sh
from tron.gaussians.scene import measure_spacing, quats_from_normals, rotation_matrices


def test_frames_are_right_handed_and_orthonormal(random_scene):
    scene = random_scene()
    u, v = scene.tangents()
    np.testing.assert_allclose(np.cross(u, v), scene.normals(), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(u, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose((u * v).sum(1), 0, atol=1e-6)


def test_a_known_quaternion_gives_a_known_normal(random_scene):
    scene = random_scene(1)
    half = np.sqrt(0.5)
    scene.quats = np.array([[half, half, 0, 0]], np.float32)  # a quarter turn about +x takes +z to -y
    np.testing.assert_allclose(scene.normals(), [[0, -1, 0]], atol=1e-6)


def test_every_normal_has_a_frame():
    normals = np.concatenate([np.eye(3), -np.eye(3), [[0.6, 0.0, -0.8], [0.0, 1e-9, -1.0]]])
    rotations = rotation_matrices(quats_from_normals(normals))
    np.testing.assert_allclose(rotations[:, :, 2], normals, atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=1e-6)


def test_facing_turns_normals_to_the_point_and_keeps_the_disk(random_scene):
    scene = random_scene()
    point = np.array([3.0, -2.0, 5.0])
    facing = scene.facing(point)
    assert ((facing.normals() * (point - facing.means)).sum(1) >= 0).all()
    np.testing.assert_allclose(np.abs((facing.normals() * scene.normals()).sum(1)), 1, atol=1e-5)
    np.testing.assert_allclose(facing.tangents()[0], scene.tangents()[0], atol=1e-5)
    already = (scene.normals() * (point - scene.means)).sum(1) > 0
    np.testing.assert_array_equal(facing.quats[already], scene.quats[already])
    assert facing.means is scene.means


def test_rotation_moves_centres_normals_radiance_and_up_together(random_scene):
    scene = random_scene()
    rotation = Rotation.from_euler("zyx", [1.0, 0.4, -2.0]).as_matrix()
    turned = scene.rotated(rotation).validate()
    np.testing.assert_allclose(turned.normals(), scene.normals() @ rotation.T, atol=1e-5)
    np.testing.assert_allclose(turned.means, scene.means @ rotation.T, atol=1e-5)
    np.testing.assert_allclose(turned.up, rotation[:, 2], atol=1e-12)
    towards = np.tile([0.6, 0.0, 0.8], (len(scene), 1))
    np.testing.assert_allclose(
        eval_sh(turned.sh, towards @ rotation.T), eval_sh(scene.sh, towards), atol=1e-5
    )


def test_trimmed_bounds_ignore_strays(random_scene):
    scene = random_scene(1000)
    scene.means[0] = [1e5, -1e5, 1e5]
    low, high = scene.bounds(trim=0.01)
    assert (low > -4).all()
    assert (high < 4).all()
    assert scene.bounds()[1][0] == pytest.approx(1e5)


def test_spacing_of_a_square_grid_is_its_step():
    x, y = np.meshgrid(np.arange(30) * 0.25, np.arange(30) * 0.25)
    grid = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    assert measure_spacing(grid) == pytest.approx(0.25)
    assert measure_spacing(grid * 3) == pytest.approx(0.75)


def test_spacing_of_coincident_or_single_surfels_is_positive():
    assert measure_spacing(np.zeros((10, 3))) > 0
    assert measure_spacing(np.ones((1, 3))) > 0


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("means", np.full((40, 3), np.nan), "means of 40"),
        ("quats", np.zeros((40, 4)), "not a unit"),
        ("quats", np.full((40, 4), 1.0), "not a unit"),
        ("roughness", np.full(40, 1.5), r"roughness of 40 surfels is outside \[0, 1\]"),
        ("sh", np.zeros((40, 4, 3)), "sh has shape"),
        ("log_scales", np.full((40, 2), 200.0), "log_scales"),
        ("opacity_logits", np.full(40, np.inf), "opacity_logits"),
        ("spacing", 0.0, "spacing"),
        ("kernel_degree", 3, "kernel_degree is 3"),
        ("up", np.array([0.0, 0.0, 2.0]), "up is"),
    ],
)
def test_broken_scenes_are_refused_by_name(random_scene, field, value, words):
    broken = dataclasses.replace(random_scene(), **{field: value})
    with pytest.raises(TronError, match=words):
        broken.validate()


@pytest.mark.parametrize(
    ("thickness", "said"), [(np.nan, "log_thickness of 1 of"), (0.0, "thicker than wide")]
)
def test_thickness_is_the_least_of_three_deviations(random_scene, thickness, said):
    scene = random_scene()
    scene.log_thickness[3] = thickness
    with pytest.raises(TronError, match=said):
        scene.validate()
