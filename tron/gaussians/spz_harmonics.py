"""Harmonics in files of .spz, in finer steps than gaussforge's.

.spz has a byte for each coefficient, which writers round to fewer bits so that gzip packs them well
(https://github.com/nianticlabs/spz, ``quantizeSH``). gaussforge takes 5 bits of degree 1 and 4 of degrees 2
and 3. Light baked into surfels is lost by that: all else that .spz rounds costs far less. On two development
worlds of 20,000 surfels, read by splat-transform and held against what went in:

    bits 5, 4   36.0, 36.4 dB   206, 210 kB
    bits 5, 5   38.1, 39.2 dB   230, 233 kB
    bits 6, 6   40.4, 42.7 dB   284, 293 kB
    bits 8, 8   47.1, 49.0 dB   450, 468 kB
"""

from __future__ import annotations

import gzip
import struct

import numpy as np

BITS = 6
"""Of each coefficient: steps of 1/32."""
_MAGIC, _VERSION, _DEGREE = 0x5053474E, 3, 3
_HEADER, _OTHERS = struct.Struct("<IIIBBBB"), 9 + 1 + 3 + 3 + 4
"""Of the file, and bytes of a splat before its harmonics: place, opacity, colour, scales, rotation."""


def with_harmonics(content: bytes, sh: np.ndarray) -> bytes:
    """A file of .spz with the harmonics of its splats written anew.

    Args:
        content: of version 3 and degree 3, packed by gzip; any other comes back as it is.
        sh: (M, 16, 3) of the splats in their order, in the file's frame; degree 0 is the file's own.
    """
    plain = gzip.decompress(content)
    count, held = len(sh), 3 * (sh.shape[1] - 1)
    if len(plain) != _HEADER.size + count * (_OTHERS + held):
        return content
    if _HEADER.unpack_from(plain)[:4] != (_MAGIC, _VERSION, count, _DEGREE):
        return content
    step = 2 ** (8 - BITS)
    bytes_of = np.round(np.asarray(sh[:, 1:], np.float64) * 128) + 128
    rounded = np.clip(np.floor((bytes_of + step // 2) / step) * step, 0, 255).astype(np.uint8)
    return gzip.compress(plain[: len(plain) - count * held] + rounded.tobytes(), mtime=0)
