"""Scans made from one photo: said, and filmed from where it was taken."""

from __future__ import annotations

import numpy as np
import plyfile
import pytest

from tron.framing import upright
from tron.gaussians.scene import GaussianScene
from tron.scans.camera_files import filmed_with
from tron.seeds import generator

SIDE = 48


def write(path, places, sizes, elements=()):
    """Flat splats as 3DGS stores them; ``elements`` beside them."""
    names = [*"xyz", *(f"f_dc_{k}" for k in range(3)), "opacity", *(f"scale_{k}" for k in range(3))]
    rows = np.zeros(len(places), [(name, "<f4") for name in [*names, *(f"rot_{k}" for k in range(4))]])
    for name, values in zip("xyz", places.T):
        rows[name] = values
    for k in range(3):
        rows[f"scale_{k}"] = np.log(sizes) - 3 * (k == 2)
    rows["opacity"], rows["rot_0"] = 3, 1
    found = [plyfile.PlyElement.describe(rows, "vertex")]
    for name in elements:
        found.append(plyfile.PlyElement.describe(np.zeros(4, [(name, "<f4")]), name))
    plyfile.PlyData(found, byte_order="<").write(str(path))
    return path


def relief(aspect=1.0, layers=1, tangent=0.6):
    """A splat a pixel of a photo, about as wide as the pixel there, on a bumpy ground with things on it."""
    rng = generator(0, "test", "one view")
    x, y = np.meshgrid(np.linspace(-1, 1, SIDE), np.linspace(-1, 1, SIDE))
    depth = 3 + np.sin(3 * x) * np.cos(2 * y) - 1.0 * (np.hypot(x, y) < 0.4)
    depth = np.concatenate([depth.ravel() * (1 + 0.5 * k) for k in range(layers)])
    seen = np.tile(np.stack([x.ravel() * tangent, y.ravel() * tangent * aspect], 1), (layers, 1))
    sizes = depth * tangent / SIDE * rng.uniform(0.8, 1.2, len(depth))
    return np.c_[seen * depth[:, None], depth], sizes


def ball(at):
    rng = generator(0, "test", "one view", "ball")
    out = rng.normal(size=(3000, 3))
    return out / np.linalg.norm(out, axis=1, keepdims=True) + at, np.full(3000, 0.05)


def cameras_of(path):
    scene = GaussianScene.load(path)
    turn = upright(scene.up)
    return filmed_with(path, turn, scene.offset, scene.upright()), scene.upright(), turn


@pytest.mark.parametrize(
    ("made", "elements"),
    [
        (relief(), ()),
        (relief(aspect=0.5), ()),
        (relief(layers=2), ("extrinsic", "intrinsic", "image_size", "disparity")),  # SHARP's two layers
    ],
)
def test_a_scan_of_one_view_is_filmed_from_there(tmp_path, caplog, made, elements):
    cameras, scene, turn = cameras_of(write(tmp_path / "a.ply", made[0], made[1], elements))
    assert "was made from one view" in caplog.text
    assert cameras is not None
    np.testing.assert_allclose(cameras[0].position, 0, atol=1e-9)
    np.testing.assert_allclose(cameras[0].forward, turn @ (0, 0, 1), atol=1e-9)
    assert cameras[0].up[2] > 0.99  # the photo's -y
    for camera in cameras:
        assert np.linalg.norm(camera.position) < 0.2
        pixels, depth = camera.project(scene.means.astype(np.float64))
        inside = ((pixels >= 0) & (pixels <= (camera.width, camera.height))).all(1) & (depth > 0)
        assert inside.mean() > 0.9
    tangents = np.abs(made[0][:, :2] / made[0][:, 2:]).max(0)
    assert cameras[0].height / cameras[0].width == pytest.approx(tangents[1] / tangents[0], rel=0.05)


@pytest.mark.parametrize(
    "made",
    [
        ball((0, 0, 3)),  # seen from the origin it has a back
        ball((0, 0, 0)),
        relief(layers=2),
        (relief()[0] - (0, 0, 3), relief()[1]),
        (relief()[0], np.exp(generator(0, "test", "one view", "sizes").normal(size=SIDE * SIDE) - 3)),
    ],
)
def test_other_scans_are_not(tmp_path, caplog, made):
    assert cameras_of(write(tmp_path / "a.ply", *made))[0] is None
    assert "one view" not in caplog.text


@pytest.mark.parametrize("name", ["biker.ply", "guitar.ply"])
def test_real_scans_are_not(shared_data, name):
    assert cameras_of(shared_data / "splats" / name)[0] is None


def test_cameras_beside_the_scan_are_taken_first(tmp_path, caplog):
    path = write(tmp_path / "a.ply", *relief())
    (tmp_path / "cameras.json").write_text("[]")
    cameras_of(path)
    assert "no cameras" in caplog.text or "cameras.json" in caplog.text
