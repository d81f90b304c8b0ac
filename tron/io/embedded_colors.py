"""Colours that a picture of display values says it is in (ICC, cICP, nclx, gAMA, EXIF), brought to sRGB.

Of several statements the first holds: PNG's cICP, an ICC profile, HEIC's and AVIF's nclx, PNG's sRGB chunk,
its gAMA and cHRM, EXIF's Adobe RGB. Without any a picture is in sRGB. Profiles are Pillow's ImageCms' work;
what has 16 bits, which that cannot take, goes through the profile's own curves and matrix. EXIF's
"uncalibrated", which phones write beside a profile, is a line where the profile was lost.
"""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from PIL import Image, ImageCms

from tron.color import linear_to_srgb, srgb_to_linear
from tron.errors import TronError
from tron.io.color_spaces import HLG, PQ, PRIMARIES, TRANSFERS, chromaticities_of, in_bt709, srgb_of, to_bt709

_UNSPECIFIED = 2
_SRGB_LIKE = {1, 6, 13, 14, 15}
"""Transfer characteristics that :func:`tron.io.color_spaces.light_of` takes as sRGB's."""
_SRGB_GAMMA, _GAMMA_MARGIN = 1 / 2.2, 0.05
"""A gAMA within this share of sRGB's stands for sRGB, as libpng has it."""
_ADOBE = (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, 0.3127, 0.3290)
_ADOBE_GAMMA = 563 / 256
_EXIF, _COLOR_SPACE, _INTEROPERABILITY = 0x8769, 0xA001, 0xA005
_ADOBE_SPACE, _UNCALIBRATED, _ADOBE_INTEROPERABILITY = 2, 0xFFFF, "R03"
"""Of EXIF's ColorSpace: 2, which the standard does not have, is what some cameras write for Adobe RGB."""
_SAME_LEVELS = 2
"""Profiles that change no colour by more levels of 8 bits are sRGB's, of which many are about."""
_STEPS = 9
_NCLX, _AVIF_HEAD = re.compile(rb"colrnclx(....)", re.DOTALL), 1 << 16
"""AVIF's box of code points (ISO/IEC 14496-12, 12.1.5), not told by Pillow, in a file's first part."""


@dataclass(frozen=True)
class DisplayColors:
    """Colour space of a picture's display values, and the way to sRGB.

    Attributes:
        name: of the colour space, and where it is stated.
        floats: sRGB (..., 3) float32 of values (..., 3) in [0, 1]; None: it is sRGB, or has only ``levels``.
        levels: the same of (H, W, 1 or 3) uint8, where there is a faster way.
        note: what is to be said beside that it is converted.
        inks: values are CMYK, which ``levels`` takes.
        wide: values are HLG's or PQ's, for which 8 bits are too few.
    """

    name: str = "sRGB"
    floats: Callable[[np.ndarray], np.ndarray] | None = None
    levels: Callable[[np.ndarray], np.ndarray] | None = None
    note: str = ""
    inks: bool = False
    wide: bool = False

    @property
    def converted(self) -> bool:
        """Whether values change."""
        return self.floats is not None or self.levels is not None

    def notes(self) -> list[str]:
        """Lines for the user: what is converted, what is not known."""
        said = [f"colours are brought from {self.name} to sRGB"] if self.converted else []
        return [*said, self.note] if self.note else said

    def srgb(self, pixels: np.ndarray) -> np.ndarray:
        """sRGB of (H, W, 1 to 4) uint8 or uint16, of the same type and shape; alpha stays as it is.

        CMYK (H, W, 4) becomes RGB (H, W, 3).
        """
        if not self.converted:
            return pixels
        if self.inks:
            assert self.levels is not None
            return self.levels(pixels)
        count = pixels.shape[2] if pixels.shape[2] in (1, 3) else pixels.shape[2] - 1
        color, largest = pixels[..., :count], np.iinfo(pixels.dtype).max
        if self.levels is not None and (pixels.dtype == np.uint8 or self.floats is None):
            eight = color if pixels.dtype == np.uint8 else (color >> 8).astype(np.uint8)
            result = self.levels(eight).astype(pixels.dtype) * (1 if pixels.dtype == np.uint8 else 257)
        else:
            assert self.floats is not None
            values = np.repeat(color, 3, axis=2) if count == 1 else color
            result = np.round(self.floats(values / np.float32(largest)) * largest).astype(pixels.dtype)
        return np.concatenate([result[..., :count], pixels[..., count:]], axis=2)


