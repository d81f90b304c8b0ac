"""Points on surfaces and their colours, in PLY files."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement, PlyParseError

from tron.errors import TronError

_CHANNELS = ("red", "green", "blue")


def read_points(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Points (N, 3) float64 and display colours (N, 3) float32, if there are any, of a PLY's vertices.

    Raises:
        TronError: no PLY, or one that is damaged or has no vertices with x, y, z.
    """
    try:
        vertex = PlyData.read(str(path))["vertex"]
        points = np.stack([np.asarray(vertex[axis], np.float64) for axis in "xyz"], axis=1)
        if not {each.name for each in vertex.properties}.issuperset(_CHANNELS):
            return points, None
        stored = np.stack([vertex[channel] for channel in _CHANNELS], axis=1)
    except (OSError, TypeError, ValueError, KeyError, PlyParseError, MemoryError) as error:
        raise TronError(f"cannot read points: {error}", path) from error
    colors = stored.astype(np.float32) / (255 if np.issubdtype(stored.dtype, np.integer) else 1)
    return points, colors.clip(0, 1)


def encode_points(points: np.ndarray, colors: np.ndarray | None) -> bytes:
    """PLY of points (N, 3) in float32 and display colours (N, 3) in 8 bits."""
    columns = [(axis, "<f4") for axis in "xyz"]
    if colors is not None:
        columns += [(channel, "u1") for channel in _CHANNELS]
    rows = np.empty(len(points), columns)
    for axis, values in zip("xyz", points.T):
        rows[axis] = values
    for channel, values in zip(_CHANNELS, () if colors is None else colors.T):
        rows[channel] = np.round(np.clip(values, 0, 1) * 255)
    stream = io.BytesIO()
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(stream)
    return stream.getvalue()
