"""Lenses: from a calibrated, distorting camera to the pinhole that TRON renders with.

COLMAP's camera models are used for all files, since they hold OpenCV's as special cases. COLMAP and TRON put
the centre of the top left pixel at (0.5, 0.5); ``cv2.remap`` puts it at (0, 0), and OpenCV's own calibrations
do too, but ``transforms.json`` is written by tools that follow COLMAP.
"""

from __future__ import annotations

import ctypes
import os
import signal
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from tron.cameras import Camera
from tron.errors import TronError

if TYPE_CHECKING:
    import pycolmap


_GRID = 33
_WIDEST = 0.5
"""The pinhole's focal length is at least this part of the lens's: a fisheye keeps its middle sharp."""
_NARROWEST = 4.0
_SQUARE, _MOST_DEG = 1.1, 140.0
"""Of lenses that are no fisheyes: the ratio of focal lengths and the field of view that are never right."""
_TWO_FOCAL = ("PINHOLE", "OPENCV", "FULL_OPENCV", "RAD_TAN_THIN_PRISM_FISHEYE", "FOV")
_WIDE = ("FOV", "EUCM", "DIVISION", "SIMPLE_DIVISION")
_ACTION_BYTES = 512
"""More than a `struct sigaction` of any system: 152 bytes on Linux, 16 on macOS."""


