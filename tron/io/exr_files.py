"""OpenEXR in and out: linear BT.709 float32, whatever primaries, layers or luminance-chroma a file has.

What the attribute ``chromaticities`` says is followed; without one a file is in BT.709, as the format's
specification has it. Luminance and chroma (Y, RY, BY) become RGB by its technical introduction.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tron.errors import TronError
from tron.io.color_spaces import BT709, XYZ, luminance_weights, radiance_in_bt709, to_bt709
from tron.io.image_headers import AGAIN, EXR_MAGIC, another_kind, check_size, shaped

_HALF_MAX = 65504.0

ACES = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
_NAMES = {
    "ACES 2065-1": ACES,
    "ACEScg": (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767),
    "P3": (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.3127, 0.329),
    "BT.2020": (0.708, 0.292, 0.17, 0.797, 0.131, 0.046, 0.3127, 0.329),
    "Adobe RGB": (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, 0.3127, 0.329),
}
_NAMED = {
    "lin_ap0_scene": ACES,
    "lin_ap1_scene": _NAMES["ACEScg"],
    "lin_p3d65_scene": _NAMES["P3"],
    "lin_rec2020_scene": _NAMES["BT.2020"],
    "lin_adobergb_scene": _NAMES["Adobe RGB"],
    "lin_ciexyzd65_scene": XYZ,
    "aces2065-1": ACES,
    "acescg": _NAMES["ACEScg"],
}
"""Names of ``colorInteropID`` (Color Interop Forum) and OpenImageIO's ``oiio:ColorSpace``, in lower case."""
_LINEAR_BT709 = ("lin_rec709_scene", "lin_rec709", "lin_srgb", "linear", "scene_linear", "data")
_COLOURS: tuple[tuple[str, ...], ...] = (("R", "G", "B"), ("Y", "RY", "BY"))
_WORDS = {"red": "R", "green": "G", "blue": "B", "alpha": "A"}


@dataclass(frozen=True)
class _Layer:
    """Channels of one part that make an image: (letter, channel's name), in order, and their common name."""

    part: int
    name: str
    channels: tuple[tuple[str, str], ...]

    @property
    def letters(self) -> str:
        return "".join(letter for letter, _ in self.channels)


def encode_exr(image: np.ndarray, half: bool = True, color: bool = True) -> bytes:
    """Encode linear (H, W, 1, 3 or 4) as OpenEXR scanlines with PIZ compression.

    NaN and infinity are stored as they are; finite values beyond half's range saturate at 65504. The same
    input gives the same bytes. RGB is tagged with the chromaticities of BT.709 where it is ``color``.
    """
    import OpenEXR

    image = shaped(image, (1, 3, 4))
    if half:
        saturated = np.where(np.isfinite(image), np.clip(image, -_HALF_MAX, _HALF_MAX), image)
        image = saturated.astype(np.float16)
    else:
        image = image.astype(np.float32)
    name, pixels = {1: ("Y", image[..., 0]), 3: ("RGB", image), 4: ("RGBA", image)}[image.shape[2]]
    header: dict[str, Any] = {"compression": OpenEXR.PIZ_COMPRESSION, "type": OpenEXR.scanlineimage}
    if color and image.shape[2] > 1:
        header["chromaticities"] = BT709
    stream = io.BytesIO()
    OpenEXR.File(header, {name: np.ascontiguousarray(pixels)}).write(stream)
    return stream.getvalue()


def open_exr(data: bytes, color: bool = True) -> tuple[np.ndarray, list[str]]:
    """Decode OpenEXR to (H, W, C) float32, linear BT.709, and what is to be said of it.

    C is 3 or 4 for RGB and RGBA, 1 for a single channel. Of several layers the plain one is read, else the
    only one with colours, else Blender's ``Combined``.

    Args:
        data: the file.
        color: whether RGB is colour; otherwise primaries are not looked at.

    Raises:
        TronError: not an OpenEXR file, damaged, deep or cropped pixels, other channels, several layers of
            which none is named ``Combined``, no colour space, or too large.
    """
    import OpenEXR

    if not data.startswith(EXR_MAGIC):
        raise another_kind("an OpenEXR image", data)
    try:
        parts = OpenEXR.File(io.BytesIO(data), header_only=True).parts
        headers = [part.header for part in parts]
        layer, notes = _chosen(headers)
        _check_header(headers, layer.part, len(data))
        decoded = OpenEXR.File(io.BytesIO(data), separate_channels=True)
        if len(decoded.parts) != len(parts):  # the binding drops a part that it cannot decode
            raise TronError("OpenEXR image is damaged or cut short", mend=AGAIN)
        found = decoded.channels(layer.part)
        planes = [(letter, found[name].pixels) for letter, name in layer.channels]
    except TronError:
        raise
    except Exception as error:  # the binding raises RuntimeError, ValueError and others for damaged files
        raise TronError(f"not a readable OpenEXR image: {error}") from error
    if any(pixels.dtype not in (np.float16, np.float32) for _, pixels in planes):
        raise TronError(
            "OpenEXR image holds whole numbers", mend="store R, G, B or a single channel as floats"
        )
    space, said = _chromaticities(headers[layer.part]) if color and len(planes) >= 3 else (None, [])
    if "RY" in layer.letters:
        image = _from_chroma(dict(planes), BT709 if space is None else space)
    else:
        image = np.stack([np.asarray(pixels, np.float32) for _, pixels in planes], axis=-1)
    notes = [*notes, *said]
    if space is None or to_bt709(space) is None:
        return np.ascontiguousarray(image), notes
    return radiance_in_bt709(image, space), [*notes, f"colours are brought from {_named(space)} to BT.709"]


