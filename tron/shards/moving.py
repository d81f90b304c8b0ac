"""The moving object of a clip: its pixels and its pose in each frame.

A clip's metadata hold it as text, ``extra.motion``, empty where nothing moves: with it, depth and cameras the
flow between two frames is exact (:mod:`tron.flow`).
"""

from __future__ import annotations

import base64
import binascii
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from tron.errors import TronError
from tron.io.images import decode_png, encode_png
from tron.shards.schema import ClipMeta

KEY = "motion"
"""Key of the text in ``ClipMeta.extra``."""

_Row = tuple[float, float, float, float]


class _Text(BaseModel):
    """poses: (4, 4) each, but for the last row; pixels: base64 of a PNG each."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    poses: list[tuple[_Row, _Row, _Row]]
    pixels: list[str]


@dataclass(frozen=True)
class Moving:
    """A rigid object over the K frames of a clip.

    Attributes:
        poses: (K, 4, 4) float64, from the world where it rests to where it is in each frame.
        pixels: (K, H, W) bool, those whose centre shows it, in the truth.
    """

    poses: np.ndarray
    pixels: np.ndarray

    @classmethod
    def of(cls, meta: ClipMeta) -> Moving | None:
        """Return the moving object of a clip; None if nothing moves.

        Raises:
            TronError: its text is damaged.
        """
        text = meta.extra.get(KEY, "")
        if not text:
            return None
        try:
            told = _Text.model_validate_json(text)
            pictures = [decode_png(base64.b64decode(each, validate=True)) for each in told.pixels]
            poses = np.array([[*rows, (0.0, 0.0, 0.0, 1.0)] for rows in told.poses])
            moving = cls(poses, np.stack([picture[..., 0] > 0.5 for picture in pictures]))
        except (ValidationError, ValueError, binascii.Error, TronError) as error:
            raise TronError(f"clip {meta.key}: the motion of its object cannot be read") from error
        if moving.poses.shape != (meta.frames, 4, 4) or moving.pixels.shape != (
            meta.frames,
            meta.height,
            meta.width,
        ):
            raise TronError(f"clip {meta.key}: the motion of its object is that of other frames")
        return moving

    def text(self) -> str:
        """The inverse of :meth:`of`; the same bytes for the same motion."""
        pictures = [encode_png(each[..., None].astype(np.uint8) * 255) for each in self.pixels]
        rows = [
            tuple(tuple(float(value) for value in row) for row in pose[:3].round(9)) for pose in self.poses
        ]
        pixels = [base64.b64encode(each).decode() for each in pictures]
        return _Text.model_validate({"poses": rows, "pixels": pixels}).model_dump_json()

    def between(self, frame: int, other: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the object's pixels in a frame, (H, W) bool, and its motion from this frame to another.

        That is (4, 4), from the world at the one frame to the world at the other.
        """
        return self.pixels[frame], self.poses[other] @ np.linalg.inv(self.poses[frame])
