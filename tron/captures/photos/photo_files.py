"""Files of photos: what their headers say, whether they are whole, and their pixels.

JPEG, PNG, WebP, AVIF, TIFF and BMP hold display values; so does HEIC, which needs the extra ``heic``
(pillow-heif). They are brought to sRGB from what a file says it is in. OpenEXR holds linear radiance, which
:func:`shown` encodes for display. Input is not trusted: sizes are checked before anything is decoded, and a
file that is damaged is refused, for most decoders would fill its rest with grey and say nothing.
"""

from __future__ import annotations

import io
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, TiffImagePlugin, UnidentifiedImageError

from tron.color import linear_to_srgb
from tron.errors import TronError
from tron.io.embedded_colors import DisplayColors, colors_of_code_points, colors_of_file, colors_of_profile
from tron.io.exr_files import open_exr
from tron.io.image_headers import check_size
from tron.io.recognised import refuse_placeholder

HEIC_SUFFIXES = (".heic", ".heif", ".hif")
LINEAR_SUFFIXES = (".exr",)
SUFFIXES = (
    *(".jpg", ".jpeg", ".png", ".webp", ".avif", ".tif", ".tiff", ".bmp"),
    *HEIC_SUFFIXES,
    *LINEAR_SUFFIXES,
)

_FORMATS = ("JPEG", "PNG", "WEBP", "AVIF", "TIFF", "BMP")
_SAMPLE_FORMAT, _INTEGERS = 339, {1, 4}
"""TIFF's tag that tells what samples are: unsigned, or undefined, which is read so."""
_ORIENTATION_TAG = 0x0112
_CHECK_SIDE = 64
_BIT_DEPTH_AT = 24
"""Byte of a PNG that holds its bit depth: behind signature, length and name of IHDR, width and height."""
_SAMPLED_FILES, _SAMPLED_SIDE = 8, 256
_BRIGHT_SHARE, _BRIGHT = 0.98, 0.9


@dataclass(frozen=True)
class PhotoHeader:
    """Header of a photo's file.

    Attributes:
        width: pixels as stored, before any turning.
        height: pixels as stored.
        alpha: whether it has transparency.
        orientation: EXIF's 1 to 8; 1 is upright as stored.
        linear: whether it holds linear radiance, not display values.
        color: whether RGB is colour, which is brought to sRGB; a mask's and a normal map's is not.
        notes: what is to be said of its colours.
    """

    width: int
    height: int
    alpha: bool = False
    orientation: int = 1
    linear: bool = False
    color: bool = True
    notes: tuple[str, ...] = ()

    def size(self, upright: bool) -> tuple[int, int]:
        """Width and height, of the photo turned as its EXIF tag says if ``upright``."""
        turned = upright and self.orientation >= 5
        return (self.height, self.width) if turned else (self.width, self.height)


def require_decoders(paths: Iterable[Path | None]) -> None:
    """Raise TronError if one of these files is HEIC and pillow-heif, which reads it, is not installed."""
    if find_spec("pillow_heif") is not None:
        return
    for path in paths:
        if path is not None and path.suffix.lower() in HEIC_SUFFIXES:
            raise TronError(
                "photo in HEIC, which is read with pillow-heif",
                path,
                "pip install 'tron-relight[heic]', or save the photos as JPEG",
            )


