"""Niantic's .spz: what its header says of the splats beside them, and finer steps than gaussforge writes.

The header is the first 16 bytes of what gzip packs, or of the file from version 4 on; there it has 32 bytes,
and its extensions follow up to the table of contents. Before, extensions stand behind the splats. Each is a
type, a length and as many bytes (https://github.com/nianticlabs/spz, extensions/README.md).

Places are 24-bit numbers with as many fractional bits as the header says. gaussforge always takes 12: places
beyond 2,048 wrap around, and a scene of a few centimetres stands on a grid. Here there are fewer where the
scene is wide, and more where it is smaller than a unit: at least 4,096 steps from its origin to its edge.

.spz has a byte for each coefficient, which writers round to fewer bits so that gzip packs them well
(``quantizeSH``). gaussforge takes 5 bits of degree 1 and 4 of degrees 2 and 3. Light baked into surfels is
lost by that: all else that .spz rounds costs far less. On two development worlds of 20,000 surfels, read by
splat-transform and held against what went in:

    bits 5, 4   36.0, 36.4 dB   206, 210 kB
    bits 5, 5   38.1, 39.2 dB   230, 233 kB
    bits 6, 6   40.4, 42.7 dB   284, 293 kB
    bits 8, 8   47.1, 49.0 dB   450, 468 kB
"""

from __future__ import annotations

import gzip
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tron.errors import TronError
from tron.gaussians.formats import packed
from tron.gaussians.ply import GUESSED_UP, Stored

HALF_TURN = np.diag([1.0, -1.0, -1.0])
"""Between the frames of .spz (y up, https://github.com/nianticlabs/spz) and of 3DGS (y down)."""
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
BITS = 6
"""Of each coefficient: steps of 1/32."""
_VERSION = 3
_PLACE, _OTHERS = 9, 1 + 3 + 3 + 4
"""Bytes of a splat's place, and of its opacity, colour, scales and rotation; its harmonics come last."""
_LARGEST = 2**23 - 1
_FRACTION, _FINEST = 12, 20
"""Fractional bits of places: those of other writers, and the most, steps of a millionth."""


def read(path: Path) -> Stored:
    """What a file holds, in its own frame; gaussforge leaves y and z as they are there.

    Raises:
        TronError: as :func:`tron.gaussians.formats.packed.read`.
    """
    stored, header = packed.read(path, "spz"), read_header(path.read_bytes())
    up = GUESSED_UP @ header.turn
    return stored._replace(up=up, turn=header.turn, up_known=header.stated, antialiased=header.antialiased)


def write(scene: Mapping[str, Any]) -> bytes:
    """A file of what a scene of kernel degree 2 holds, in .spz' usual frame; TronError as :func:`refined`."""
    return refined(packed.write(scene, "spz"), scene["means"], scene["sh"])


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


def refined(content: bytes, means: np.ndarray, sh: np.ndarray) -> bytes:
    """A file of .spz with places and harmonics of its splats written anew.

    Args:
        content: of version 3, packed by gzip.
        means: (M, 3) of the splats in their order, in the file's frame.
        sh: (M, 16, 3), likewise; degree 0 is the file's own, and degrees that it has not are left out.

    Raises:
        TronError: the file is not of that version or number of splats; places lie beyond 2**23.
    """
    plain, count = gzip.decompress(content), len(sh)
    header = HEADER.unpack_from(plain)
    terms = (header[3] + 1) ** 2
    held = 3 * (terms - 1)
    whole = HEADER.size + count * (_PLACE + _OTHERS + held)
    if header[:3] != (MAGIC, _VERSION, count) or terms > sh.shape[1] or len(plain) != whole:
        raise TronError(f"gaussforge packed a file of version {header[1]}, which is not known here")
    farthest = float(np.abs(means).max(initial=0))
    if farthest > _LARGEST:
        raise TronError(f".spz holds no place as far out as {farthest:.3g}", mend="write .ply or .sog")
    fraction = _fraction(farthest)
    fixed = np.round(np.asarray(means, np.float64) * 2**fraction).astype("<i4")
    places = fixed.view(np.uint8).reshape(count, 3, 4)[..., :3]
    step = 2 ** (8 - BITS)
    bytes_of = np.round(np.asarray(sh[:, 1:terms], np.float64) * 128) + 128
    rounded = np.clip(np.floor((bytes_of + step // 2) / step) * step, 0, 255).astype(np.uint8)
    others = plain[HEADER.size + count * _PLACE : len(plain) - count * held]
    begins = HEADER.pack(*header[:4], fraction, *header[5:])
    return gzip.compress(begins + places.tobytes() + others + rounded.tobytes(), mtime=0)


def _fraction(farthest: float) -> int:
    if farthest == 0:
        return _FRACTION
    wanted = _FRACTION + max(0, int(np.ceil(-np.log2(farthest))))
    return min(_FINEST, wanted, int(np.log2(_LARGEST / farthest)))
