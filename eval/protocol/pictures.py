"""Strict reader and writer of the protocol's pictures: every deviation from the format is a named fault.

OpenEXR holds linear values (or display values, if a method says so), PNG 8 bits. Nothing is resized,
converted or assumed: a method's figure must not depend on a reader's guess.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from PIL import Image, UnidentifiedImageError

from tron.errors import TronError
from tron.io.images import encode_exr, encode_png, read_image

SUFFIXES = (".exr", ".png")
_PNG_DEPTH_AT = 24
"""Byte of a PNG that holds its bit depth."""
_PNG = b"\x89PNG\r\n\x1a\n"
_TOP = 1.0 + 1e-4
"""Display values and reflectance that are above it are none."""

FaultKind = Literal[
    "missing_file",
    "missing_light",
    "missing_scene",
    "missing_frame",
    "wrong_size",
    "not_finite",
    "bit_depth",
    "palette",
    "alpha",
    "out_of_range",
    "mixed_suffixes",
    "unreadable",
    "leads_outside",
    "wrong_frame",
    "two_of_a_name",
]
Values = Literal["radiance", "display", "reflectance", "vector", "share", "distance"]
"""What a picture holds: light, display values, base color, a direction, a number in [0, 1], world units."""
_PLANES = ("share", "distance")
"""Of one channel."""
_NO_COLORS = ("vector", *_PLANES)


class Fault(TronError):
    """Something wrong or missing in a folder of the protocol; ``kind`` names it in tables."""

    def __init__(self, kind: FaultKind, what: str, where: str | Path | None = None, mend: str | None = None):
        super().__init__(what, where, mend)
        self.kind: FaultKind = kind

    def __reduce__(self) -> tuple[type[Fault], tuple[str | None, ...]]:
        return Fault, (self.kind, self.what, self.where, self.mend)


class Size(NamedTuple):
    """Size in pixels."""

    width: int
    height: int


def frame_name(number: int, suffix: str) -> str:
    """``0007.exr``."""
    return f"{number:04d}{suffix}"


def read_frames(folder: Path, count: int, size: Size, values: Values) -> np.ndarray:
    """Read a folder's numbered frames, (K, H, W, C) float32 as stored; C is 1, or 3 for colours and vectors.

    Args:
        folder: has 0000.png, 0001.png, .. or .exr, all of one suffix; other files are ignored.
        count, size: required number and size.
        values: kind of the stored values; their range is checked.

    Raises:
        Fault: the first thing that is wrong.
    """
    suffix = _suffix(folder, count)
    return np.stack([_read(folder / frame_name(k, suffix), size, values) for k in range(count)])


def write_frames(folder: Path, frames: np.ndarray, values: Values, suffix: str) -> None:
    """Write frames (K, H, W, C) for :func:`read_frames`; the folder must exist.

    In .exr, radiance and reflectance are half floats; directions and display values are float32, so they are
    read back exactly. A .png has 8 bits of display values, or of (n + 1) / 2 for directions.
    """
    for number, frame in enumerate(np.asarray(frames, np.float32)):
        if suffix == ".exr":
            half = values in ("radiance", "reflectance")
            data = encode_exr(frame, half=half, color=values not in _NO_COLORS)
        else:
            data = encode_png(frame, color=values not in _NO_COLORS)
        (folder / frame_name(number, suffix)).write_bytes(data)


def _suffix(folder: Path, count: int) -> str:
    found = {suffix: list(folder.glob(f"[0-9][0-9][0-9][0-9]{suffix}")) for suffix in SUFFIXES}
    there = [suffix for suffix, files in found.items() if files]
    if len(there) > 1:
        raise Fault("mixed_suffixes", "frames are .exr and .png", folder, "write all in one format")
    if not there:
        raise Fault("missing_frame", f"no frames 0000.png or 0000.exr, of {count}", folder)
    (suffix,) = there
    surplus = sorted(path.name for path in found[suffix] if int(path.stem) >= count)
    if surplus:
        raise Fault("missing_frame", f"frame {surplus[0]} of a scene with {count} test cameras", folder)
    return suffix


def _read(path: Path, size: Size, values: Values) -> np.ndarray:
    if not path.is_file():
        raise Fault("missing_frame", f"frame {path.name} is missing", path.parent)
    if path.suffix == ".png":
        _check_png(path, size)
    try:
        image = read_image(path, 1 if values in _PLANES else 3, color=values not in _NO_COLORS)
    except TronError as error:
        raise Fault("unreadable", error.what, path, error.mend) from error
    _check_size(Size(image.shape[1], image.shape[0]), size, path)
    bad = int((~np.isfinite(image)).sum())
    if bad:
        raise Fault("not_finite", f"{bad} values are NaN or infinite", path)
    bounded = values in ("display", "reflectance", "share")
    if bounded and (image.min() < -(_TOP - 1) or image.max() > _TOP):
        what = f"values from {image.min():.3g} to {image.max():.3g} are not in [0, 1]"
        raise Fault("out_of_range", what, path, "is it linear radiance? say color_space: linear")
    return image


def _check_size(found: Size, size: Size, path: Path) -> None:
    if found != size:
        what = f"{found.width} x {found.height} pixels, the suite's camera has {size.width} x {size.height}"
        raise Fault("wrong_size", what, path)


def _check_png(path: Path, size: Size) -> None:
    """Refuse a PNG whose header is not 8-bit grey or RGB; nothing is decoded."""
    with open(path, "rb") as file:
        header = file.read(_PNG_DEPTH_AT + 1)
    if header.startswith(_PNG) and header[_PNG_DEPTH_AT:] == b"\x10":
        raise Fault("bit_depth", "PNG of 16 bits a channel", path, "write 8 bits, or an .exr of floats")
    try:
        with Image.open(path, formats=("PNG",)) as picture:
            found, mode = Size(*picture.size), picture.mode
            palette = mode == "P"
            alpha = not palette and (mode in ("LA", "RGBA") or picture.has_transparency_data)
    except (OSError, SyntaxError, ValueError, UnidentifiedImageError) as error:
        raise Fault("unreadable", "not a readable PNG image", path) from error
    if palette:
        raise Fault("palette", "PNG with a palette", path, "write RGB of 8 bits")
    if alpha:
        raise Fault("alpha", "PNG with alpha: it is not said what stands behind", path, "write RGB")
    if mode not in ("L", "RGB"):
        raise Fault("bit_depth", f"PNG of mode {mode}", path, "write RGB of 8 bits")
    _check_size(found, size, path)


def require_folder(folder: Path, root: Path, kind: FaultKind, what: str, names: Sequence[str] = ()) -> None:
    """Raise a Fault unless a folder exists and is, with links resolved, inside ``root``."""
    if not folder.is_dir():
        there = f"; there are {', '.join(names[:8])}" if names else ""
        raise Fault(kind, f"{what}{there}", folder)
    if not folder.resolve().is_relative_to(root.resolve()):
        raise Fault("leads_outside", "a link leads out of the folder", folder, "copy the files into it")