def inspect_photo(path: Path, color: bool = True) -> PhotoHeader:
    """Read a photo's header and make sure that its file is whole.

    Of a PNG the checksums are looked at; any other file is decoded once, a JPEG at an eighth of its size and
    strictly: bytes that are no code of its, or too many or too few of them, are damage. (Random bytes in the
    middle of a JPEG may happen to be codes: of files with 64 overwritten bytes a third went unnoticed, of
    those with one flipped bit four fifths, of those with 4,096 missing or zeroed bytes none.)

    Args:
        path: the file.
        color: whether it is a photo, and no mask or map of something else.

    Raises:
        TronError: the file is missing, not such an image, cut short, damaged, too large, or in a colour space
            that is not converted.
    """
    try:
        data = path.read_bytes()
        suffix = path.suffix.lower()
        if suffix in LINEAR_SUFFIXES:
            pixels, notes = open_exr(data, color)
            height, width, channels = pixels.shape
            return PhotoHeader(width, height, channels == 4, linear=True, color=color, notes=tuple(notes))
        if suffix in HEIC_SUFFIXES:
            return _inspect_heic(data, color)
        _require_integers(data)
        with Image.open(io.BytesIO(data), formats=_FORMATS) as picture:
            check_size(*picture.size, len(picture.getbands()), len(data))
            header = PhotoHeader(
                *picture.size,
                alpha="A" in picture.getbands() or "transparency" in picture.info,
                orientation=int(picture.getexif().get(_ORIENTATION_TAG, 1) or 1),
                color=color,
                notes=tuple(colors_of_file(picture, data).notes()) if color else (),
            )
            kind = picture.format or ""
        _require_whole(data, kind)
    except TronError as error:
        refuse_placeholder(path)
        raise TronError(error.what, path, error.mend) from error
    except UnidentifiedImageError as error:
        refuse_placeholder(path)
        raise TronError("damaged, or not an image", path) from error
    except OSError as error:
        raise TronError(f"cannot read image: {error.strerror or error}", path) from error
    except Exception as error:  # damaged files raise almost anything: SyntaxError, struct.error, ...
        raise TronError(f"not a readable image: {error}", path) from error
    return header


def decode_photo(path: Path, header: PhotoHeader, exposure: float = 1.0) -> np.ndarray:
    """Decode to (H, W, 1, 3 or 4) uint8 or uint16 in sRGB, RGB or RGBA with straight colours.

    Args:
        path: the file.
        header: what :func:`inspect_photo` said of it; it is held to that.
        exposure: of a linear photo (see :func:`shown`).

    Raises:
        TronError: the file cannot be read or decoded, or has changed since.
    """
    try:
        data = path.read_bytes()
        if header.linear:
            pixels = _linear(open_exr(data, header.color)[0], exposure)
        elif path.suffix.lower() in HEIC_SUFFIXES:
            pixels = _by_heif(data, header.color)
        else:
            pixels = _by_pillow(data) if _is_avif(data) else _by_opencv(path, data, header)
            if header.color:
                pixels = _in_srgb(data, pixels)
    except OSError as error:
        raise TronError(f"cannot read image: {error.strerror or error}", path) from error
    except TronError as error:
        raise TronError(error.what, path, error.mend) from error
    if pixels.shape[:2] != (header.height, header.width):
        raise TronError("image has changed since the capture was loaded", path, "load the capture again")
    return pixels


def open_photo(path: Path, header: PhotoHeader, exposure: float = 1.0) -> Image.Image:
    """The photo for Pillow in sRGB, not turned, with what EXIF says of it."""
    if header.linear:
        return Image.fromarray(_eight_bits(decode_photo(path, header, exposure)[..., :3]))
    if header.notes:
        pixels = _eight_bits(decode_photo(path, header))
        picture = Image.fromarray(pixels[..., 0] if pixels.shape[2] == 1 else pixels)
        with _opened(path) as stored:
            picture.info["exif"] = stored.getexif().tobytes()
        return picture
    return _opened(path)


def _eight_bits(pixels: np.ndarray) -> np.ndarray:
    return pixels if pixels.dtype == np.uint8 else (pixels >> 8).astype(np.uint8)


def _opened(path: Path) -> Image.Image:
    if path.suffix.lower() in HEIC_SUFFIXES:
        return _heic(path.read_bytes()).to_pillow()
    return Image.open(path, formats=_FORMATS)


def shown(linear: np.ndarray, exposure: float) -> np.ndarray:
    """Display values of linear radiance: ``exposure x radiance`` through the sRGB curve, clipped to [0, 1].

    The curve is the one that photos are decoded with (tron.captures.view), so that what is learnt
    from them meets the radiance again.
    """
    return np.clip(linear_to_srgb(np.maximum(linear, 0) * np.float32(exposure)), 0, 1)


