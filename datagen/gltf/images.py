"""Images of glTF textures: PNG, JPEG, WebP and AVIF by Pillow, KTX2 by opengl_basisu where that is there."""

from __future__ import annotations

import io
import struct

import numpy as np
from PIL import Image

from tron.errors import TronError

LARGEST_TEXTURE = 8192 * 8192
_FORMATS = ("PNG", "JPEG", "WEBP", "AVIF")
_KTX2 = b"\xabKTX 20\xbb\r\n\x1a\n"


def decode_image(data: memoryview) -> np.ndarray:
    """(h, w, 3) or, with alpha, (h, w, 4) uint8, top row first, as stored.

    Raises:
        TronError: another format, damaged data, or more than LARGEST_TEXTURE pixels.
    """
    if bytes(data[:12]) == _KTX2:
        return _decode_ktx2(bytes(data))
    try:
        # Only these: Pillow's PostScript reader starts a program.
        with Image.open(io.BytesIO(data), formats=_FORMATS) as image:
            require_size(image.width, image.height)
            return pixels(image)
    except Image.DecompressionBombError as error:
        raise TronError("texture is too large", mend="shrink it") from error
    except (OSError, SyntaxError, ValueError, struct.error) as error:
        raise TronError(f"texture cannot be read: {error}", mend=f"store it as {_FORMATS[0]}") from error


def pixels(image: Image.Image) -> np.ndarray:
    """(h, w, 3) or (h, w, 4) uint8 of an opened image; 16 bits lose the lower half."""
    if image.mode.startswith("I"):
        grey = (np.asarray(image).astype(np.int64) >> 8).clip(0, 255).astype(np.uint8)
        return np.repeat(grey[..., None], 3, axis=2)
    return np.asarray(image.convert("RGBA" if image.has_transparency_data else "RGB"))


def require_size(width: int, height: int) -> None:
    """Raise TronError for a texture of more than LARGEST_TEXTURE pixels."""
    if not 0 < width * height <= LARGEST_TEXTURE:
        raise TronError(f"texture of {width} x {height} pixels is too large", mend="shrink it")


def reads_ktx2() -> bool:
    """Whether the decoder of KTX2 is installed."""
    try:
        import opengl_basisu  # noqa: F401
    except ImportError:
        return False
    return True


def _decode_ktx2(data: bytes) -> np.ndarray:
    if not reads_ktx2():
        raise TronError(
            "textures are KTX2, which needs opengl_basisu", mend="pip install 'tron-relight[ktx2]'"
        )
    import opengl_basisu

    if len(data) < 80:
        raise TronError("KTX2 texture is too short")
    require_size(*struct.unpack_from("<2I", data, 20))
    try:
        texture = opengl_basisu.open(data)
        decoded = texture.transcode("rgba8").data
    except (ValueError, IndexError) as error:
        raise TronError(f"KTX2 texture cannot be read: {error}") from error
    return decoded if texture.has_alpha else decoded[..., :3]
