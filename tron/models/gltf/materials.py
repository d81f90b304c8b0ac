"""glTF materials as linear images: base color, alpha, roughness, metallic, normals, emission (glTF 2.0, 3.9).

Occlusion is left out, for light is traced. Colour profiles are passed over, as glTF 2.0 (3.9.2) demands: what
a texture holds is said by its use.
"""

from __future__ import annotations

import io
import struct
import zlib
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Any

import numpy as np
import pyarrow
from PIL import Image

from tron.color import srgb_to_linear
from tron.errors import TronError
from tron.io.gltf_document import Document
from tron.io.optional import basisu
from tron.models.parts import Wrap

LARGEST_TEXTURE = 8192 * 8192
_FORMATS = ("PNG", "JPEG", "WEBP", "AVIF")
_KTX2 = b"\xabKTX 20\xbb\r\n\x1a\n"
_PLAIN = {23: "rgb", 29: "rgb", 30: "bgr", 36: "bgr", 37: "rgba", 43: "rgba", 44: "bgra", 50: "bgra"}
"""Vulkan's formats of 8 bits a channel, UNORM and SRGB, that a KTX2 may hold without Basis."""

DIELECTRIC = 0.04
"""Reflectance at normal incidence of what is no metal."""

_LINEAR = srgb_to_linear(np.arange(256) / 255.0).astype(np.float32)
_WRAPS: dict[Any, Wrap] = {10497: "repeat", 33071: "clamp", 33648: "mirror"}


@dataclass(frozen=True)
class TextureUse:
    """A texture as a material uses it.

    Attributes:
        image: index in the file's images.
        texcoord: which set of texture coordinates.
        matrix: (3, 3) from (u, v, 1) of that set to where the image is looked up.
        wrap: along u and along v.
    """

    image: int
    texcoord: int
    matrix: np.ndarray
    wrap: tuple[Wrap, Wrap]


@dataclass
class Material:
    """Surface of a primitive; fields as in ``Part``.

    Attributes:
        alpha: (h, w) image or (1, 1); None where the material is opaque.
        cutoff: alpha below which it is not there.
        uses: field -> the texture that it holds; ``roughness`` stands for ``metallic`` too.
    """

    base_color: np.ndarray
    alpha: np.ndarray | None = None
    cutoff: float = 0.5
    roughness: np.ndarray | float = 1.0
    metallic: np.ndarray | float = 1.0
    normal_map: np.ndarray | None = None
    emission: np.ndarray | None = None
    uses: dict[str, TextureUse] = field(default_factory=dict)


class Materials:
    """The materials of a file; each is made once, and each image decoded once."""

    def __init__(self, document: Document):
        self._document = document
        self._images: dict[int, np.ndarray] = {}
        self._read: dict[tuple[int, frozenset[int]], Material] = {}

    def read(self, index: int | None, texcoords: frozenset[int]) -> Material:
        """Material of a primitive.

        Args:
            index: in the file's materials; None is glTF's default material.
            texcoords: sets of texture coordinates that the primitive has; other textures are left out.
        """
        if index is None:
            return Material(np.ones(3, np.float32))
        if (index, texcoords) not in self._read:
            self._read[index, texcoords] = self._made(index, texcoords)
        return self._read[index, texcoords]

    def _made(self, index: int, texcoords: frozenset[int]) -> Material:
        material = self._document.item("materials", index)
        extensions = material.get("extensions", {})
        glossy = extensions.get("KHR_materials_pbrSpecularGlossiness")
        read = _Reader(self, texcoords)
        if glossy is not None:
            result = _from_specular(read, glossy)
        else:
            pbr, unlit = material.get("pbrMetallicRoughness", {}), "KHR_materials_unlit" in extensions
            result = _from_metallic(read, pbr, unlit)
        mode = material.get("alphaMode", "OPAQUE")
        if mode == "OPAQUE":
            result.alpha = None
        elif mode == "MASK":
            result.cutoff = _finite(material.get("alphaCutoff", 0.5))
        if (use := read.use(material.get("normalTexture"))) is not None:
            scale = _finite(material["normalTexture"].get("scale", 1.0))
            result.normal_map = scaled_normals(self.image(use.image), scale)
            result.uses["normal_map"] = use
        if "KHR_materials_unlit" not in extensions:
            _glow(result, read, material)
        return result

    def image(self, index: int) -> np.ndarray:
        """(h, w, C) uint8 of an image of the file."""
        if index not in self._images:
            document, entry = self._document, self._document.item("images", index)
            inside = "uri" not in entry
            data = document.view(entry.get("bufferView")) if inside else document.resource(entry["uri"])
            self._images[index] = decode_image(data)
        return self._images[index]

    def use(self, info: dict[str, Any]) -> TextureUse:
        """A textureInfo of a material, its extensions resolved."""
        document = self._document
        texture = document.item("textures", info.get("index"))
        texcoord, matrix = info.get("texCoord", 0), np.eye(3)
        transform = info.get("extensions", {}).get("KHR_texture_transform")
        if transform is not None:
            texcoord, matrix = transform.get("texCoord", texcoord), transform_matrix(transform)
        sampler = document.item("samplers", texture["sampler"]) if "sampler" in texture else {}
        wrap = (_WRAPS[sampler.get("wrapS", 10497)], _WRAPS[sampler.get("wrapT", 10497)])
        return TextureUse(_source(texture), int(texcoord), matrix, wrap)