def exposure_of(paths: Iterable[Path], asked: float | None) -> float:
    """Exposure that the linear ones of these photos are shown with, one for all; 1 where there are none.

    Args:
        paths: of whole photos.
        asked: what the user wants; None: 98 % of what some of them show lie below 0.9 of what a display can.
    """
    linear = [path for path in paths if path.suffix.lower() in LINEAR_SUFFIXES]
    if asked is not None or not linear:
        return 1.0 if asked is None else asked
    values = []
    for index in np.unique(np.linspace(0, len(linear) - 1, _SAMPLED_FILES).astype(int)):
        try:
            pixels = open_exr(linear[index].read_bytes())[0]
        except (OSError, TronError):
            continue  # whoever uses the photo says what is wrong with it
        rows, columns = (max(1, side // _SAMPLED_SIDE) for side in pixels.shape[:2])
        color = pixels[::rows, ::columns, :3].max(-1)
        values.append(color[np.isfinite(color)])
    bright = float(np.quantile(np.concatenate(values or [np.ones(1)]), _BRIGHT_SHARE))
    if not bright > 0:
        raise TronError("EXR photos hold no light", linear[0])
    return _BRIGHT / bright


def _linear(pixels: np.ndarray, exposure: float) -> np.ndarray:
    """uint16 display values; OpenEXR's alpha is premultiplied, as its specification says."""
    if not np.isfinite(pixels).all():
        raise TronError("image holds NaN or infinity")
    alpha = pixels[..., 3:].clip(0, 1)
    color = pixels[..., :3]
    if alpha.shape[2]:
        color = np.divide(color, alpha, out=np.zeros_like(color), where=alpha > 0)
    values = np.concatenate([shown(color, exposure), alpha], axis=2)
    return np.round(values * 65535).astype(np.uint16)


def _in_srgb(data: bytes, pixels: np.ndarray) -> np.ndarray:
    """sRGB of what OpenCV decoded; inks, which it mixes without their profile, are decoded by Pillow."""
    with Image.open(io.BytesIO(data), formats=_FORMATS) as picture:
        colors = colors_of_file(picture, data)
        return colors.srgb(np.asarray(picture) if colors.inks else pixels)


def _inspect_heic(data: bytes, color: bool) -> PhotoHeader:
    picture = _heic(data)
    width, height = picture.size
    check_size(width, height, 4, len(data))
    _ = picture.data  # decodes it
    notes = tuple(_heic_colors(picture).notes()) if color else ()
    return PhotoHeader(width, height, alpha=picture.has_alpha, color=color, notes=notes)


def _by_heif(data: bytes, color: bool) -> np.ndarray:
    """(H, W, 3 or 4) of a HEIC: 8 bits, or 16 where it is in HLG or PQ, which 8 would show in bands."""
    picture = _heic(data)
    colors = _heic_colors(picture) if color else DisplayColors()
    if colors.wide:
        picture = _heic(data, eight_bits=False)
    return colors.srgb(np.asarray(picture))


def _heic_colors(picture: Any) -> DisplayColors:
    """Colours by the ICC profile of a HEIC, else by its nclx."""
    if profile := picture.info.get("icc_profile"):
        return colors_of_profile(profile, picture.mode.partition(";")[0])
    nclx = picture.info.get("nclx_profile")
    if not nclx:
        return DisplayColors()
    return colors_of_code_points(nclx["color_primaries"], nclx["transfer_characteristics"], "nclx")


def _heic(data: bytes, eight_bits: bool = True) -> Any:
    """The file's primary picture, turned as the file says: HEIC holds no picture that is not."""
    import pillow_heif

    try:
        return pillow_heif.open_heif(io.BytesIO(data), convert_hdr_to_8bit=eight_bits)
    except Exception as error:  # libheif's errors come as ValueError, RuntimeError, EOFError, SyntaxError
        raise TronError(f"not a readable HEIC image: {error}") from error


def _require_integers(data: bytes) -> None:
    """Raise TronError if this is a TIFF of floating-point or signed numbers, which Pillow calls no image."""
    if not data.startswith((b"II*\0", b"MM\0*")):
        return
    try:
        tags = TiffImagePlugin.ImageFileDirectory_v2(data[:8])
        stream = io.BytesIO(data)
        stream.seek(tags.next)
        tags.load(stream)
        kinds = set(tags.get(_SAMPLE_FORMAT, (1,)))
    except Exception:  # damaged: whoever decodes it says so
        return
    if kinds - _INTEGERS:
        kind = "floating-point" if 3 in kinds else "signed or complex"
        mend = "save it with 8 or 16 bits, or as OpenEXR where it is linear"
        raise TronError(f"a TIFF of {kind} numbers is not read", mend=mend)


def _is_avif(data: bytes) -> bool:
    return data[4:8] == b"ftyp" and data[8:12] in (b"avif", b"avis")


def _by_pillow(data: bytes) -> np.ndarray:
    """(H, W, 3 or 4) uint8 of an AVIF, in its own colours."""
    with Image.open(io.BytesIO(data), formats=("AVIF",)) as picture:
        return np.asarray(picture)


def _require_whole(data: bytes, kind: str) -> None:
    if kind in ("JPEG", "MPO"):
        import simplejpeg

        try:
            simplejpeg.decode_jpeg(data, "GRAY", min_height=_CHECK_SIDE, min_width=_CHECK_SIDE, min_factor=1)
        except ValueError as error:
            raise TronError(f"image is damaged or cut short: {error}") from error
        return
    with Image.open(io.BytesIO(data), formats=_FORMATS) as picture:
        try:
            picture.verify() if kind == "PNG" else picture.load()
        except (OSError, SyntaxError) as error:
            raise TronError(f"image is damaged or cut short: {error}") from error
    if kind == "PNG" and b"IEND\xaeB`\x82" not in data[-4096:]:
        raise TronError("image is cut short")


def _by_opencv(path: Path, data: bytes, header: PhotoHeader) -> np.ndarray:
    import cv2

    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # damage is ours to report
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise TronError(f"not a readable image: {error.err}") from error
    if pixels is None or pixels.dtype not in (np.uint8, np.uint16):
        raise TronError("image is damaged or has neither 8 nor 16 bits")
    if pixels.ndim == 2:
        return _with_hidden_grey(path, pixels) if header.alpha else pixels[..., None]
    if pixels.shape[2] == 2:
        return np.concatenate([np.repeat(pixels[..., :1], 3, axis=2), pixels[..., 1:]], axis=2)
    swapped = cv2.COLOR_BGRA2RGBA if pixels.shape[2] == 4 else cv2.COLOR_BGR2RGB
    return cv2.cvtColor(pixels, swapped)


def _with_hidden_grey(path: Path, pixels: np.ndarray) -> np.ndarray:
    """Grey (H, W) and the transparency that a PNG gives one of its values (chunk tRNS) -> RGBA, as stored.

    OpenCV passes over that chunk of grey files.
    """
    with Image.open(path, formats=("PNG",)) as picture:
        hidden = picture.info.get("transparency")
    alpha = np.full_like(pixels, np.iinfo(pixels.dtype).max)
    if isinstance(hidden, int):
        alpha[pixels == hidden * _steps_of_grey(path)] = 0
    return np.stack([pixels, pixels, pixels, alpha], axis=2)


def _steps_of_grey(path: Path) -> int:
    """Steps of 8 bits in one step of a grey PNG of 1, 2 or 4 bits, which is decoded to 8; else 1."""
    with open(path, "rb") as file:
        bits = file.read(_BIT_DEPTH_AT + 1)[_BIT_DEPTH_AT]
    return 255 // (2**bits - 1) if bits < 8 else 1
