"""Cube maps of DDS and KTX2: six faces of the largest level, in both formats' common order and orientation.

Faces are +x, -x, +y, -y, +z, -z as Direct3D, OpenGL and Vulkan sample them: seen from inside the cube with
y up, +x is to the right of +z. Sources: Microsoft's "DDS_HEADER" and "DXGI_FORMAT", Khronos' KTX 2.0
specification and Vulkan's VkFormat. Blocks (BC1, BC3, BC6H, BC7) and Zstandard are imagecodecs' work, Basis
is opengl_basisu's; plain pixels are read here.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from tron.color import srgb_to_linear
from tron.errors import TronError
from tron.io.image_headers import AGAIN, check_size
from tron.io.optional import basisu, codecs

DDS, KTX2 = b"DDS ", b"\xabKTX 20\xbb\r\n\x1a\n"
_FACES = 6
_CUBEMAP, _ALL_FACES, _CUBE_OF_DX10 = 0x200, 0xFC00, 0x4
_RGB = 0x40


class _Format(NamedTuple):
    """How texels lie in a file: bytes of a block, texels of its side, and how blocks become (H, W, 3)."""

    size: int
    side: int
    decode: Callable[[bytes, int], np.ndarray]
    display: bool = False

    def bytes_of(self, resolution: int) -> int:
        return (-(-resolution // self.side)) ** 2 * self.size


def _plain(kind: str, channels: int, order: tuple[int, ...] = (0, 1, 2), display: bool = False) -> _Format:
    def decode(data: bytes, side: int) -> np.ndarray:
        texels = np.frombuffer(data, kind).reshape(side, side, channels)[..., order]
        return texels.astype(np.float32) / (255 if display else 1)

    return _Format(np.dtype(kind).itemsize * channels, 1, decode, display)


def _blocks(size: int, name: str, display: bool = True) -> _Format:
    def decode(data: bytes, side: int) -> np.ndarray:
        library = codecs("block-compressed cube maps")
        whole = -(-side // 4) * 4
        shape = (whole, whole, 4) if display else (whole, whole, 3)
        texels = library.bcn_decode(data, library.BCN.FORMAT[name], shape=shape)
        return np.asarray(texels[:side, :side, :3], np.float32) / (255 if display else 1)

    return _Format(size, 4, decode, display)


def _shared_exponent(data: bytes, side: int) -> np.ndarray:
    """E5B9G9R9: nine bits a channel times 2 to the (exponent - 24)."""
    word = np.frombuffer(data, "<u4").reshape(side, side, 1)
    return ((word >> [0, 9, 18]) & 511) * np.exp2((word >> 27).astype(np.float32) - 24)


def _small_floats(data: bytes, side: int) -> np.ndarray:
    """B10G11R11: floats without sign, of half's exponent, with 6, 6 and 5 bits of fraction."""
    word = np.frombuffer(data, "<u4").reshape(side, side)
    bits = np.stack([(word & 2047) << 4, (word >> 11 & 2047) << 4, (word >> 22) << 5], axis=-1)
    return bits.astype(np.uint16).view(np.float16).astype(np.float32)


_RGBA32F, _RGB32F, _RGBA16F = _plain("<f4", 4), _plain("<f4", 3), _plain("<f2", 4)
_E5B9G9R9, _B10G11R11 = _Format(4, 1, _shared_exponent), _Format(4, 1, _small_floats)
_RGBA8, _BGRA8 = _plain("u1", 4, display=True), _plain("u1", 4, (2, 1, 0), display=True)
_RGB8, _BGR8 = _plain("u1", 3, display=True), _plain("u1", 3, (2, 1, 0), display=True)
_BC1, _BC3, _BC7 = _blocks(8, "BC1"), _blocks(16, "BC3"), _blocks(16, "BC7")
_BC6HU, _BC6HS = _blocks(16, "BC6HU", display=False), _blocks(16, "BC6HS", display=False)

_DXGI = {
    2: _RGBA32F, 6: _RGB32F, 10: _RGBA16F, 26: _B10G11R11, 67: _E5B9G9R9, 28: _RGBA8, 29: _RGBA8, 87: _BGRA8,
    91: _BGRA8, 71: _BC1, 72: _BC1, 77: _BC3, 78: _BC3, 95: _BC6HU, 96: _BC6HS, 98: _BC7, 99: _BC7,
}  # fmt: skip
_FOURCC = {
    struct.pack("<I", 113): _RGBA16F,
    struct.pack("<I", 116): _RGBA32F,
    b"DXT1": _BC1,
    b"DXT5": _BC3,
}
_VULKAN = {
    109: _RGBA32F, 106: _RGB32F, 97: _RGBA16F, 90: _plain("<f2", 3), 122: _B10G11R11, 123: _E5B9G9R9,
    37: _RGBA8, 43: _RGBA8, 44: _BGRA8, 50: _BGRA8, 23: _RGB8, 29: _RGB8, 30: _BGR8, 36: _BGR8,
    **dict.fromkeys(range(131, 135), _BC1), 137: _BC3, 138: _BC3, 143: _BC6HU, 144: _BC6HS, 145: _BC7,
    146: _BC7,
}  # fmt: skip