def decode_exr(data: bytes, color: bool = True) -> np.ndarray:
    """The image of :func:`open_exr` without a word."""
    return open_exr(data, color)[0]


def _chosen(headers: Sequence[dict[str, Any]]) -> tuple[_Layer, list[str]]:
    layers = [layer for index in range(len(headers)) for layer in _layers(index, headers)]
    if not layers:
        names = [channel.name for header in headers for channel in header["channels"]]
        if len(names) == 1:
            return _Layer(0, "", (("Y", names[0]),)), []
        raise TronError(
            f"OpenEXR image has channels {', '.join(names)}", mend="store R, G, B or a single channel"
        )
    plain = [layer for layer in layers if not layer.name]
    combined = [layer for layer in layers if "combined" in layer.name.lower().replace("_", ".").split(".")]
    wanted = plain or (layers if len(layers) == 1 else combined)
    if not wanted:
        named = ", ".join(layer.name for layer in layers)
        raise TronError(f"OpenEXR file has the layers {named}", mend="store one of them alone")
    others = [layer.name for layer in layers if layer != wanted[0] and layer.name]
    if not wanted[0].name and not others:
        return wanted[0], []
    left = f"; {', '.join(others)} left out" if others else ""
    return wanted[0], [f"layer '{wanted[0].name or 'RGB'}' is read{left}"]


def _layers(part: int, headers: Sequence[dict[str, Any]]) -> list[_Layer]:
    """Layers of a part whose channels are colours or a plain Y; one without a name bears its part's."""
    groups: dict[str, dict[str, str]] = {}
    for channel in (str(each.name) for each in headers[part]["channels"]):
        name, _, last = channel.rpartition(".")
        letter = _WORDS.get(last.lower(), last.upper())
        groups.setdefault(name, {})[letter] = channel
    of_part = str(headers[part].get("name", "")) if len(headers) > 1 else ""
    layers = []
    for name, channels in groups.items():
        wanted = next((each for each in _COLOURS if set(each) <= set(channels)), ())
        if not wanted and not name and "Y" in channels and "X" not in channels:
            wanted = ("Y",)
        if wanted:
            wanted = (*wanted, "A") if "A" in channels and len(wanted) == 3 else wanted
            layers.append(_Layer(part, name or of_part, tuple((c, channels[c]) for c in wanted)))
    return layers


def _check_header(headers: Sequence[dict[str, Any]], part: int, file_bytes: int) -> None:
    """TronError for a part that is not read, and for parts that cost too much: all of them are decoded."""
    for header in headers:
        (x0, y0), (x1, y1) = (np.asarray(corner, dtype=np.int64) for corner in header["dataWindow"])
        channels = sum(len(each["channels"]) for each in headers)
        check_size(int(x1 - x0 + 1), int(y1 - y0 + 1), channels, file_bytes)
    header = headers[part]
    if any("deep" in str(each.get("type", "")) for each in headers):
        raise TronError("OpenEXR file has deep pixels", mend="flatten it")
    if not np.array_equal(header["dataWindow"], header["displayWindow"]):
        raise TronError(
            "OpenEXR file is cropped: data and display window differ", mend="store the full frame"
        )


def _chromaticities(header: dict[str, Any]) -> tuple[tuple[float, ...] | None, list[str]]:
    """Primaries and white as a file states them; None where it says nothing, which means BT.709."""
    if "chromaticities" in header:
        return tuple(float(value) for value in header["chromaticities"]), []
    if header.get("acesImageContainerFlag"):
        return ACES, []
    name = header.get("colorInteropID") or header.get("oiio:ColorSpace")
    if name is None or str(name).lower() in _LINEAR_BT709:
        return None, []
    if str(name).lower() in _NAMED:
        return _NAMED[str(name).lower()], []
    return None, [f"colour space '{name}' is not known here: read as linear BT.709"]


def _named(space: tuple[float, ...]) -> str:
    for name, known in {"XYZ": XYZ, **_NAMES}.items():
        if np.allclose(space, known, rtol=0, atol=1e-3):
            return name
    return "primaries " + ", ".join(f"{value:.4g}" for value in space)


def _from_chroma(planes: dict[str, np.ndarray], space: tuple[float, ...]) -> np.ndarray:
    """(H, W, 3 or 4) RGB(A) of luminance Y and chroma RY = (R - Y) / Y, BY = (B - Y) / Y at half the size.

    Chroma between its samples, which stand on even pixels, is linear; OpenEXR's own filter has 27 taps.
    """
    y = np.asarray(planes["Y"], np.float64)
    ry, by = (_stretched(np.asarray(planes[name], np.float64), y.shape) for name in ("RY", "BY"))
    weights = luminance_weights(space)
    red, blue = (ry + 1) * y, (by + 1) * y
    green = (y - weights[0] * red - weights[2] * blue) / weights[1]
    alpha = [planes["A"]] if "A" in planes else []
    return np.stack([red, green, blue, *alpha], axis=-1).astype(np.float32)


def _stretched(plane: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """A plane with values between its samples, the first of which is the first of the larger one."""
    for axis in (0, 1):
        size = plane.shape[axis]
        at = np.arange(shape[axis]) * (size / shape[axis])
        low = at.astype(int)
        part = np.expand_dims(at - low, 1 - axis)
        high = np.minimum(low + 1, size - 1)
        plane = (1 - part) * plane.take(low, axis) + part * plane.take(high, axis)
    return plane