@dataclass
class _Reader:
    """Textures of one primitive's material: those whose texture coordinates it has."""

    materials: Materials
    texcoords: frozenset[int]

    def use(self, info: dict[str, Any] | None) -> TextureUse | None:
        use = None if info is None else self.materials.use(info)
        return use if use is not None and use.texcoord in self.texcoords else None

    def image(self, use: TextureUse) -> np.ndarray:
        return self.materials.image(use.image)


def transform_matrix(transform: dict[str, Any]) -> np.ndarray:
    """(3, 3) of KHR_texture_transform: scale, then rotate counter-clockwise (v runs down), then offset."""
    angle = float(transform.get("rotation", 0.0))
    c, s = np.cos(angle), np.sin(angle)
    (x, y), (a, b) = transform.get("offset", (0.0, 0.0)), transform.get("scale", (1.0, 1.0))
    matrix = np.array([[c * a, s * b, x], [-s * a, c * b, y], [0.0, 0.0, 1.0]], np.float64)
    if not np.isfinite(matrix).all():
        raise TronError("model has a texture transform that is not finite")
    return matrix


def scaled_normals(image: np.ndarray, scale: float) -> np.ndarray:
    """(h, w, 3) float32 normals as (n + 1) / 2, x and y of the stored ones multiplied by ``scale``.

    Their length is left to the look-up, which filters them first (glTF 2.0, section 3.9.3).
    """
    stored = image[..., :3] * np.float32(1 / 255)
    if scale != 1.0:
        stored[..., :2] = (stored[..., :2] - 0.5) * np.float32(scale) + 0.5
    return stored