def colors_of_file(picture: Image.Image, data: bytes = b"") -> DisplayColors:
    """Colours of a picture that Pillow has opened; PNG's chunks and AVIF's box are looked for in its bytes.

    Raises:
        TronError: PNG's cICP states a colour space that is not converted.
    """
    chunks = dict(_chunks(data)) if picture.format == "PNG" else {}
    if len(code := chunks.get(b"cICP", b"")) >= 4:
        return colors_of_code_points(code[0], code[1], "cICP")
    if profile := picture.info.get("icc_profile"):
        return colors_of_profile(bytes(profile), picture.mode)
    if picture.format == "AVIF" and (code := _NCLX.search(data[:_AVIF_HEAD])):
        primaries, transfer = struct.unpack(">HH", code[1])
        return colors_of_code_points(primaries, transfer, "nclx")
    if b"sRGB" in chunks:
        return DisplayColors()
    if b"gAMA" in chunks or b"cHRM" in chunks:
        return _colors_of_gamma(chunks)
    space, index = _exif(picture, _EXIF, _COLOR_SPACE), _exif(picture, _INTEROPERABILITY, 1)
    if space == _ADOBE_SPACE or str(index).strip("\0 ") == _ADOBE_INTEROPERABILITY:
        return DisplayColors("Adobe RGB (EXIF)", _by_gamma(_ADOBE_GAMMA, _ADOBE))
    if space == _UNCALIBRATED:
        return DisplayColors(note="EXIF says that its colours are not sRGB's, and not which: read as sRGB")
    return DisplayColors()


def _exif(picture: Image.Image, folder: int, tag: int) -> Any:
    """A value of one of EXIF's folders; None where it is not there."""
    try:
        return picture.getexif().get_ifd(folder).get(tag)
    except KeyError:  # Pillow before 13 says so that there is no such folder
        return None


def colors_of_code_points(primaries: int, transfer: int, where: str) -> DisplayColors:
    """Colours of H.273's code points.

    Raises:
        TronError: code points that are not converted.
    """
    unknown = [
        name
        for name, code in (("primaries", primaries), ("transfer characteristic", transfer))
        if code == _UNSPECIFIED
    ]
    note = f"{where} leaves its {' and '.join(unknown)} open: read as sRGB's" if unknown else ""
    primaries = 1 if primaries == _UNSPECIFIED else primaries
    transfer = 13 if transfer == _UNSPECIFIED else transfer
    if primaries not in PRIMARIES or transfer not in TRANSFERS:
        raise TronError(
            f"colour space of {where} is not converted (primaries {primaries}, transfer {transfer} of H.273)",
            mend="store the picture in sRGB",
        )
    if transfer in _SRGB_LIKE and to_bt709(chromaticities_of(primaries)) is None:
        return DisplayColors(note=note)
    if transfer in (PQ, HLG):
        note = "what is brighter than its white of 203 cd/m2 is clipped"
    name = f"{PRIMARIES[primaries]}, {TRANSFERS[transfer]} ({where})"
    return DisplayColors(
        name, lambda values: srgb_of(values, primaries, transfer), note=note, wide=transfer in (PQ, HLG)
    )


def colors_of_profile(profile: bytes, mode: str) -> DisplayColors:
    """Colours of an ICC profile in a picture of Pillow's ``mode``; one that does not fit it is a note."""
    channels = {"L": "L", "LA": "L", "1": "L", "CMYK": "CMYK"}.get(
        mode, "L" if mode.startswith("I") else "RGB"
    )
    return _colors_of_profile(profile, channels)


