"""What a file of .spz says of its splats beside them: their frame, and whether they are antialiased.

The header is the first 16 bytes of what gzip packs, or of the file from version 4 on; there it has 32 bytes,
and its extensions follow up to the table of contents. Before, extensions stand behind the splats. Each is a
type, a length and as many bytes (https://github.com/nianticlabs/spz, extensions/README.md).
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

import numpy as np

MAGIC = 0x5053474E
HEADER = struct.Struct("<IIIBBBB")
"""Magic, version, splats, degree of harmonics, fractional bits of places, flags, and a byte that version 4
counts its streams in."""
_ANTIALIASED, _EXTENDED = 1, 2
_FRAME = 0xADBE0003
_FRAMES = (
    "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF",
    "LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU",
)  # fmt: skip
"""By the number of SPZ_ADOBE_coordinate_system, from 1: where x, y and z point. 0 is not specified."""
_POINTS = {
    "L": (-1, 0, 0), "R": (1, 0, 0), "U": (0, -1, 0), "D": (0, 1, 0), "F": (0, 0, 1), "B": (0, 0, -1),
}  # fmt: skip
"""Left, right, up, down, front and back in the frame of 3DGS' PLYs, which is right, down, front."""
_USUAL = "RUB"
_MOST = 1 << 20
"""Bytes of extensions that are looked at."""


@dataclass(frozen=True)
class SpzHeader:
    """A file's header.

    Attributes:
        frame: where x, y and z point, such as "RUB": right, up, back.
        stated: whether the file says so; what it does not say is .spz' usual frame.
        antialiased: whether the splats are to be drawn with Mip-Splatting's filter of the screen.
    """

    frame: str = _USUAL
    stated: bool = False
    antialiased: bool = False

    @property
    def turn(self) -> np.ndarray:
        """(3, 3) from the file's frame into that of 3DGS' PLYs: a rotation, or a mirror image."""
        return np.array([_POINTS[letter] for letter in self.frame], np.float64).T


def read_header(content: bytes) -> SpzHeader:
    """The header of a file of .spz; what is damaged says nothing, and is told by whoever reads the splats."""
    try:
        unpacked, extensions = _parts(content)
        _, _, _, _, _, flags, _ = HEADER.unpack_from(unpacked)
    except (struct.error, zlib.error):
        return SpzHeader()
    antialiased, at = bool(flags & _ANTIALIASED), 0
    while flags & _EXTENDED and at + 8 <= len(extensions):
        kind, length = struct.unpack_from("<II", extensions, at)
        if kind == _FRAME and length == 4 and at + 12 <= len(extensions):
            (number,) = struct.unpack_from("<I", extensions, at + 8)
            if 0 < number <= len(_FRAMES):
                return SpzHeader(_FRAMES[number - 1], stated=True, antialiased=antialiased)
        at += 8 + length
    return SpzHeader(antialiased=antialiased)


def _parts(content: bytes) -> tuple[bytes, bytes]:
    """The header, and the bytes that hold extensions."""
    if not content.startswith(b"\x1f\x8b"):
        (end,) = struct.unpack_from("<I", content, HEADER.size)
        return content[: HEADER.size], content[2 * HEADER.size : min(end, 2 * HEADER.size + _MOST)]
    stream = zlib.decompressobj(wbits=31)
    head = stream.decompress(content, HEADER.size)
    _, version, count, degree, _, flags, _ = HEADER.unpack_from(head)
    if not flags & _EXTENDED:
        return head, b""
    skip = HEADER.size + count * _bytes_of_splat(version, degree)
    seen = len(head)
    while seen < skip:
        part = stream.decompress(stream.unconsumed_tail, min(skip - seen, _MOST))
        if not part:
            return head, b""
        seen += len(part)
    return head, stream.decompress(stream.unconsumed_tail, _MOST)


def _bytes_of_splat(version: int, degree: int) -> int:
    """Place (half floats in version 1), opacity, colour, scales, rotation, harmonics."""
    return (6 if version == 1 else 9) + 1 + 3 + 3 + (4 if version >= 3 else 3) + 3 * ((degree + 1) ** 2 - 1)
