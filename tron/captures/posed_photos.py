"""Photos as files of poses describe them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from tron.captures.distortion import Lens
from tron.captures.photographs import Decode
from tron.errors import TronError


@dataclass(frozen=True)
class PosedPhoto:
    """Photo as its file describes it; nothing is checked yet.

    Attributes:
        name: as the file has it.
        path: the image, None if it was not found.
        camera_to_world: matrix to the capture's world, OpenCV camera axes; anything (4, 4) or (3, 4).
        lens: of the photo, or what gives the lens for a photo of this width and height.
        split: whether the file holds the photo out; None where it does not say.
        maps: more images of the same pixels, by field of :class:`View`, with what they encode.
        refused: why the photo cannot be used, if the file itself shows that.
        mask: that the file names; None: one is looked for beside the photo (see :func:`find_mask`).
        depth: file of the photo's depth (see :class:`DepthReader`), whose units are ``depth_scale`` times the
            user's.
        depth_scale: world units of the capture in one of the file's.
    """

    name: str
    path: Path | None
    camera_to_world: object
    lens: Lens | Callable[[int, int], Lens] | None
    split: Literal["train", "test"] | None = None
    maps: Mapping[str, tuple[Path, Decode]] = field(default_factory=dict)
    refused: str | None = None
    mask: Path | None = None
    depth: Path | None = None
    depth_scale: float = 1.0


@dataclass(frozen=True)
class PosedPhotos:
    """Photos and points of a file of poses; fields as in :class:`Capture`.

    Attributes:
        source: the file or folder, for messages.
        upright: the poses belong to photos turned as their EXIF tags say.
        names: of the views, in the order of photos; None names them after their images.
    """

    source: Path
    photos: Sequence[PosedPhoto]
    points: np.ndarray | None = None
    point_colors: np.ndarray | None = None
    transform: np.ndarray = field(default_factory=lambda: np.eye(4))
    skipped: Mapping[str, str] = field(default_factory=dict)
    upright: bool = False
    names: Sequence[str] | None = None


def rigid_pose(matrix: object) -> np.ndarray:
    """(4, 4) float64 rigid transform from a (4, 4) or (3, 4) matrix as files have it.

    A uniform scale of the axes is divided out, the position kept; rounding is removed by taking the nearest
    rotation.

    Raises:
        TronError: another shape, NaN, a mirrored, sheared or unevenly scaled matrix.
    """
    try:
        pose = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise TronError("pose is not a matrix of numbers") from error
    if pose.shape not in ((4, 4), (3, 4)):
        raise TronError(f"pose has shape {pose.shape}, not (4, 4)")
    if not np.isfinite(pose).all():
        raise TronError("pose holds NaN or infinity")
    if pose.shape == (4, 4) and not np.allclose(pose[3], (0, 0, 0, 1), atol=1e-6):
        raise TronError("last row of the pose is not 0 0 0 1")
    u, scales, vt = np.linalg.svd(pose[:3, :3])
    if scales[0] < 1e-9 or scales[0] - scales[2] > 0.01 * scales[0]:
        raise TronError("pose is no rotation: its axes are not at right angles and of one length")
    if np.linalg.det(pose[:3, :3]) < 0:
        raise TronError("pose is mirrored: its axes are left-handed")
    rigid = np.eye(4)
    rigid[:3, :3] = u @ vt
    rigid[:3, 3] = pose[:3, 3]
    return rigid
