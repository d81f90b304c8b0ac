"""Dots that a distorting lens photographed lie, once undistorted, where the view's camera projects them.

The witness is OpenCV, which draws and distorts the dots; the lens is undistorted through COLMAP's models.
"""

from pathlib import Path

import cv2
import numpy as np
import pytest

from tron.captures import LoadSettings, load_capture
from tron.errors import TronError
from tron.lenses import Lens, opencv_lens

SIZE = (320, 240)
K = np.array([[250.0, 0, 163.2], [0, 247.0, 117.7], [0, 0, 1]])
BARREL = {"k1": -0.12, "k2": 0.03, "p1": 0.004, "p2": -0.003}
PINCUSHION = {"k1": 0.09, "k2": 0.01, "p1": -0.002, "p2": 0.001}
THIRD = {**BARREL, "k3": -0.01}
FISHEYE = {"k1": 0.02, "k2": -0.01, "k3": 0.003, "k4": -0.001}


def dots(coefficients: dict[str, float], fisheye: bool, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Photo (H, W, 3) uint8 of soft dots around camera-space points, and the dots' pixels (N, 2)."""
    if fisheye:
        values = np.array([coefficients[key] for key in ("k1", "k2", "k3", "k4")])
        pixels = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), K, values)[0][:, 0]
    else:
        values = np.array([coefficients.get(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3")])
        pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, values)[0][:, 0]
    # K is COLMAP's, whose first pixel has its centre at 0.5; no other correction is made here.
    x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    image = sum(np.exp(-0.5 * ((x - u) ** 2 + (y - v) ** 2) / 1.8**2) for u, v in pixels)
    return np.repeat(np.round(255 * np.clip(image, 0, 1))[..., None], 3, axis=2).astype(np.uint8), pixels


def centroid(image: np.ndarray, around: np.ndarray, radius: float) -> np.ndarray:
    x, y = np.meshgrid(np.arange(image.shape[1]) + 0.5, np.arange(image.shape[0]) + 0.5)
    weight = image * (np.hypot(x - around[0], y - around[1]) < radius)
    return np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()


def grid_of_points() -> np.ndarray:
    x, y = np.meshgrid(np.linspace(-0.48, 0.48, 5), np.linspace(-0.34, 0.34, 4))
    return np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1) * 3.0


@pytest.mark.parametrize("downscale", [1, 2])
@pytest.mark.parametrize(
    "coefficients, fisheye",
    [(BARREL, False), (PINCUSHION, False), (THIRD, False), (FISHEYE, True)],
    ids=["barrel", "pincushion", "k3", "fisheye"],
)
def test_dots_land_where_the_camera_projects_them(
    tmp_path: Path, write, coefficients: dict[str, float], fisheye: bool, downscale: int
) -> None:
    points = grid_of_points()
    photo, distorted = dots(coefficients, fisheye, points)
    straight = (K @ (points / points[:, 2:]).T).T[:, :2]
    assert np.abs(distorted - straight).max() > 2  # there is something to undo
    opengl = np.diag([1.0, -1, -1, 1]).tolist()
    frames = [{"file_path": f"{name}.png", "transform_matrix": opengl} for name in "ab"]
    model = {"camera_model": "OPENCV_FISHEYE" if fisheye else "OPENCV"}
    intrinsics = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": SIZE[0], "h": SIZE[1]}
    write.json(tmp_path / "transforms.json", {**intrinsics, **coefficients, **model, "frames": frames})
    for name in "ab":
        write.save(tmp_path / f"{name}.png", photo)
    view = load_capture(tmp_path, LoadSettings(downscale=downscale)).views[0]
    assert (view.camera.width, view.camera.height) == (SIZE[0] // downscale, SIZE[1] // downscale)
    image = view.read()[..., 0]
    expected, _ = view.camera.project(points)
    inside = (expected > 8).all(1) & (expected < np.array(image.shape[::-1]) - 8).all(1)
    assert inside.sum() >= 12
    found = np.array([centroid(image, pixel, 9 / downscale) for pixel in expected[inside]])
    assert np.abs(found - expected[inside]).max() < 0.06


@pytest.mark.parametrize("coefficients", [BARREL, PINCUSHION], ids=["barrel", "pincushion"])
def test_no_pixel_of_the_undistorted_photo_is_blank(coefficients: dict[str, float]) -> None:
    lens = opencv(coefficients)
    maps = lens.undistortion_maps(*SIZE)
    white = np.full((SIZE[1], SIZE[0]), 255, np.uint8)
    assert cv2.remap(white, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).min() == 255
    source = maps[0].astype(float) + 0.5
    assert source.min() >= -0.5
    assert (source.max((0, 1)) <= np.array(SIZE) + 0.5).all()


def opencv(coefficients: dict[str, float], scale: float = 1.0) -> Lens:
    k = {"k3": 0.0, **coefficients}
    return opencv_lens(
        SIZE[0] * scale,
        SIZE[1] * scale,
        (K[0, 0] * scale, K[1, 1] * scale),
        (K[0, 2] * scale, K[1, 2] * scale),
        radial=(k["k1"], k["k2"], k["k3"]),
        tangential=(k["p1"], k["p2"]),
    )


def test_the_view_is_the_widest_that_leaves_nothing_blank() -> None:
    """Against OpenCV's own rectangle: ours has square pixels and keeps the centre, so it is no wider."""
    lens = opencv(BARREL)
    camera = lens.camera(np.eye(4), *SIZE)
    values = np.array([BARREL[key] for key in ("k1", "k2", "p1", "p2")])
    best, _ = cv2.getOptimalNewCameraMatrix(K, values, SIZE, alpha=0)
    assert camera.fx == camera.fy
    assert max(best[0, 0], best[1, 1]) * 0.98 < camera.fx < max(best[0, 0], best[1, 1]) * 1.1


def test_a_lens_serves_photos_of_another_size() -> None:
    small, large = opencv(BARREL).camera(np.eye(4), 640, 480), opencv(BARREL, 2).camera(np.eye(4), 640, 480)
    assert np.allclose(small.intrinsics, large.intrinsics, rtol=1e-5)


def test_colmaps_simple_models_are_opencvs() -> None:
    radial = Lens("SIMPLE_RADIAL", *SIZE, (250.0, 160.0, 120.0, -0.1))
    same = Lens("OPENCV", *SIZE, (250.0, 250.0, 160.0, 120.0, -0.1, 0, 0, 0))
    assert np.array_equal(radial.undistortion_maps(*SIZE)[0], same.undistortion_maps(*SIZE)[0])


@pytest.mark.parametrize(
    "lens",
    [
        lambda: Lens("NO_SUCH_MODEL", *SIZE, (1.0, 1.0, 1.0)),
        lambda: Lens("EQUIRECTANGULAR", *SIZE, (320.0, 240.0)),
        lambda: Lens("OPENCV", *SIZE, (250.0, 250.0, 160.0)),
        lambda: Lens("PINHOLE", *SIZE, (250.0, np.nan, 160.0, 120.0)),
        lambda: Lens("PINHOLE", *SIZE, (250.0, -1.0, 160.0, 120.0)),
        lambda: opencv_lens(*SIZE, (250, 250), (160, 120), radial=(-9, 0, 0)).camera(np.eye(4), *SIZE),
        lambda: Lens("PINHOLE", 0, 240, (250.0, 250.0, 160.0, 120.0)),
    ],
)
def test_impossible_lenses_are_refused_in_one_line(lens) -> None:
    with pytest.raises(TronError) as caught:
        lens()
    assert "\n" not in str(caught.value)
