"""Primitives of KHR_draco_mesh_compression."""

from __future__ import annotations

import DracoPy
import numpy as np

from tron.errors import TronError

_DRACO_METADATA = 0x8000


def decode_draco(
    blob: bytes, ids: dict[str, int], most_triangles: int
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Decode a primitive of KHR_draco_mesh_compression by DracoPy.

    Args:
        blob: the compressed buffer view.
        ids: glTF attribute -> Draco's unique id.
        most_triangles: that the primitive's accessors say there are.

    Returns:
        faces (F, 3) int64, and glTF attribute -> (V, C) values as stored.

    Raises:
        TronError: damaged data, more triangles than announced, or an attribute that is not there.
    """
    # Draco allocates what the header says before it reads on.
    triangles = _announced_triangles(blob)
    if triangles > most_triangles:
        raise TronError(f"Draco mesh announces {triangles:,} triangles, its accessors {most_triangles:,}")
    try:
        mesh = DracoPy.decode(blob)
    except Exception as error:  # DracoPy has no exception of its own for damaged data
        raise TronError(f"Draco mesh cannot be decoded: {error}") from error
    faces = getattr(mesh, "faces", None)
    if faces is None:
        raise TronError("Draco buffer holds points, not triangles")
    stored = {attribute["unique_id"]: attribute["data"] for attribute in mesh.attributes}
    if missing := [name for name, number in ids.items() if number not in stored]:
        raise TronError(f"Draco mesh lacks the attribute {missing[0]}")
    values = {name: np.asarray(stored[number]) for name, number in ids.items()}
    columns = {name: each[:, None] if each.ndim == 1 else each for name, each in values.items()}
    return np.asarray(faces, np.int64).reshape(-1, 3), columns


def _announced_triangles(blob: bytes) -> int:
    """Number of triangles in Draco's header (Draco bitstream specification 2.2, sections 3 and 4)."""
    try:
        if blob[:5] != b"DRACO" or blob[7] != 1:
            raise TronError("Draco buffer holds no mesh")
        major, minor, edgebreaker = blob[5], blob[6], blob[8]
        if (major, minor) < (2, 2):
            raise TronError(f"Draco bitstream {major}.{minor} is older than 2.2")
        if int.from_bytes(blob[9:11], "little") & _DRACO_METADATA:
            raise TronError("Draco mesh with metadata is not read", mend="compress it without")
        if not edgebreaker:
            return _varint(blob, 11)[0]
        _, place = _varint(blob, 12)  # a byte of traversal type, then the number of vertices
        return _varint(blob, place)[0]
    except IndexError as error:
        raise TronError("Draco buffer is too short") from error


def _varint(blob: bytes, place: int) -> tuple[int, int]:
    """Unsigned LEB128 number, and where it ends."""
    value = shift = 0
    while True:
        byte = blob[place]
        value |= (byte & 0x7F) << shift
        place, shift = place + 1, shift + 7
        if byte < 0x80 or shift > 63:
            return value, place
