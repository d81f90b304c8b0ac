"""Size of a JPEG XL picture, from its header alone (ISO/IEC 18181-1, SizeHeader; 18181-2, boxes)."""

from __future__ import annotations

import struct

from tron.errors import TronError
from tron.io.image_headers import AGAIN

JXL = (b"\xff\x0a", b"\0\0\0\x0cJXL ")
_RATIOS = {1: (1, 1), 2: (12, 10), 3: (4, 3), 4: (3, 2), 5: (16, 9), 6: (5, 4), 7: (2, 1)}
_BITS = (9, 13, 18, 30)


def jpeg_xl_size(data: bytes) -> tuple[int, int]:
    """Width and height in pixels; TronError if the header is damaged."""
    start = 0 if data.startswith(JXL[0]) else _codestream(data)
    bits = int.from_bytes(data[start + 2 : start + 14], "little")

    def take(count: int) -> int:
        nonlocal bits
        value, bits = bits & (1 << count) - 1, bits >> count
        return value

    small = take(1)

    def side() -> int:
        return (take(5) + 1) * 8 if small else take(_BITS[take(2)]) + 1

    height, ratio = side(), take(3)
    if ratio:
        over, under = _RATIOS[ratio]
        return height * over // under, height
    return side(), height


def _codestream(data: bytes) -> int:
    """Where the codestream begins in a file of boxes."""
    at = 0
    while at + 16 <= len(data):
        size, kind, large = struct.unpack_from(">I4sQ", data, at)
        head = 16 if size == 1 else 8
        if kind in (b"jxlc", b"jxlp"):
            return at + head + (4 if kind == b"jxlp" else 0)
        size = large if size == 1 else size
        if size < head:
            break
        at += size
    raise TronError("JPEG XL picture is damaged or cut short", mend=AGAIN)