def open_cube(data: bytes) -> tuple[np.ndarray, bool]:
    """Six faces (6, R, R, 3) float32, linear, of a DDS or KTX2, and whether they were display values.

    Raises:
        TronError: damaged, no cube map, a pixel format that is not read, or a library that is not installed.
    """
    try:
        faces, display = (_open_dds if data.startswith(DDS) else _open_ktx2)(data)
    except (struct.error, ValueError, zlib.error, OverflowError) as error:
        raise TronError("cube map is damaged or cut short", mend=AGAIN) from error
    return (np.asarray(srgb_to_linear(faces), np.float32) if display else faces), display


def _open_dds(data: bytes) -> tuple[np.ndarray, bool]:
    height, width = struct.unpack_from("<2I", data, 12)
    (levels,) = struct.unpack_from("<I", data, 28)
    flags, code, bits, red = struct.unpack_from("<I4s2I", data, 80)
    (caps,) = struct.unpack_from("<I", data, 112)
    cube, start = caps & _CUBEMAP and caps & _ALL_FACES == _ALL_FACES, 128
    if code == b"DX10":
        number, _, misc = struct.unpack_from("<3I", data, 128)
        known, cube, start = _DXGI.get(number), misc & _CUBE_OF_DX10, 148
    elif flags & _RGB and bits in (24, 32):
        number = f"of {bits} bits"
        known = {(24, 0xFF0000): _BGR8, (24, 0xFF): _RGB8, (32, 0xFF0000): _BGRA8, (32, 0xFF): _RGBA8}.get(
            (bits, red)
        )
    else:
        number, known = code, _FOURCC.get(code)
    _require_cube(bool(cube), width, height, len(data))
    if known is None:
        raise _unknown("DDS", number)
    sides = [max(width >> level, 1) for level in range(max(levels, 1))]
    stride = sum(map(known.bytes_of, sides))
    size = known.bytes_of(width)
    faces = [data[start + face * stride :][:size] for face in range(_FACES)]
    return np.stack([known.decode(_whole(face, size), width) for face in faces]), known.display


def _open_ktx2(data: bytes) -> tuple[np.ndarray, bool]:
    number, _, width, height, _, _, count, _, scheme = struct.unpack_from("<9I", data, 12)
    _require_cube(count == _FACES, width, height, len(data))
    if number == 0:
        texture = basisu("cube maps of Basis").open(data)
        faces = [texture.transcode("rgba8", face=face).data[..., :3] for face in range(_FACES)]
        return np.stack(faces).astype(np.float32) / 255, True
    known = _VULKAN.get(number)
    if known is None:
        raise _unknown("KTX2", number)
    start, stored = struct.unpack_from("<2Q", data, 80)
    size = known.bytes_of(width)
    level = data[start : start + stored]
    if scheme == 2:
        library = codecs("Zstandard in KTX2")
        try:
            level = library.zstd_decode(level, out=_FACES * size)
        except library.ZstdError as error:
            raise ValueError(str(error)) from error
    elif scheme == 3:
        level = zlib.decompressobj().decompress(level, _FACES * size)
    elif scheme != 0:
        raise TronError(f"supercompression {scheme} of KTX2 is not read", mend="store it with Zstandard")
    faces = [level[face * size : (face + 1) * size] for face in range(_FACES)]
    return np.stack([known.decode(_whole(face, size), width) for face in faces]), known.display


def _whole(data: Any, size: int) -> bytes:
    if len(data) != size:
        raise ValueError("cut short")
    return bytes(data)


def _require_cube(cube: bool, width: int, height: int, file_bytes: int) -> None:
    if not cube:
        raise TronError("not a cube map: it has no six faces", mend="give a lat-long .hdr or .exr")
    if width != height or width < 2:
        raise TronError(f"faces of {width} x {height} pixels are not square", mend=AGAIN)
    check_size(width, _FACES * width, 4, file_bytes)


def _unknown(kind: str, number: Any) -> TronError:
    return TronError(
        f"pixel format {number} of {kind} is not read", mend="store it as half floats (R16G16B16A16) or BC6H"
    )
