"""One camera, three conventions: a world point lands on the same pixel through OpenCV, OpenGL and Mitsuba."""

import json
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tron.cameras import Camera, mitsuba_sensor, mitsuba_to_world, opencv_to_opengl, opengl_to_opencv
from tron.errors import TronError
from tron.seeds import generator


def some_camera(seed: int = 0, width: int = 48, height: int = 32, focal: float = 40.0) -> Camera:
    """A camera in general position with an off-centre principal point."""
    rng = generator(seed, "camera")
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.random(rng=rng).as_matrix()
    matrix[:3, 3] = rng.normal(size=3)
    return Camera(focal, focal, width * 0.61, height * 0.37, width, height, matrix)


def points_in_view(camera: Camera, n: int = 200) -> np.ndarray:
    rng = generator(1, "points")
    pixels = rng.random((n, 2)) * (camera.width, camera.height)
    depth = rng.uniform(0.5, 20, n)
    local = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy) * depth[:, None]
    return np.column_stack([local, depth]) @ camera.camera_to_world[:3, :3].T + camera.position


def test_look_at_puts_the_target_in_the_middle_and_up_is_up():
    camera = Camera.look_at((3, -2, 1), (0.5, 0.2, 0.3), fov_deg=50, width=64, height=48)
    (pixels, depth) = camera.project(np.array([[0.5, 0.2, 0.3], [0.5, 0.2, 0.4]]))
    np.testing.assert_allclose(pixels[0], (32, 24), atol=1e-9)
    assert depth[0] == pytest.approx(np.linalg.norm([2.5, -2.2, 0.7]))
    assert pixels[1, 0] == pytest.approx(32, abs=1e-9)
    assert pixels[1, 1] < 24  # higher in the world is nearer to the top row
    np.testing.assert_allclose(camera.position, (3, -2, 1), atol=1e-12)


def test_field_of_view_spans_the_width():
    camera = Camera.look_at((0, -1, 0), (0, 0, 0), fov_deg=70, width=100, height=30)
    edge = np.array([[np.tan(np.radians(35)), 0, 0]])
    np.testing.assert_allclose(camera.project(edge)[0], [[100, 15]], atol=1e-9)
    assert camera.fov_deg == pytest.approx(70)


def test_opencv_axes_are_right_down_forward():
    camera = Camera.look_at((0, 0, 0), (0, 1, 0), fov_deg=60, width=8, height=8)
    np.testing.assert_allclose(
        camera.camera_to_world[:3, :3].T, [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-12
    )
    np.testing.assert_allclose(camera.forward, (0, 1, 0), atol=1e-12)
    np.testing.assert_allclose(camera.up, (0, 0, 1), atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_rays_and_projection_are_inverse(seed: int):
    camera = some_camera(seed)
    rays = camera.rays().reshape(-1, 3)
    distance = generator(seed, "distance").uniform(0.1, 50, (len(rays), 1))
    pixels, _ = camera.project(camera.position + distance * rays)
    rows, columns = np.divmod(np.arange(len(rays)), camera.width)
    np.testing.assert_allclose(pixels, np.column_stack([columns, rows]) + 0.5, atol=2e-4)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1, atol=1e-6)
    assert camera.rays().dtype == np.float32


def test_matrices_are_inverse_and_rigid():
    camera = some_camera(3)
    np.testing.assert_allclose(camera.camera_to_world @ camera.world_to_camera, np.eye(4), atol=1e-12)
    assert np.linalg.det(mitsuba_to_world(camera)[:3, :3]) == pytest.approx(1)


def test_opengl_matrix_projects_by_opengls_rule():
    """The textbook rule of OpenGL: x right, y up, the camera looks along -z, y counts from the bottom."""
    camera, points = some_camera(1), points_in_view(some_camera(1))
    c2w = opencv_to_opengl(camera.camera_to_world)
    local = np.column_stack([points, np.ones(len(points))]) @ np.linalg.inv(c2w).T
    x = camera.cx + camera.fx * local[:, 0] / -local[:, 2]
    y_from_bottom = (camera.height - camera.cy) + camera.fy * local[:, 1] / -local[:, 2]
    np.testing.assert_allclose(np.column_stack([x, camera.height - y_from_bottom]), camera.project(points)[0])
    np.testing.assert_allclose(opengl_to_opencv(c2w), camera.camera_to_world)


@pytest.mark.parametrize("seed", range(3))
def test_mitsuba_shoots_the_same_rays(variant: str, seed: int):
    import mitsuba as mi

    camera = some_camera(seed)
    sensor: Any = mi.load_dict(mitsuba_sensor(camera))
    rows, columns = np.divmod(np.arange(camera.width * camera.height), camera.width)
    film = np.stack([(columns + 0.5) / camera.width, (rows + 0.5) / camera.height]).astype(np.float32)
    ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(film), mi.Point2f(0.5))
    np.testing.assert_allclose(np.array(ray.d).T, camera.rays().reshape(-1, 3), atol=2e-6)
    np.testing.assert_allclose(np.array(ray.o).T, np.tile(camera.position, (len(rows), 1)), atol=5e-4)


