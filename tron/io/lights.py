"""Pictures of light in every form that they are found in, as lat-long radiance.

Known by content: a lat-long picture, a cube map's cross or strip, a DDS or KTX2 with six faces, a folder of
six face files. Crosses are those of DirectX' and Unity's tools: seen from inside the cube, +y above and -y
below, -x, +z, +x, -z side by side; in an upright cross -z stands on its head below -y (as Debevec's do). A
cube's +z is the middle of the lat-long picture, its +x lies to the right of that, as in cmft. A square
picture is a mirror ball or an angular map, which nothing in it tells: tron-environment is told.

JPEG XL, gain maps and compressed cube maps need the extra ``lights``.
"""

from __future__ import annotations

import io
import logging
from collections.abc import Callable
from mimetypes import guess_type
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from tron.color import srgb_to_linear
from tron.errors import TronError, located, say_once
from tron.io.color_spaces import chromaticities_of, in_bt709
from tron.io.cube_files import DDS, KTX2, open_cube
from tron.io.image_headers import AGAIN, JXL, MAX_DECODED_BYTES, check_size, jpeg_xl_size
from tron.io.images import read_image
from tron.io.lat_long import directions, resampled
from tron.io.optional import codecs

_RADIANCE, _DISPLAY = (".hdr", ".exr"), (".png", ".jpg", ".jpeg")
_WIDTH_OFF = 2
"""Columns that a width may be off twice the height: stitchers and croppers leave out one."""
_NEGATIVE_SHARE = 0.05
"""Largest share of all radiance that negative values may be: resampling and wide gamuts leave some behind."""
_GAIN_MAP = (b"http://ns.adobe.com/hdr-gain-map/1.0/", b"urn:iso:std:iso:ts:21496:-1")
_HEAD = 2**18
_DISPLAY_P3 = 12
_CLIPPED = (
    "display values as a light: their range is clipped at 1, so suns and lamps are far too dark; "
    "give an .hdr or .exr where there is one"
)
_FACE_NAMES = (
    ("px", "nx", "py", "ny", "pz", "nz"),
    ("posx", "negx", "posy", "negy", "posz", "negz"),
    ("right", "left", "top", "bottom", "front", "back"),
    ("right", "left", "up", "down", "front", "back"),
    ("+x", "-x", "+y", "-y", "+z", "-z"),
)
_CROSSES: dict[tuple[int, int], tuple[tuple[int, int], ...]] = {
    (4, 3): ((2, 1), (0, 1), (1, 0), (1, 2), (1, 1), (3, 1)),
    (3, 4): ((2, 1), (0, 1), (1, 0), (1, 2), (1, 1), (1, 3)),
    (6, 1): tuple((face, 0) for face in range(6)),
    (1, 6): tuple((0, face) for face in range(6)),
}
"""Columns and rows of a picture of faces -> (column, row) of +x, -x, +y, -y, +z, -z."""
_FINE_FACE, _WIDEST_FACE = 512, 1024
"""Texels of a face up to which twice as many are looked up in each direction, and up to which faces are not
averaged first."""


