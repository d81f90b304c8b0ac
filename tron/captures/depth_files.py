"""Depth beside photos, as nerfstudio's ``depth_file_path`` names it: along the camera's axis."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tron.cameras import Camera
from tron.captures.distortion import Lens
from tron.errors import TronError

SUFFIXES = (".png", ".npy")
_SHAPE_TOLERANCE = 0.02


@dataclass(frozen=True)
class DepthReader:
    """Reads the depth of one photo as its view wants it.

    Nothing is averaged, for between a near and a far surface there is none: each pixel takes the depth that
    lies nearest to its centre. The file may be smaller than the photo, as a phone's lidar is.

    Attributes:
        path: 16-bit PNG or .npy of (H, W) numbers, 0 where nothing is known.
        unit: world units of one step.
        lens: of the photo.
        camera: of the view.
    """

    path: Path
    unit: float
    lens: Lens
    camera: Camera

    def __call__(self) -> np.ndarray:
        """(H, W) float32 distance from the camera along each pixel's ray, world units.

        Raises:
            TronError: no such file, or one that holds no depth of this photo.
        """
        stored = _read(self.path)
        width, height = self.camera.width, self.camera.height
        if abs(stored.shape[1] * height - stored.shape[0] * width) > max(
            _SHAPE_TOLERANCE * width * stored.shape[0], width, height
        ):
            raise TronError(
                f"depth has {stored.shape[1]} x {stored.shape[0]} pixels, its view {width} x {height}",
                self.path,
            )
        columns, rows = _centres(self.lens, width, height)
        along_axis = stored[
            _nearest(rows / height, stored.shape[0]), _nearest(columns / width, stored.shape[1])
        ]
        cosine = self.camera.rays() @ self.camera.forward
        return (along_axis * self.unit / cosine).astype(np.float32)


def require_depth(path: Path) -> None:
    """Raise TronError unless there is a depth file of a kind that is read; it is not decoded."""
    if path.suffix.lower() not in SUFFIXES:
        raise TronError("depth in an unknown format", path, f"use {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise TronError("not found", path)


def _centres(lens: Lens, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows, (height, width) each, in the stored photo as if it had this size."""
    if not lens.distorts:
        columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        return columns, rows
    places = lens.places(width, height)
    return places[..., 0], places[..., 1]


def _nearest(fraction: np.ndarray, count: int) -> np.ndarray:
    return np.clip((fraction * count).astype(int), 0, count - 1)


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