@pytest.mark.parametrize("seed", range(2))
def test_a_world_point_renders_on_the_pixel_it_projects_to(variant: str, seed: int):
    import mitsuba as mi

    camera = some_camera(seed)
    points = points_in_view(camera, 6)
    points = points[
        (np.abs(camera.project(points)[0] / (camera.width, camera.height) - 0.5) < 0.4).all(axis=1)
    ]
    assert len(points) >= 2
    for point in points:
        pixel, depth = camera.project(point[None])
        lamp = {
            "type": "sphere",
            "center": point.tolist(),
            "radius": float(1.5 * depth[0] / camera.fx),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1.0}},
        }
        sensor = mitsuba_sensor(camera, spp=64)
        scene: Any = mi.load_dict(
            {"type": "scene", "integrator": {"type": "direct"}, "lamp": lamp, "sensor": sensor}
        )
        image = np.array(mi.render(scene, seed=mi.UInt32(seed)))[..., 0]
        weights = image / image.sum()
        rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
        centroid = (weights * columns).sum(), (weights * rows).sum()
        # Off the axis a sphere is seen as an ellipse whose middle lies slightly outwards.
        np.testing.assert_allclose(centroid, pixel[0], atol=0.1)


def test_sensor_refuses_pixels_that_are_not_square():
    with pytest.raises(TronError, match="square pixels"):
        mitsuba_sensor(Camera(40, 50, 24, 16, 48, 32, np.eye(4)))


def test_resizing_scales_pixels_and_nothing_else():
    camera = some_camera(4)
    points = points_in_view(camera)
    small = camera.resized(24, 8)
    np.testing.assert_allclose(small.project(points)[0], camera.project(points)[0] * (0.5, 0.25), atol=1e-9)
    np.testing.assert_allclose(small.project(points)[1], camera.project(points)[1])


def test_dictionary_survives_json_exactly():
    camera = some_camera(5)
    copy = Camera.from_dict(json.loads(json.dumps(camera.to_dict())))
    assert copy.to_dict() == camera.to_dict()
    assert (copy.world_to_camera == camera.world_to_camera).all()


def test_camera_cannot_be_changed_by_accident():
    matrix = np.eye(4)
    camera = Camera(10, 10, 5, 5, 10, 10, matrix)
    matrix[0, 3] = 7
    assert camera.world_to_camera[0, 3] == 0
    with pytest.raises(ValueError, match="read-only"):
        camera.world_to_camera[0, 3] = 7
    with pytest.raises(ValueError, match="read-only"):
        camera.position[0] = 7


@pytest.mark.parametrize(
    "change, complaint",
    [
        ({"world_to_camera": np.eye(3).tolist()}, "4 x 4"),
        ({"world_to_camera": np.diag([2.0, 2, 2, 1]).tolist()}, "rotation"),
        ({"world_to_camera": np.diag([-1.0, 1, 1, 1]).tolist()}, "mirroring"),
        ({"world_to_camera": np.full((4, 4), np.nan).tolist()}, "rotation"),
        ({"world_to_camera": "here"}, "unreadable"),
        ({"fx": 0}, "focal"),
        ({"cx": float("nan")}, "finite"),
        ({"width": 0}, "size"),
        ({"height": "tall"}, "unreadable"),
    ],
)
def test_bad_cameras_are_refused_in_one_line(change: dict, complaint: str):
    with pytest.raises(TronError, match=complaint):
        Camera.from_dict({**some_camera().to_dict(), **change})
    data = some_camera().to_dict()
    del data[next(iter(change))]
    with pytest.raises(TronError, match="lacks the field"):
        Camera.from_dict(data)


@pytest.mark.parametrize("position, target", [((0, 0, 1), (0, 0, 1)), ((0, 0, 1), (0, 0, 0))])
def test_look_at_without_a_direction_is_refused(position: tuple, target: tuple):
    with pytest.raises(TronError, match="camera"):
        Camera.look_at(position, target, fov_deg=50, width=4, height=4)
