"""Places and harmonics in files of .spz, in finer steps than gaussforge's.

Places are 24-bit numbers with as many fractional bits as the header says
(https://github.com/nianticlabs/spz). gaussforge always takes 12: places beyond 2,048 wrap around, and a scene
of a few centimetres stands on a grid. Here there are fewer where the scene is wide, and more where it is
smaller than a unit: at least 4,096 steps from its origin to its edge.

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

import numpy as np

from tron.errors import TronError
from tron.gaussians.spz_header import HEADER, MAGIC

BITS = 6
"""Of each coefficient: steps of 1/32."""
_VERSION = 3
_PLACE, _OTHERS = 9, 1 + 3 + 3 + 4
"""Bytes of a splat's place, and of its opacity, colour, scales and rotation; its harmonics come last."""
_LARGEST = 2**23 - 1
_FRACTION, _FINEST = 12, 20
"""Fractional bits of places: those of other writers, and the most, steps of a millionth."""


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