def read_light(path: Path) -> np.ndarray:
    """(H, W, 3) float32, linear BT.709, lat-long, of a picture of radiance or of display values.

    Mended, each with a line: infinite texels become the largest finite value, negative ones zero; a width
    that is off by a column or two is resampled; display values are decoded, of which the line says that they
    are clipped; cube maps are resampled.

    Args:
        path: the picture, or a folder of six faces.

    Raises:
        TronError: missing or unreadable file, another suffix, NaN, nothing finite, radiance of which more
            than a twentieth is negative, or a library that is not installed.
    """
    image, notes = read_picture(path)
    with located(path):
        image, mended = _usable(image)
    height, width = image.shape[-3:-1]
    if image.ndim == 3 and width != 2 * height:
        if (faces := _unfolded(image)) is not None:
            image = faces
        elif abs(width - 2 * height) <= _WIDTH_OFF and height >= 4:
            image = resampled(image, (width + 1) // 2, (width + 1) // 2 * 2)
            mended.append(f"{width} x {height} pixels are resampled to {image.shape[1]} x {image.shape[0]}")
        elif width == height:
            what = f"environment map is {width} x {height} pixels, not 2:1"
            mend = (
                f"a ball or a probe? tron-environment environment={path} layout=mirror_ball output=light.exr"
            )
            raise TronError(what, path, mend)
    if image.ndim == 4:
        side = image.shape[1]
        image = lat_long_of_cube(image)
        mended.append(
            f"cube map of {side} x {side} pixels a face is resampled to {image.shape[1]} x {image.shape[0]}"
        )
    for note in notes + mended:
        say_once(__name__, f"{path}: {note}", logging.WARNING)
    return image


def read_picture(path: Path) -> tuple[np.ndarray, list[str]]:
    """Linear (H, W, 3) float32 as the file has it, or (6, R, R, 3) of a cube map, and what to say of it."""
    if path.is_dir():
        return _six_faces(path)
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            head = file.read(_HEAD)
            if size > MAX_DECODED_BYTES:
                raise TronError(f"image file of {size / 1e9:.1f} GB is too large", path)
            known = next((each for each in ENCODINGS if each.tells(head)), None)
            data = head + file.read() if known else b""
    except OSError as error:
        raise TronError(f"cannot read image: {error.strerror or error}", path) from error
    if known is not None:
        with located(path):
            return known.open(data)
    if path.suffix.lower() not in _RADIANCE + _DISPLAY:
        is_video = (guess_type(path.name)[0] or "").startswith("video/")
        kind = "a video" if is_video else path.suffix or "a file without suffix"
        raise TronError(f"{kind} cannot hold an environment map", path, "give a lat-long .hdr or .exr")
    image = read_image(path, channels=3)
    if path.suffix.lower() in _DISPLAY:
        return np.asarray(srgb_to_linear(image), np.float32), [_CLIPPED]
    return image, []


def lat_long_of_cube(faces: np.ndarray) -> np.ndarray:
    """(2 R, 4 R, 3) float32 lat-long image of six faces (6, R, R, 3), bilinear across their edges too."""
    while faces.shape[1] > _WIDEST_FACE and faces.shape[1] % 2 == 0:
        faces = (faces[:, ::2, ::2] + faces[:, 1::2, ::2] + faces[:, ::2, 1::2] + faces[:, 1::2, 1::2]) / 4
    side = faces.shape[1]
    height = 2 * min(side, 2 * _WIDEST_FACE)
    fine = height * 2 if side <= _FINE_FACE else height
    padded = _padded(np.asarray(faces, np.float32))
    rows = []
    for start in range(0, fine, 64):
        d = directions(fine, 2 * fine, slice(start, start + 64))
        face, x, y = _face_of(np.stack([-d[..., 0], d[..., 2], -d[..., 1]], axis=-1))
        rows.append(_bilinear(padded, face, (x + 1) / 2 * side + 0.5, (y + 1) / 2 * side + 0.5))
    image = np.concatenate(rows)
    return image if fine == height else resampled(image, height, 2 * height)


def lat_long_of_ball(
    image: np.ndarray,
    layout: str,
    crop: tuple[float, float, float] | None = None,
    distance: float = 100.0,
    height: int = 512,
) -> np.ndarray:
    """Lat-long image (H, 2 H, 3) of a photo of a mirror ball, or of an angular map.

    The middle of the result is where the camera looks, behind the ball. An angular map (Debevec's light
    probes) has the angle from there in proportion to the distance from its centre.

    Args:
        image: (h, w, 3) linear. layout: ``mirror_ball`` or ``angular``.
        crop: column and row of the ball's centre and its radius, in pixels; the largest circle in the middle
            where it is not given.
        distance: of the camera from the ball's centre, in radii of the ball.
    """
    rows, columns = image.shape[:2]
    cx, cy, radius = crop or (columns / 2, rows / 2, min(rows, columns) / 2)
    if not (radius >= 2 and radius <= cx <= columns - radius and radius <= cy <= rows - radius):
        raise TronError(
            f"circle of radius {radius:g} at ({cx:g}, {cy:g}) is not inside {columns} x {rows} pixels",
            "crop",
            "give column and row of the ball's centre and its radius",
        )
    d = directions(height, 2 * height)
    d = np.stack([-d[..., 0], d[..., 2], d[..., 1]], axis=-1)  # x right, y up, z towards the camera
    across = np.hypot(d[..., 0], d[..., 1])
    angle = np.arctan2(across, d[..., 2])
    out = 1 - angle / np.pi if layout == "angular" else np.interp(angle, *_ball_table(distance))
    at = d[..., :2] / np.maximum(across, 1e-12)[..., None] * out[..., None]
    x = np.clip(cx + at[..., 0] * radius - 0.5, 0, columns - 1)
    y = np.clip(cy - at[..., 1] * radius - 0.5, 0, rows - 1)
    return _bilinear(image[None], np.zeros(x.shape, int), x, y)


def _ball_table(distance: float) -> tuple[np.ndarray, np.ndarray]:
    """Angles of directions from the way to the camera, and where a ball shows them, in radii from its centre.

    The normal at angle p from that way halves the angle between what is mirrored and the way to the camera
    from there, which is turned by q = atan2(sin p, distance - cos p): so what is mirrored lies at 2 p + q.
    """
    p = np.linspace(0, np.arccos(1 / distance), 4096)
    q = np.arctan2(np.sin(p), distance - np.cos(p))
    return 2 * p + q, np.tan(q) * np.sqrt(distance**2 - 1)


def _six_faces(folder: Path) -> tuple[np.ndarray, list[str]]:
    files = {p.stem.lower(): p for p in sorted(folder.iterdir()) if p.suffix.lower() in LIGHT_SUFFIXES}
    for names in _FACE_NAMES:
        ends = [(name, f"_{name}", f"-{name}") for name in names]
        found = [[p for stem, p in files.items() if stem == end[0] or stem.endswith(end[1:])] for end in ends]
        if any(len(each) != 1 for each in found):
            continue
        pictures = [read_picture(each) for (each,) in found]
        faces = [image for image, _ in pictures]
        shape = faces[0].shape
        if len(shape) != 3 or shape[0] != shape[1] or shape[0] < 2 or any(f.shape != shape for f in faces):
            raise TronError("faces of a cube map are not six squares of one size", folder)
        return np.stack(faces), sorted({note for _, notes in pictures for note in notes})
    mend = f"name them {', '.join(_FACE_NAMES[0])}, or give a file"
    raise TronError("folder has no six faces of a cube map", folder, mend)


def _unfolded(image: np.ndarray) -> np.ndarray | None:
    """Six faces (6, R, R, 3) of a cross or a strip; None of pictures of other proportions."""
    height, width = image.shape[:2]
    for (columns, rows), places in _CROSSES.items():
        side = width // columns
        if side >= 2 and (width, height) == (columns * side, rows * side):
            faces = [image[y * side : (y + 1) * side, x * side : (x + 1) * side] for x, y in places]
            if (columns, rows) == (3, 4):
                faces[5] = faces[5][::-1, ::-1]
            return np.stack(faces)
    return None


def _face_of(d: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Face, and column and row in [-1, 1], of directions in a cube's frame (OpenGL 4.6, table 8.19)."""
    x, y, z = np.moveaxis(d, -1, 0)
    a = np.abs(d)
    axis = np.argmax(a, axis=-1)
    major = np.take_along_axis(d, axis[..., None], -1)[..., 0]
    positive = major > 0
    sign = np.where(positive, 1, -1)
    s = np.choose(axis, [-z * sign, x, x * sign])
    t = np.choose(axis, [-y, z * sign, -y])
    return axis * 2 + ~positive, s / np.abs(major), t / np.abs(major)


def _face_points(side: int) -> np.ndarray:
    """(6, side + 2, side + 2, 3) directions of texels and of a border of one around each face."""
    at = (np.arange(-1, side + 1) + 0.5) / side * 2 - 1
    s, t = np.meshgrid(at, at)
    one = np.ones_like(s)
    faces = (one, -t, -s), (-one, -t, s), (s, one, t), (s, -one, -t), (s, -t, one), (-s, -t, -one)
    return np.stack([np.stack(each, axis=-1) for each in faces])


def _padded(faces: np.ndarray) -> np.ndarray:
    """(6, R + 2, R + 2, 3): faces with a border that is looked up on their neighbours."""
    side = faces.shape[1]
    padded = np.pad(faces, ((0, 0), (1, 1), (1, 1), (0, 0)), mode="edge")
    border = np.ones((6, side + 2, side + 2), bool)
    border[:, 1:-1, 1:-1] = False
    face, x, y = _face_of(_face_points(side)[border])
    low, high = 0.0, side - 1.0
    u, v = (np.clip((each + 1) / 2 * side - 0.5, low, high) for each in (x, y))
    padded[border] = _bilinear(faces, face, u, v)
    return padded


def _bilinear(images: np.ndarray, which: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(..., 3) float32 of images (n, h, w, 3) at columns and rows that lie inside of them."""
    left = np.clip(np.floor(x).astype(int), 0, images.shape[2] - 2)
    top = np.clip(np.floor(y).astype(int), 0, images.shape[1] - 2)
    fx, fy = (x - left)[..., None].astype(np.float32), (y - top)[..., None].astype(np.float32)
    upper = (1 - fx) * images[which, top, left] + fx * images[which, top, left + 1]
    lower = (1 - fx) * images[which, top + 1, left] + fx * images[which, top + 1, left + 1]
    return (1 - fy) * upper + fy * lower


def _open_cube_file(data: bytes) -> tuple[np.ndarray, list[str]]:
    faces, display = open_cube(data)
    return faces, [_CLIPPED] if display else []


def _has_gain_map(head: bytes) -> bool:
    return head.startswith(b"\xff\xd8\xff") and any(each in head for each in _GAIN_MAP)


def _open_jpeg_xl(data: bytes) -> tuple[np.ndarray, list[str]]:
    """JPEG XL of floats as linear radiance, of whole numbers as display values."""
    library = codecs("JPEG XL")
    check_size(*jpeg_xl_size(data), 3, len(data))
    image = _decoded(library.jpegxl_decode, data, "JPEG XL")
    if image.ndim != 3 or image.shape[2] not in (3, 4):
        raise TronError(f"JPEG XL picture has shape {image.shape}", mend="give RGB")
    image = image[..., :3]
    if image.dtype.kind == "f":
        return image.astype(np.float32), []
    levels = np.asarray(image, np.float32) / np.iinfo(image.dtype).max
    return np.asarray(srgb_to_linear(levels), np.float32), [_CLIPPED]


def _open_gain_map(data: bytes) -> tuple[np.ndarray, list[str]]:
    """A JPEG with a gain map (Ultra HDR, ISO 21496-1) at its full range, 1 being the white of a page."""
    library = codecs("JPEG with a gain map")
    try:
        with Image.open(io.BytesIO(data), formats=("JPEG", "MPO")) as picture:
            size, profile = picture.size, picture.info.get("icc_profile", b"")
    except Exception as error:  # damaged files raise almost anything
        raise TronError(f"not a readable JPEG: {error}", mend=AGAIN) from error
    check_size(*size, 4, len(data))
    image = _decoded(library.ultrahdr_decode, data, "JPEG with a gain map")
    image = image[..., :3].astype(np.float32)
    wide = b"D\0i\0s\0p\0l\0a\0y\0 \0P\x003" in profile or b"Display P3" in profile
    notes = [f"gain map is applied: radiance up to {image.max():.3g} times white"]
    if wide:
        image = np.asarray(in_bt709(image, chromaticities_of(_DISPLAY_P3)), np.float32)
    return image, notes


def _decoded(decode: Callable[[bytes], np.ndarray], data: bytes, kind: str) -> np.ndarray:
    try:
        return np.asarray(decode(data))
    except Exception as error:  # libraries' own errors, of which imagecodecs has one class a codec
        raise TronError(f"not a readable {kind}: {error}") from error


def _usable(image: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Finite radiance that is not negative, and what was done to it."""
    texels = image[..., 0].size
    if unknown := int(np.isnan(image).any(-1).sum()):
        raise TronError(f"{unknown} of {texels} texels are NaN", mend="repair the file: render it again")
    notes = []
    if infinite := int(np.isposinf(image).any(-1).sum()):
        finite = image[np.isfinite(image)]
        if not (finite > 0).any():
            raise TronError("environment map holds no finite radiance", mend="store it in 32 bits")
        image = np.where(np.isposinf(image), finite.max(), image)
        notes.append(
            f"{infinite} of {texels} texels are infinite and are given the largest finite value, "
            f"{finite.max():.6g}: what they had more is lost"
        )
    if negative := int((image < 0).any(-1).sum()):
        least, share = float(image.min()), float(-np.minimum(image, 0).sum(dtype=np.float64))
        share /= max(float(np.abs(image).sum(dtype=np.float64)), 1e-300)
        if not share <= _NEGATIVE_SHARE:
            raise TronError(
                f"environment map holds negative radiance (down to {least:.3g})",
                mend="clamp it to zero or above, or store its colours in BT.709",
            )
        image = np.maximum(image, 0)
        notes.append(f"{negative} of {texels} texels are negative (down to {least:.3g}) and are set to zero")
    return image, notes


class Encoding(NamedTuple):
    """An encoding that the first bytes of a file tell.

    Attributes:
        holds: what such a file is, for help.
        suffixes: by which folders are searched for lights.
        tells: whether a file that begins so is one.
        open: linear (H, W, 3) float32, or (6, R, R, 3) of a cube map, and what to say of it.
    """

    holds: str
    suffixes: tuple[str, ...]
    tells: Callable[[bytes], bool]
    open: Callable[[bytes], tuple[np.ndarray, list[str]]]


ENCODINGS = (
    Encoding(
        ".dds or .ktx2 with six faces",
        (".dds", ".ktx2"),
        lambda head: head.startswith((DDS, KTX2)),
        _open_cube_file,
    ),
    Encoding(".jxl", (".jxl",), lambda head: head.startswith(JXL), _open_jpeg_xl),
    Encoding("a JPEG with a gain map", (), _has_gain_map, _open_gain_map),
)
LIGHT_SUFFIXES = (*_RADIANCE, *(suffix for each in ENCODINGS for suffix in each.suffixes), *_DISPLAY)