@dataclass(frozen=True)
class Lens:
    """Intrinsics of a real camera, calibrated on images of ``width`` x ``height`` pixels.

    Attributes:
        model: COLMAP's name of the model, such as ``PINHOLE`` or ``OPENCV``.
        width: of the image that the parameters belong to; images at hand may have another.
        height: likewise.
        parameters: in COLMAP's order: focal lengths and principal point in pixels, then distortion.

    Raises:
        TronError: an unknown model, one without a perspective image, or parameters that are not finite.
    """

    model: str
    width: float
    height: float
    parameters: tuple[float, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "parameters", tuple(float(value) for value in self.parameters))
        if not (np.isfinite([self.width, self.height]).all() and self.width > 0 and self.height > 0):
            raise TronError(f"camera is calibrated for an image of {self.width} x {self.height} pixels")
        if not np.isfinite(self.parameters).all():
            raise TronError("camera intrinsics hold NaN or infinity")
        n_focal = 2 if self.model == "PINHOLE" else 1
        if min(self.parameters[:n_focal], default=0) <= 0:
            raise TronError(f"focal length is {self.parameters[0] if self.parameters else 'absent'}")
        if not self.distorts:
            expected = 4 if self.model == "PINHOLE" else 3
            if len(self.parameters) != expected:
                raise TronError(f"camera model {self.model} has {expected} parameters")
        else:
            _colmap_camera(self)

    @property
    def distorts(self) -> bool:
        """Whether the image must be resampled to be a pinhole's."""
        return self.model not in ("PINHOLE", "SIMPLE_PINHOLE")

    def camera(self, world_to_camera: np.ndarray, width: int, height: int) -> Camera:
        """The pinhole camera of the undistorted image at ``width`` x ``height`` pixels.

        Of a lens that distorts it has square pixels (as far as the new size keeps the shape), the lens's
        principal point, and the widest view that leaves no pixel of the image blank, but at most twice the
        lens's own field of view as tangents.

        Args:
            world_to_camera: (4, 4) rigid transform to OpenCV camera coordinates.

        Raises:
            TronError: no pinhole view lies within the image.
        """
        fx, fy, cx, cy = _pinhole(self)
        sx, sy = width / self.width, height / self.height
        return Camera(fx * sx, fy * sy, cx * sx, cy * sy, width, height, world_to_camera)

    def undistortion_maps(self, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
        """Places in the stored image that the pixels of the undistorted one, of the same size, come from.

        Returns:
            (height, width, 2) int16 and (height, width) uint16: fixed-point maps for ``cv2.remap``.
        """
        import cv2

        floats = (self.places(width, height) - 0.5).astype(np.float32)
        return cv2.convertMaps(floats, None, cv2.CV_16SC2)  # type: ignore[arg-type]

    def places(self, width: int, height: int) -> np.ndarray:
        """Places in the stored image of the centres of the undistorted pixels, (height, width, 2) float64.

        Column, then row, of a stored image of this size; the centre of its first pixel is at (0.5, 0.5).
        """
        fx, fy, cx, cy = _pinhole(self)
        sx, sy = width / self.width, height / self.height
        x = ((np.arange(width) + 0.5) / sx - cx) / fx
        y = ((np.arange(height) + 0.5) / sy - cy) / fy
        rays = np.ones((height * width, 3))
        rays[:, 0] = np.tile(x, height)
        rays[:, 1] = np.repeat(y, width)
        pixels = np.asarray(_colmap_camera(self).img_from_cam(rays, False)) * (sx, sy)
        return pixels.reshape(height, width, 2)


def impossible(lens: object) -> str | None:
    """Why structure from motion cannot be right about a lens; None of any other, and of what is no lens.

    Photos of 360 degrees, fisheyes and too little texture end in cameras that nobody has: pixels are square.
    """
    if not isinstance(lens, Lens) or "FISHEYE" in lens.model or lens.model in _WIDE:
        return None
    focal = [lens.parameters[0], lens.parameters[1] if lens.model in _TWO_FOCAL else lens.parameters[0]]
    said = f"posed with focal lengths of {focal[0]:.0f} and {focal[1]:.0f} pixels"
    if max(focal) > _SQUARE * min(focal):
        return f"{said}, which no camera has: is it a photo of 360 degrees, a fisheye, or stretched?"
    angle = 2 * np.degrees(np.arctan(0.5 * max(lens.width / focal[0], lens.height / focal[1])))
    if angle > _MOST_DEG:
        return f"{said}, a view of {angle:.0f} degrees: is it a photo of 360 degrees, or a fisheye?"
    return None


def opencv_lens(
    width: float,
    height: float,
    focal: tuple[float, float],
    center: tuple[float, float],
    *,
    radial: tuple[float, float, float] = (0, 0, 0),
    tangential: tuple[float, float] = (0, 0),
) -> Lens:
    """A lens with OpenCV's polynomial distortion k1 k2 k3, p1 p2; a pinhole where all are zero."""
    (k1, k2, k3), (p1, p2) = radial, tangential
    if k3:
        return Lens("FULL_OPENCV", width, height, (*focal, *center, k1, k2, p1, p2, k3, 0, 0, 0))
    if k1 or k2 or p1 or p2:
        return Lens("OPENCV", width, height, (*focal, *center, k1, k2, p1, p2))
    return Lens("PINHOLE", width, height, (*focal, *center))


@lru_cache(maxsize=256)
def _colmap_camera(lens: Lens) -> pycolmap.Camera:
    pycolmap = load_pycolmap()
    try:
        camera = pycolmap.Camera(
            model=lens.model,
            width=max(1, round(lens.width)),
            height=max(1, round(lens.height)),
            params=np.array(lens.parameters),
        )
        if camera.is_spherical() or not camera.verify_params():
            raise TronError(
                f"camera model {lens.model} with {len(lens.parameters)} parameters has no pinhole view"
            )
    except (ValueError, TypeError, KeyError, AttributeError, RuntimeError) as error:
        raise TronError(f"unknown camera model {lens.model}") from error
    return camera


@lru_cache(maxsize=256)
def _pinhole(lens: Lens) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy of the undistorted image, at the size that the lens was calibrated for."""
    if lens.model == "PINHOLE":
        fx, fy, cx, cy = lens.parameters
        return fx, fy, cx, cy
    if lens.model == "SIMPLE_PINHOLE":
        f, cx, cy = lens.parameters
        return f, f, cx, cy
    camera = _colmap_camera(lens)
    if camera.is_undistorted():
        return (
            camera.focal_length_x,
            camera.focal_length_y,
            camera.principal_point_x,
            camera.principal_point_y,
        )
    cx, cy, middle = camera.principal_point_x, camera.principal_point_y, camera.mean_focal_length()
    low, high = _WIDEST * middle, _NARROWEST * middle
    if not _sees_only_image(lens, high, cx, cy):
        raise TronError("lens distortion cannot be undone", mend="check k1, k2, p1 and p2 or calibrate again")
    if _sees_only_image(lens, low, cx, cy):
        high = low
    while high - low > 1e-6 * middle:
        focal = 0.5 * (low + high)
        low, high = (low, focal) if _sees_only_image(lens, focal, cx, cy) else (focal, high)
    return high, high, cx, cy


def _sees_only_image(lens: Lens, focal: float, cx: float, cy: float) -> bool:
    """Whether every ray of a pinhole with this focal length meets the image, once and where the model holds.

    A polynomial that is followed too far turns back and meets the image twice; the way back then leads to
    another ray.
    """
    camera = _colmap_camera(lens)
    x, y = np.meshgrid(np.linspace(0, lens.width, _GRID), np.linspace(0, lens.height, _GRID))
    rays = np.stack([(x.ravel() - cx) / focal, (y.ravel() - cy) / focal, np.ones(x.size)], axis=1)
    pixels = np.asarray(camera.img_from_cam(rays, False))
    slack = 1e-3
    inside = (pixels >= -slack) & (pixels <= (lens.width + slack, lens.height + slack))
    if not inside.all():
        return False
    back = np.asarray(camera.cam_from_img(pixels))
    return bool((np.abs(back - rays[:, :2]) < 1e-3 * (1 + np.abs(rays[:, :2]))).all())


def load_pycolmap() -> Any:
    """The module pycolmap, silent, for errors are ours to report; SIGTERM means what it meant before.

    As it is imported, glog puts a handler of its own in the place of any other, in every thread's name: it
    prints a native stack and kills the process with whatever is in hand. The action is saved and put back
    below Python, which may do so in its main thread only.
    """
    if os.name == "nt":  # which has no such handlers
        import pycolmap

        pycolmap.logging.minloglevel = 3
        return pycolmap
    system = ctypes.CDLL(None)
    action = ctypes.create_string_buffer(_ACTION_BYTES)
    system.sigaction(int(signal.SIGTERM), None, action)
    import pycolmap

    system.sigaction(int(signal.SIGTERM), action, None)
    pycolmap.logging.minloglevel = 3
    return pycolmap
