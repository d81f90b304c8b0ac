"""A camera as numbers in a file, for those who read it without a renderer."""

from __future__ import annotations

from typing import Annotated

from annotated_types import Gt, Interval, Len
from typing_extensions import TypedDict

Side = Annotated[int, Interval(ge=1, le=16_384)]
"""Pixels along a side of a frame."""
_Row = Annotated[list[float], Len(4, 4)]


class CameraRecord(TypedDict):
    """A pinhole camera, as `Camera.to_dict` gives it: OpenCV axes (x right, y down, z forward).

    fx, fy, cx, cy are in pixels; the centre of column i, row j is at (i + 0.5, j + 0.5). world_to_camera is a
    rigid 4 x 4 matrix, row after row.
    """

    __pydantic_config__ = {"extra": "forbid", "allow_inf_nan": False}  # type: ignore[misc]  # noqa: RUF012

    fx: Annotated[float, Gt(0)]
    fy: Annotated[float, Gt(0)]
    cx: float
    cy: float
    width: Side
    height: Side
    world_to_camera: Annotated[list[_Row], Len(4, 4)]
