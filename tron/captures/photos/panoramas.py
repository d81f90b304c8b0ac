"""Equirectangular photos of 360 degrees, cut into six pinhole views of 90 degrees: the faces of a cube.

Columns are longitudes and rows latitudes. In the camera's axes (OpenCV's) the middle of the photo is z, the
middle of its right half x, its lower edge y. COLMAP's EQUIRECTANGULAR, OpenSfM's and Metashape's spherical
cameras say so, and nerfstudio's EQUIRECTANGULAR once its axes are OpenCV's.

A face is as fine in its middle as the photo is at its horizon, so that no detail there is lost; views are
reduced from there by area averaging, as all photos are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from tron.cameras import Camera
from tron.errors import TronError

_TURNS = {
    "front": ("y", 0),
    "right": ("y", 90),
    "back": ("y", 180),
    "left": ("y", -90),
    "up": ("x", 90),
    "down": ("x", -90),
}
_WIDEST = 32_000
"""Columns that ``cv2.remap``, which counts them in 16 bits, is sure to reach."""
FACES = tuple(_TURNS)
"""Names of the faces: what the middle of each looks at."""


@dataclass(frozen=True)
class Panorama:
    """The camera of an equirectangular photo of ``width`` x ``height`` pixels.

    Raises:
        TronError: it is not twice as wide as high, or wider than OpenCV resamples.
    """

    width: float
    height: float

    def __post_init__(self) -> None:
        # A photo of an odd number of columns cannot be exactly twice as wide.
        if not (self.height >= 1 and abs(self.width - 2 * self.height) <= 1):
            raise TronError(
                f"a photo of 360 degrees is twice as wide as high, not {self.width:g} x {self.height:g}"
            )
        if self.width > _WIDEST:
            raise TronError(f"a photo of 360 degrees has {self.width:g} columns", mend=f"at most {_WIDEST}")

    @property
    def distorts(self) -> bool:
        """Whether the whole photo is to be resampled: it is not, only its faces are."""
        return False

    @property
    def faces(self) -> tuple[Face, ...]:
        """The six faces, in the order of :data:`FACES`."""
        return tuple(Face(self, name) for name in FACES)


@dataclass(frozen=True)
class Face:
    """One face of a panorama's cube, in the place of a lens (:class:`tron.lenses.Lens`).

    Attributes:
        panorama: the photo's camera.
        name: one of :data:`FACES`.
    """

    panorama: Panorama
    name: str

    @property
    def distorts(self) -> bool:
        """Whether the photo must be resampled to be a pinhole's."""
        return True

    @property
    def index(self) -> int:
        """Place of the face among :data:`FACES`."""
        return FACES.index(self.name)

    @property
    def to_panorama(self) -> np.ndarray:
        """(4, 4) float64 from the face's axes to those of the panorama's camera, both OpenCV's."""
        matrix = np.eye(4)
        matrix[:3, :3] = np.round(Rotation.from_euler(*_TURNS[self.name], degrees=True).as_matrix())
        return matrix

    def camera(self, world_to_camera: np.ndarray, width: int, height: int) -> Camera:
        """The pinhole camera of the face cut from a photo of ``width`` x ``height`` pixels.

        Args:
            world_to_camera: (4, 4) rigid transform to the face's OpenCV axes.
        """
        side = max(1, round(min(width, 2 * height) / np.pi))
        return Camera(side / 2, side / 2, side / 2, side / 2, side, side, world_to_camera)

    def fractions(self, width: int, height: int) -> np.ndarray:
        """Places in the photo of the centres of the face's pixels, (height, width, 2) float64.

        Column, then row, as fractions of the photo's sides.

        Args:
            width, height: pixels of the face.
        """
        x, y = ((np.arange(side) + 0.5) / side * 2 - 1 for side in (width, height))
        rays = np.stack([*np.meshgrid(x, y), np.ones((height, width))], axis=-1)
        right, down, forward = np.moveaxis(rays @ self.to_panorama[:3, :3].T, -1, 0)
        longitude, latitude = np.arctan2(right, forward), np.arctan2(down, np.hypot(right, forward))
        return np.stack([longitude / (2 * np.pi) + 0.5, latitude / np.pi + 0.5], axis=-1)

    def undistortion_maps(self, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
        """Places of the face's pixels in a :func:`bordered` photo of ``width`` x ``height`` pixels.

        Args:
            width, height: with the border.

        Returns:
            (side, side, 2) int16 and (side, side) uint16: fixed-point maps for ``cv2.remap``.
        """
        import cv2

        width, height = width - 2, height - 2
        side = self.camera(np.eye(4), width, height).width
        # Centres of pixels lie at whole numbers for OpenCV, and the border is one pixel.
        floats = self.fractions(side, side) * (width, height) + 0.5
        return cv2.convertMaps(floats.astype(np.float32), None, cv2.CV_16SC2)  # type: ignore[arg-type]


def bordered(pixels: np.ndarray) -> np.ndarray:
    """A panorama (H, W, C) with one pixel more at each edge, which interpolation at the edges needs.

    Beyond a side lies the other side, and beyond a pole the opposite meridian.
    """
    poles = [np.roll(row, pixels.shape[1] // 2, axis=1) for row in (pixels[:1], pixels[-1:])]
    tall = np.concatenate([poles[0], pixels, poles[1]])
    return np.concatenate([tall[:, -1:], tall, tall[:, :1]], axis=1)
