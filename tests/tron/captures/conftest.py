"""One set of photos of known points, and writers for every file format that may describe it."""

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from tron.seeds import generator

WIDTH, HEIGHT = 96, 64
FX, FY, CX, CY = 110.0, 105.0, 50.5, 30.25
# Moves, turns and scales the world of a transforms.json, as nerfstudio does; mirrors nothing.
APPLIED = np.array([[0.0, 0, 1, 0.5], [1, 0, 0, -2.0], [0, 1, 0, 0.25]])
APPLIED_SCALE = 0.3


@dataclass(frozen=True)
class Photos:
    """Cameras on an arc, OpenGL camera-to-world (N, 4, 4), and world points (M, 3) that all of them see."""

    opengl: np.ndarray
    points: np.ndarray
    names: tuple[str, ...]

    @property
    def opencv(self) -> np.ndarray:
        matrices = self.opengl.copy()
        matrices[:, :, 1:3] *= -1
        return matrices

    def pixels(self, index: int, size=(WIDTH, HEIGHT), intrinsics=(FX, FY, CX, CY)) -> np.ndarray:
        """Where the points are in photo ``index``, (M, 2), x then y, written out for OpenGL's axes."""
        matrix = self.opengl[index]
        offset = self.points - matrix[:3, 3]
        right, up, backward = (offset @ matrix[:3, axis] for axis in range(3))
        fx, fy, cx, cy = intrinsics
        full = np.stack([fx * right / -backward + cx, fy * -up / -backward + cy], axis=1)
        return full * (np.array(size) / (WIDTH, HEIGHT))


@pytest.fixture(scope="session")
def photos() -> Photos:
    rng = generator(4, "captures", "points")
    middle = np.array([1, -2, 0.5])
    matrices = []
    for azimuth in np.linspace(0.3, 2.6, 10):
        position = 4 * np.array([np.cos(azimuth), np.sin(azimuth), 0.4])
        backward = position / np.linalg.norm(position)
        right = np.cross((0, 0, 1), backward)
        right /= np.linalg.norm(right)
        matrix = np.eye(4)
        matrix[:3, :4] = np.stack([right, np.cross(backward, right), backward, position + middle], axis=1)
        matrices.append(matrix)
    points = rng.uniform(-0.6, 0.6, (20, 3)) + middle
    return Photos(np.array(matrices), points, tuple(f"photo_{index:02d}.png" for index in range(10)))


def picture(index: int, size: tuple[int, int] = (WIDTH, HEIGHT), channels: int = 3) -> np.ndarray:
    """Smooth and different for every index, uint8 (H, W, C)."""
    x, y = np.meshgrid(np.linspace(0, 1, size[0]), np.linspace(0, 1, size[1]))
    image = np.stack([x, y, np.full_like(x, index / 16), np.ones_like(x)][:channels], axis=-1)
    return np.round(255 * image).astype(np.uint8)


def save(path: Path, image: np.ndarray) -> None:
    """Write RGB or RGBA in the file's own order, 8 or 16 bits."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if image.ndim == 3:
        image = image[..., [2, 1, 0, 3][: image.shape[2]]] if image.shape[2] > 1 else image[..., 0]
    assert cv2.imwrite(str(path), image)


def write_photos(folder: Path, photos: Photos, size=(WIDTH, HEIGHT), channels: int = 3) -> None:
    for index, name in enumerate(photos.names):
        save(folder / name, picture(index, size, channels))


def transforms(photos: Photos, prefix: str = "images/", applied: bool = False) -> dict:
    matrices = photos.opengl.copy()
    content: dict = {"fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY, "w": WIDTH, "h": HEIGHT}
    if applied:
        matrices[:, :3] = APPLIED[:, :3] @ matrices[:, :3]
        matrices[:, :3, 3] += APPLIED[:, 3]
        matrices[:, :3, 3] *= APPLIED_SCALE
        content |= {"applied_transform": APPLIED.tolist(), "applied_scale": APPLIED_SCALE}
    content["frames"] = [
        {"file_path": prefix + name, "transform_matrix": matrix.tolist()}
        for name, matrix in zip(photos.names, matrices)
    ]
    return content


def write_json(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


def write_colmap(
    folder: Path, photos: Photos, *, text: bool, model: str = "PINHOLE", parameters=None, size=(WIDTH, HEIGHT)
) -> None:
    """A sparse model whose points lie exactly where the photos see them; the last one is seen only twice."""
    import pycolmap

    scene = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        model=model, width=size[0], height=size[1], params=parameters or [FX, FY, CX, CY], camera_id=1
    )
    scene.add_camera_with_trivial_rig(camera)
    for index, name in enumerate(photos.names):
        seen = photos.pixels(index)
        image = pycolmap.Image(name=name, keypoints=seen, camera_id=1, image_id=index + 1)
        pose = pycolmap.Rigid3d(np.linalg.inv(photos.opencv[index])[:3])
        scene.add_image_with_trivial_frame(image, pose)
    for number, point in enumerate(photos.points):
        track = pycolmap.Track()
        for index in range(2 if number == len(photos.points) - 1 else len(photos.names)):
            track.add_element(index + 1, number)
        scene.add_point3D(point, track, np.array([255, 128, number], np.uint8))
    scene.update_point_3d_errors()
    folder.mkdir(parents=True)
    (scene.write_text if text else scene.write_binary)(folder)


def write_tensoir(folder: Path, photos: Photos) -> float:
    """A scene of TensoIR's, cameras 0 to 6 for training; the focal length (pixels are square)."""
    angle = 0.8
    for index, matrix in enumerate(photos.opengl):
        view = folder / (f"train_{index:03d}" if index < 7 else f"test_{index - 7:03d}")
        save(view / "rgba.png", picture(index, channels=4))
        meta = {
            "imw": WIDTH,
            "imh": HEIGHT,
            "cam_angle_x": angle,
            "cam_transform_mat": ",".join(repr(float(each)) for each in matrix.ravel()),
        }
        write_json(view / "metadata.json", meta)
    return 0.5 * WIDTH / np.tan(0.5 * angle)


def panorama(matrix: np.ndarray, index: int, size: tuple[int, int]) -> np.ndarray:
    """Equirectangular picture, uint8 (H, W, 3), of a world whose red and green are its directions' x and y.

    Written out for OpenGL's axes: ``matrix`` is camera to world. Blue tells the index.
    """
    width, height = size
    longitude = ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi
    latitude = (0.5 - (np.arange(height)[:, None] + 0.5) / height) * np.pi
    right, up, backward = matrix[:3, :3].T
    ray = np.cos(latitude) * np.sin(longitude) * right[:2, None, None]
    ray = (
        ray
        + np.sin(latitude) * up[:2, None, None]
        - np.cos(latitude) * np.cos(longitude) * backward[:2, None, None]
    )
    color = [*(0.5 + 0.5 * ray), np.full((height, width), index / 16)]
    return np.round(255 * np.stack(color, axis=-1)).astype(np.uint8)


class Writers:
    """The functions above, for tests that ask for the fixture."""

    size = (WIDTH, HEIGHT)
    intrinsics = (FX, FY, CX, CY)
    picture = staticmethod(picture)
    panorama = staticmethod(panorama)
    save = staticmethod(save)
    photos = staticmethod(write_photos)
    transforms = staticmethod(transforms)
    json = staticmethod(write_json)
    colmap = staticmethod(write_colmap)
    tensoir = staticmethod(write_tensoir)


@pytest.fixture(scope="session")
def write() -> type[Writers]:
    return Writers