def metallic_of(
    diffuse: np.ndarray, specular: np.ndarray, glossiness: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """base color (..., 3), roughness (...) and metallic (...) of a specular-glossiness material, all linear.

    Khronos's own conversion (KHR_materials_pbrSpecularGlossiness, examples/convert-between-workflows):
    metallic solves for the reflectance that both workflows give a grey of the same perceived brightness.
    """
    weights = np.array([0.299, 0.587, 0.114])
    strength = specular.max(axis=-1)
    d, s = (np.sqrt(np.maximum(x**2 @ weights, 0.0)) for x in (diffuse, specular))
    b = d * (1 - strength) / (1 - DIELECTRIC) + s - 2 * DIELECTRIC
    root = np.sqrt(np.maximum(b * b - 4 * DIELECTRIC * (DIELECTRIC - s), 0.0))
    metallic = np.where(s < DIELECTRIC, 0.0, np.clip((root - b) / (2 * DIELECTRIC), 0.0, 1.0))
    m = metallic[..., None]
    as_dielectric = diffuse * ((1 - strength)[..., None] / (1 - DIELECTRIC) / np.maximum(1 - m, 1e-6))
    as_metal = (specular - DIELECTRIC * (1 - m)) / np.maximum(m, 1e-6)
    base = np.clip(as_dielectric + (as_metal - as_dielectric) * m**2, 0.0, 1.0)
    return base, 1.0 - glossiness, metallic


def _from_metallic(read: _Reader, pbr: dict[str, Any], unlit: bool) -> Material:
    result = _colored(read, pbr.get("baseColorFactor"), pbr.get("baseColorTexture"))
    result.roughness = 1.0 if unlit else float(_factor(pbr.get("roughnessFactor", 1.0), ()))
    result.metallic = 0.0 if unlit else float(_factor(pbr.get("metallicFactor", 1.0), ()))
    use = None if unlit else read.use(pbr.get("metallicRoughnessTexture"))
    if use is not None:
        packed = read.image(use)
        result.roughness = np.float32(result.roughness / 255.0) * packed[..., 1]
        result.metallic = np.float32(result.metallic / 255.0) * packed[..., 2]
        result.uses["roughness"] = use
    return result


def _from_specular(read: _Reader, glossy: dict[str, Any]) -> Material:
    result = _colored(read, glossy.get("diffuseFactor"), glossy.get("diffuseTexture"))
    specular = _factor(glossy.get("specularFactor", (1.0, 1.0, 1.0)), (3,))
    shine = _factor(glossy.get("glossinessFactor", 1.0), ())
    use = read.use(glossy.get("specularGlossinessTexture"))
    if use is not None:
        packed = read.image(use)
        if packed.shape[2] == 4:
            shine = shine * packed[..., 3] / 255.0
        specular = srgb_to_linear(packed[..., :3] / 255.0) * specular
        result.uses["roughness"] = use
        own = result.uses.get("base_color")
        if own is None:
            result.uses["base_color"] = use
        elif own.texcoord != use.texcoord or not np.allclose(own.matrix, use.matrix):
            raise TronError("diffuse and specular textures of a material do not lie on each other")
    diffuse = result.base_color.astype(np.float64)
    sizes = [(x.shape[0], x.shape[1]) for x in (diffuse, specular) if x.ndim == 3]
    if sizes:
        size = max(sizes)
        diffuse, specular = (_resized(x, size) for x in (diffuse, specular))
        shine = _resized(shine[..., None], size)[..., 0]
        result.uses.setdefault("roughness", result.uses["base_color"])
    base, roughness, metallic = metallic_of(diffuse, specular, shine)
    result.base_color = base.astype(np.float32)
    result.roughness = roughness.astype(np.float32) if sizes else float(roughness)
    result.metallic = metallic.astype(np.float32) if sizes else float(metallic)
    return result


def _glow(result: Material, read: _Reader, material: dict[str, Any]) -> None:
    """Give a material what it emits; an image on other texture coordinates has its mean, on none nothing.

    Images of emission are mostly black: their factor alone would make a lamp of the whole part.
    """
    strength = material.get("extensions", {}).get("KHR_materials_emissive_strength", {})
    factor = _factor(material.get("emissiveFactor", (0.0, 0.0, 0.0)), (3,))
    emission = factor * max(_finite(strength.get("emissiveStrength", 1.0)), 0.0)
    texture = material.get("emissiveTexture") if emission.any() else None
    use = read.use(texture)
    if use is None and texture is not None:
        emission = np.zeros(3)
    elif use is not None:
        emission = _LINEAR[read.image(use)[..., :3]] * emission.astype(np.float32)
        if all(other.texcoord == use.texcoord for other in result.uses.values()):
            result.uses["emission"] = use
        else:
            emission = emission.mean((0, 1))
    if emission.any():
        result.emission = emission.astype(np.float32, copy=False)
    else:
        result.uses.pop("emission", None)


def _resized(values: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(h, w, C) of an image or of a constant (C,)."""
    if values.ndim == 1:
        return np.broadcast_to(values, (*size, len(values)))
    if values.shape[:2] == size:
        return values
    bands = [
        Image.fromarray(values[..., i].astype(np.float32)).resize(
            (size[1], size[0]), Image.Resampling.BILINEAR
        )
        for i in range(values.shape[2])
    ]
    return np.stack([np.asarray(band, np.float64) for band in bands], axis=2)


def _colored(read: _Reader, factor: Any, info: dict[str, Any] | None) -> Material:
    """Material with its base color and alpha."""
    factor = _factor((1.0, 1.0, 1.0, 1.0) if factor is None else factor, (4,))
    use = read.use(info)
    if use is None:
        return Material(factor[:3].astype(np.float32), np.full((1, 1), factor[3]))
    image = read.image(use)
    alpha = (
        image[..., 3] * np.float32(factor[3] / 255.0) if image.shape[2] == 4 else np.full((1, 1), factor[3])
    )
    color = _LINEAR[image[..., :3]] * factor[:3].astype(np.float32)
    return Material(color, alpha, uses={"base_color": use})


def _factor(value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """A factor as float64; what lies outside of [0, 1], as some exporters write it, is clamped."""
    factor = np.asarray(value, np.float64)
    if factor.shape != shape or not np.isfinite(factor).all():
        wanted = f"{shape[0]} finite numbers" if shape else "a finite number"
        raise TronError(f"model has a factor that is not {wanted}")
    return np.clip(factor, 0.0, 1.0)


def _finite(value: Any) -> float:
    number = float(value)
    if not np.isfinite(number):
        raise TronError("model has a material with a number that is not finite")
    return number


def _source(texture: dict[str, Any]) -> int:
    """Index of the image that a texture is read from."""
    extensions = texture.get("extensions", {})
    compressed = extensions.get("KHR_texture_basisu", {}).get("source")
    if compressed is not None and (find_spec("opengl_basisu") or "source" not in texture):
        return compressed
    for name in ("EXT_texture_webp", "EXT_texture_avif"):
        if name in extensions:
            return extensions[name].get("source")
    if "source" not in texture:
        raise TronError(f"model's textures need {next(iter(extensions), 'an image')}, which is not read")
    return texture["source"]


def decode_image(data: memoryview) -> np.ndarray:
    """(h, w, 3) or, with alpha, (h, w, 4) uint8, top row first, as stored.

    PNG, JPEG, WebP and AVIF by Pillow, KTX2 of plain pixels here, of Basis by opengl_basisu where that is
    installed.

    Raises:
        TronError: another format, damaged data, or more than LARGEST_TEXTURE pixels.
    """
    try:
        if bytes(data[:12]) == _KTX2:
            require_size(*struct.unpack_from("<2I", data, 20))
            plain = _PLAIN.get(struct.unpack_from("<I", data, 12)[0])
            return _decode_basis(bytes(data)) if plain is None else _plain_pixels(bytes(data), plain)
        # Only these: Pillow's PostScript reader starts a program.
        with Image.open(io.BytesIO(data), formats=_FORMATS) as image:
            require_size(image.width, image.height)
            return pixels(image)
    except Image.DecompressionBombError as error:
        raise TronError("texture is too large", mend="shrink it") from error
    except (OSError, SyntaxError, ValueError, IndexError, struct.error, zlib.error) as error:
        raise TronError(f"texture cannot be read: {error}", mend=f"store it as {_FORMATS[0]}") from error


def _plain_pixels(data: bytes, channels: str) -> np.ndarray:
    """(h, w, 3 or 4) uint8 of the largest level of a KTX2 without Basis (Khronos, KTX 2.0, section 3)."""
    width, height = struct.unpack_from("<2I", data, 20)
    (scheme,) = struct.unpack_from("<I", data, 44)
    start, stored = struct.unpack_from("<2Q", data, 80)
    size, level = width * height * len(channels), data[start : start + stored]
    if scheme == 2:
        level = pyarrow.decompress(level, size, codec="zstd", asbytes=True)
    elif scheme == 3:
        level = zlib.decompressobj().decompress(level, size)
    elif scheme != 0:
        raise ValueError(f"supercompression {scheme} of KTX2 is not read")
    image = np.frombuffer(level, np.uint8, size).reshape(height, width, len(channels))
    return image[..., [channels.index(channel) for channel in "rgba"[: len(channels)]]]


def _decode_basis(data: bytes) -> np.ndarray:
    texture = basisu("textures are KTX2").open(data)
    decoded = texture.transcode("rgba8").data
    return decoded if texture.has_alpha else decoded[..., :3]


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