@lru_cache(maxsize=32)
def _colors_of_profile(profile: bytes, mode: str) -> DisplayColors:
    try:
        opened = ImageCms.getOpenProfile(io.BytesIO(profile))
        core: Any = opened.profile
        name = " ".join(ImageCms.getProfileDescription(opened).split()) or "a profile without a name"
        space = core.xcolor_space.strip()
    except (ImageCms.PyCMSError, OSError, ValueError):
        return DisplayColors(note="ICC profile is damaged: read as sRGB")
    # Grey pictures with RGB's profiles are common, and mean its grey.
    if {"L": "GRAY"}.get(mode, mode) != space and (mode, space) != ("L", "RGB"):
        return DisplayColors(note=f"ICC profile '{name}' is of {space}, the picture is not: read as sRGB")
    source = "RGB" if space == "RGB" else mode
    try:
        transform = ImageCms.buildTransform(
            opened,
            ImageCms.createProfile("sRGB"),
            source,
            "RGB",
            ImageCms.Intent.RELATIVE_COLORIMETRIC,
        )
    except (ImageCms.PyCMSError, OSError, ValueError):
        return DisplayColors(note=f"ICC profile '{name}' cannot be used: read as sRGB")

    def levels(pixels: np.ndarray) -> np.ndarray:
        if source == "RGB" and pixels.shape[2] == 1:
            pixels = np.repeat(pixels, 3, axis=2)
        stored = np.ascontiguousarray(pixels[..., 0] if source == "L" else pixels)
        size = stored.shape[1], stored.shape[0]
        picture = Image.frombuffer(source, size, stored.tobytes(), "raw", source, 0, 1)
        return np.asarray(ImageCms.applyTransform(picture, transform))

    if source != "CMYK":
        lattice = np.stack(np.meshgrid(*3 * [np.linspace(0, 255, _STEPS).astype(np.uint8)]), axis=-1)
        lattice = lattice.reshape(_STEPS, -1, 3)[..., : 1 if source == "L" else 3]
        if np.abs(levels(lattice).astype(int) - lattice).max() <= _SAME_LEVELS:
            return DisplayColors()
    floats = _by_curves(profile) if source == "RGB" else None
    if source == "L":
        floats = _by_table(levels(np.arange(256, dtype=np.uint8).reshape(1, -1, 1))[0, :, 0] / 255)
    note = "of 16 bits 8 are kept: the profile is a table" if source == "RGB" and floats is None else ""
    return DisplayColors(f"{name} (ICC profile)", floats, levels, note, inks=source == "CMYK")


