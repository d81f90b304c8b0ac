"""Files of depth beside photos: distance along the axis, or along the ray in a panorama."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tron.cameras import Camera
from tron.captures.photos.panoramas import Face
from tron.errors import TronError
from tron.lenses import Lens

_SHAPE_TOLERANCE = 0.02

_DEPTH_SUFFIXES = (".png", ".npy")


@dataclass(frozen=True)
class DepthReader:
    """Reads the depth of one photo as its view wants it.

    Nothing is averaged, for between a near and a far surface there is none: each pixel takes the depth that
    lies nearest to its centre. The file may be smaller than the photo, as a phone's lidar is.

    Attributes:
        path: 16-bit PNG or .npy of (H, W) numbers, 0 where nothing is known: along the camera's axis, or of a
            panorama from its camera.
        unit: world units of one step.
        lens: of the photo, or the face cut out of it.
        camera: of the view.
    """

    path: Path
    unit: float
    lens: Lens | Face
    camera: Camera

    def __call__(self) -> np.ndarray:
        """(H, W) float32 distance from the camera along each pixel's ray, world units.

        Raises:
            TronError: no such file, or one that holds no depth of this photo.
        """
        stored = _read(self.path)
        size = (self.camera.width, self.camera.height)
        width, height = (2, 1) if isinstance(self.lens, Face) else size
        if abs(stored.shape[1] * height - stored.shape[0] * width) > max(
            _SHAPE_TOLERANCE * width * stored.shape[0], width, height
        ):
            of = "its photo 2 x 1" if isinstance(self.lens, Face) else f"its view {width} x {height}"
            raise TronError(f"depth has {stored.shape[1]} x {stored.shape[0]} pixels, {of}", self.path)
        depth = nearest(stored, _fractions(self.lens, *size)) * self.unit
        if not isinstance(self.lens, Face):
            depth = depth / (self.camera.rays() @ self.camera.forward)
        return depth.astype(np.float32)


def nearest(stored: np.ndarray, fractions: np.ndarray) -> np.ndarray:
    """(H, W) values of the pixels of an image that lie nearest to places.

    Args:
        stored: (h, w).
        fractions: (H, W, 2) column, then row, as fractions of the image's sides.
    """
    rows, columns = stored.shape[:2]
    at = np.clip((fractions * (columns, rows)).astype(int), 0, (columns - 1, rows - 1))
    return stored[at[..., 1], at[..., 0]]


def require_depth(path: Path) -> None:
    """Raise TronError unless there is a depth file of a kind that is read; it is not decoded."""
    if path.suffix.lower() not in _DEPTH_SUFFIXES:
        raise TronError("depth in an unknown format", path, f"use {', '.join(_DEPTH_SUFFIXES)}")
    if not path.is_file():
        raise TronError("not found", path)


def _fractions(lens: Lens | Face, width: int, height: int) -> np.ndarray:
    """(height, width, 2) places in the stored photo of a view's pixels, as fractions of its sides."""
    if isinstance(lens, Face):
        return lens.fractions(width, height)
    if lens.distorts:
        return lens.places(width, height) / (width, height)
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([columns / width, rows / height], axis=-1)


def _read(path: Path) -> np.ndarray:
    """(H, W) float64, finite and not negative."""
    try:
        depth = _READERS[path.suffix.lower()](path)
    except (OSError, ValueError, EOFError) as error:
        raise TronError(f"not a readable depth file: {error}", path) from error
    if depth is None or depth.ndim not in (2, 3) or depth.dtype.kind not in "uif":
        raise TronError("depth file holds no numbers of one channel", path)
    depth = depth.reshape(*depth.shape[:2], -1)
    if depth.shape[2] != 1 or depth.size == 0 or depth.dtype == np.uint8:
        raise TronError("depth file has several channels or 8 bits", path, "store 16 bits of one channel")
    return np.nan_to_num(depth[..., 0].astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0).clip(0)


def _png(path: Path) -> np.ndarray | None:
    import cv2

    return cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)


_READERS: dict[str, Callable[[Path], np.ndarray | None]] = {
    ".png": _png,
    ".npy": lambda path: np.load(path, allow_pickle=False),
}