def _by_table(table: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Conversion of every channel by 256 values."""
    return lambda values: np.interp(values * 255, np.arange(256), table).astype(np.float32)


def _by_curves(profile: bytes) -> Callable[[np.ndarray], np.ndarray] | None:
    """Conversion by the curves and the matrix of an RGB profile (ICC.1:2022); None where it has tables."""
    tags = _tags(profile)
    names = [b"rTRC", b"gTRC", b"bTRC", b"rXYZ", b"gXYZ", b"bXYZ"]
    if not set(names) <= set(tags) or {b"A2B0", b"A2B1"} & set(tags):
        return None
    tables = [table for name in names[:3] if (table := _curve(tags[name])) is not None]
    if len(tables) < 3:
        return None
    own = np.array([struct.unpack_from(">3i", tags[name], 8) for name in names[3:]]).T / 65536
    of_srgb: Any = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).profile
    corners = (of_srgb.red_colorant, of_srgb.green_colorant, of_srgb.blue_colorant)
    srgb = np.array([corner[0] for corner in corners if corner is not None]).T
    matrix = np.linalg.solve(srgb, own).T.astype(np.float32)

    def convert(values: np.ndarray) -> np.ndarray:
        steps = np.linspace(0, 1, 2**16)
        linear = np.stack([np.interp(values[..., i], steps, tables[i]) for i in range(3)], axis=-1)
        return linear_to_srgb(np.clip(linear.astype(np.float32) @ matrix, 0, 1))

    return convert


def _tags(profile: bytes) -> dict[bytes, bytes]:
    """Tags of an ICC profile by their signatures."""
    if len(profile) < 132:
        return {}
    count = min(struct.unpack_from(">I", profile, 128)[0], (len(profile) - 132) // 12)
    entries = (struct.unpack_from(">4sII", profile, 132 + 12 * index) for index in range(count))
    return {name: profile[start : start + size] for name, start, size in entries}


def _curve(tag: bytes) -> np.ndarray | None:
    """(65536,) float64: a tone curve at even steps; None where it is damaged."""
    x = np.linspace(0, 1, 2**16)
    try:
        if tag[:4] == b"curv":
            (count,) = struct.unpack_from(">I", tag, 8)
            if count == 0:
                return x
            values = np.frombuffer(tag, ">u2", count, 12)
            if count == 1:
                return x ** (values[0] / 256)
            return np.interp(x, np.linspace(0, 1, count), values / 65535)
        if tag[:4] != b"para":
            return None
        (kind,) = struct.unpack_from(">H", tag, 8)
        given = np.frombuffer(tag, ">i4", {0: 1, 1: 3, 2: 4, 3: 5, 4: 7}[kind], 12) / 65536
    except (struct.error, ValueError, KeyError):
        return None
    g, a, b = (*given, 1.0, 0.0)[:3] if kind == 0 else given[:3]
    c = e = f = 0.0
    d = -b / a if kind in (1, 2) and a else 0.0
    if kind == 2:  # the constant c is added on both sides of -b / a
        e = f = given[3]
    elif kind >= 3:
        c, d = given[3:5]
        e, f = given[5:7] if kind == 4 else (0.0, 0.0)
    return np.where(x >= d, np.maximum(a * x + b, 0) ** g + e, c * x + f)


def _colors_of_gamma(chunks: dict[bytes, bytes]) -> DisplayColors:
    """Colours of PNG's chunks gAMA and cHRM, in hundred thousandths."""
    gamma = space = None
    if len(chunks.get(b"gAMA", b"")) == 4:
        gamma = struct.unpack(">I", chunks[b"gAMA"])[0] / 1e5
    if len(chunks.get(b"cHRM", b"")) == 32:
        white_first = np.array(struct.unpack(">8I", chunks[b"cHRM"])) / 1e5
        space = tuple(float(value) for value in np.roll(white_first, -2))
    if gamma is not None and not 0.05 <= gamma <= 20:
        return DisplayColors(note=f"gAMA of {gamma:.4g} means nothing: read as sRGB")
    plain = gamma is None or abs(gamma / _SRGB_GAMMA - 1) <= _GAMMA_MARGIN
    if plain and (space is None or to_bt709(space) is None):
        return DisplayColors()
    stated = " and ".join(name for name, given in (("gAMA", gamma), ("cHRM", space)) if given is not None)
    exponent = None if plain or gamma is None else 1 / gamma
    of_gamma = "" if exponent is None else f", gamma {exponent:.3g}"
    return DisplayColors(f"what is stated by {stated}{of_gamma}", _by_gamma(exponent, space))


def _by_gamma(exponent: float | None, space: tuple[float, ...] | None) -> Callable[[np.ndarray], np.ndarray]:
    """Conversion of values by a power, None for sRGB's curve, and chromaticities, None for sRGB's."""

    def convert(values: np.ndarray) -> np.ndarray:
        values = np.asarray(values, np.float32)
        linear = srgb_to_linear(values) if exponent is None else values ** np.float32(exponent)
        linear = linear if space is None else in_bt709(linear, space)
        return linear_to_srgb(np.clip(linear, 0, 1))

    return convert


def _chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Chunks of a PNG before its pixels: (name, content)."""
    at = 8
    while at + 12 <= len(data):
        size, name = struct.unpack_from(">I4s", data, at)
        if name == b"IDAT":
            return
        yield name, data[at + 8 : at + 8 + size]
        at += 12 + size
