"""glTF 2.0 files: JSON, bytes and accessors, bounded and confined to the file's folder.

Nothing is read that the file does not hold, nothing outside its folder, nothing over a network. Bytes are
mapped, not loaded, so a file that lies about its lengths costs what its JSON costs. What damaged numbers make
Python and NumPy raise is left to who reads them, :data:`DAMAGE`, and said there in one line.
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from scipy.spatial.transform import Rotation

from tron.errors import TronError

LARGEST_JSON = 64 * 2**20
MOST_JSON_ITEMS = 1_000_000
MOST_ELEMENTS = 15_000_000
_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_KINDS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}

HONOURED = {
    "KHR_draco_mesh_compression": "decoded by DracoPy",
    "KHR_mesh_quantization": "integers become what they stand for",
    "KHR_gaussian_splatting": "splats: a scene, not a model",
    "KHR_texture_transform": "offset, scale and rotation",
    "KHR_texture_basisu": "KTX2: plain pixels; Basis by opengl_basisu (`pip install 'tron-relight[ktx2]'`)",
    "KHR_materials_emissive_strength": "factor on what fronts emit",
    "EXT_texture_webp": "decoded by Pillow",
    "EXT_texture_avif": "decoded by Pillow",
}
APPROXIMATED = {
    "KHR_materials_pbrSpecularGlossiness": "converted to metallic and roughness by Khronos's formula",
    "KHR_materials_unlit": "its colour becomes a rough dielectric's base color, which light shades",
    "KHR_materials_transmission": "opaque",
    "KHR_materials_diffuse_transmission": "opaque",
    "KHR_materials_volume": "opaque",
    "KHR_materials_clearcoat": "left off: the layer under it shows",
    "KHR_materials_sheen": "left off",
    "KHR_materials_iridescence": "left off",
    "KHR_materials_anisotropy": "isotropic",
    "KHR_materials_dispersion": "opaque",
    "KHR_materials_ior": "1.5",
    "KHR_materials_specular": "1",
    "KHR_materials_variants": "the default variant",
}
IGNORED = {
    "KHR_lights_punctual": "scenes have lights of their own",
    "KHR_animation_pointer": "models do not move",
    "KHR_node_visibility": "every node is shown",
    "KHR_xmp_json_ld": "metadata",
}


def require_known(required: Iterable[str]) -> None:
    """Raise TronError for the first of a file's ``extensionsRequired`` that no table above holds."""
    for name in required:
        if name not in HONOURED | APPROXIMATED | IGNORED:
            meshopt = "undo it with `gltf-transform dequantize`, or compress with Draco"
            mend = meshopt if name.endswith("meshopt_compression") else "export it without"
            raise TronError(f"model requires the glTF extension {name}, which is not read", mend=mend)


@dataclass
class Document:
    """A parsed file.

    Attributes:
        path: of the file; what it refers to lies in its folder.
        tree: the JSON object.
        binary: bytes of a GLB's second chunk; empty elsewhere.
    """

    path: Path
    tree: dict[str, Any]
    binary: memoryview
    _buffers: dict[int, memoryview] = field(default_factory=dict)

    def item(self, kind: str, index: Any) -> dict[str, Any]:
        """Entry ``index`` of a list of the file, such as ``accessors``; TronError where there is none."""
        items = self.tree.get(kind, [])
        if not isinstance(index, int) or not 0 <= index < len(items) or not isinstance(items[index], dict):
            raise TronError(f"model refers to {kind}[{index}], which it does not hold", self.path)
        return items[index]

    def view(self, index: Any) -> memoryview:
        """Bytes of a buffer view."""
        view = self.item("bufferViews", index)
        if any(name.endswith("meshopt_compression") for name in view.get("extensions", {})):
            # Without the extension its data are those of the fallback buffer, where that has any.
            buffer = self.item("buffers", view.get("buffer"))
            if "uri" not in buffer:
                require_known(["EXT_meshopt_compression"])
        return _slice(
            self._buffer(view.get("buffer")), view.get("byteOffset", 0), view["byteLength"], "buffer view"
        )

    def resource(self, uri: Any) -> memoryview:
        """Bytes of a data URI, or of a file in the model's folder.

        Raises:
            TronError: any other place, or nothing is there.
        """
        if not isinstance(uri, str):
            raise TronError("model has a URI that is not text", self.path)
        if uri.startswith("data:"):
            head, comma, text = uri.partition(",")
            if not comma or not head.endswith(";base64"):
                raise TronError("model has a data URI that is not base64", self.path)
            try:
                return memoryview(base64.b64decode(text, validate=True))
            except (binascii.Error, ValueError) as error:
                raise TronError("model has a damaged data URI", self.path) from error
        return _mapped(confined(self.path, unquote(uri)))

    def count(self, index: Any) -> int:
        """Number of elements that an accessor announces; TronError beyond MOST_ELEMENTS."""
        count = self.item("accessors", index).get("count")
        if not isinstance(count, int) or not 0 <= count <= MOST_ELEMENTS:
            raise TronError(f"model's accessor {index} has more than {MOST_ELEMENTS:,} elements", self.path)
        return count

    def stored(self, index: Any) -> np.ndarray:
        """(count, width) values of an accessor as they lie (glTF 2.0, 3.6.2; 3.6.2.3 for sparse ones)."""
        accessor, count = self.item("accessors", index), self.count(index)
        width, kind = _WIDTHS[accessor["type"]], _KINDS[accessor["componentType"]]
        values = np.zeros((count, width), kind)
        if "bufferView" in accessor:
            values = self._array(accessor, count, width, kind)
        if (sparse := accessor.get("sparse")) is not None:
            where, changed = sparse["indices"], sparse["count"]
            places = self._array(where, changed, 1, _KINDS[where["componentType"]])
            if places.dtype.kind != "u":
                raise TronError(f"model's sparse accessor {index} has indices that are not whole numbers")
            values = values.copy()
            values[places[:, 0]] = self._array(sparse["values"], changed, width, kind)
        return values

    def meant(self, index: Any, stored: np.ndarray) -> np.ndarray:
        """float64 of stored values: normalised integers become [0, 1] or [-1, 1] (glTF 2.0, 3.11)."""
        if self.item("accessors", index).get("normalized") and stored.dtype.kind in "iu":
            return np.maximum(stored / np.iinfo(stored.dtype).max, -1.0)
        return np.asarray(stored, np.float64)

    def _array(self, where: dict[str, Any], count: int, width: int, kind: str) -> np.ndarray:
        """(count, width) rows of a buffer view; NumPy refuses those that do not lie within it."""
        if not count:
            return np.zeros((0, width), kind)
        item = np.dtype(kind).itemsize
        stride = self.item("bufferViews", where["bufferView"]).get("byteStride", item * width)
        data, offset = self.view(where["bufferView"]), where.get("byteOffset", 0)
        try:
            return np.ndarray((count, width), kind, data, offset, (stride, item))
        except (TypeError, ValueError) as error:
            raise TronError(
                "model has an accessor that does not lie in its buffer view", self.path
            ) from error

    def _buffer(self, index: Any) -> memoryview:
        if index not in self._buffers:
            buffer = self.item("buffers", index)
            if "uri" in buffer:
                self._buffers[index] = self.resource(buffer["uri"])
            elif index == 0 and len(self.binary):
                self._buffers[index] = self.binary
            else:
                raise TronError(f"model's buffer {index} has no data", self.path)
        return self._buffers[index]


def confined(model: Path, name: str) -> Path:
    """The file that a model refers to; TronError unless it is there, in the model's folder or below."""
    shown = " ".join(name[:80].split())
    if ":" in name or "\\" in name or "\0" in name or name.startswith("/"):
        raise TronError(f"model refers to '{shown}', not to a file in its folder", model)
    folder = model.parent.resolve()
    target = (folder / name).resolve()
    if not target.is_relative_to(folder):
        raise TronError(f"model refers to '{shown}', outside its folder", model)
    if not target.is_file():
        raise TronError(f"model refers to '{shown}', which is missing", model)
    return target


def read_document(path: Path) -> Document:
    """Open a .gltf or .glb file.

    Raises:
        TronError: lengths that lie, damaged JSON, another version, or a required extension that is not read.
    """
    data = _mapped(path)
    binary = memoryview(b"")
    if path.suffix.lower() == ".glb":
        text, binary = _chunks(data)
    else:
        text = data
    if len(text) > LARGEST_JSON:
        raise TronError(f"model's JSON is larger than {LARGEST_JSON >> 20} MiB", mend="store it as .glb")
    content = bytes(text)
    if content.count(b",") + content.count(b"{") + content.count(b"[") > MOST_JSON_ITEMS:
        raise TronError(f"model's JSON holds more than {MOST_JSON_ITEMS:,} values")
    tree = json.loads(content)
    if not isinstance(tree, dict) or not isinstance(tree.get("asset"), dict):
        raise TronError("model is not glTF: it has no asset")
    version = str(tree["asset"].get("version"))
    if version.split(".")[0] != "2":
        raise TronError(f"model is glTF {version[:8]}", mend="only version 2 is read")
    require_known(tree.get("extensionsRequired", []))
    return Document(path, tree, binary)


def _chunks(data: memoryview) -> tuple[memoryview, memoryview]:
    """JSON and binary chunk of a GLB (glTF 2.0, section 4.4)."""
    if len(data) < 20:
        raise TronError("model is not a GLB: it is too short")
    magic, version, length, size, kind = struct.unpack_from("<5I", data)
    if magic != _MAGIC or kind != _JSON:
        raise TronError("model is not a GLB: its header says otherwise")
    if version != 2:
        raise TronError(f"model is GLB {version}", mend="only version 2 is read")
    if length > len(data):
        raise TronError(f"GLB header says {length:,} bytes, the file has {len(data):,}")
    data = data[:length]
    text = _slice(data, 20, size, "JSON chunk")
    start = 20 + size
    if start + 8 > length:
        return text, memoryview(b"")
    size, kind = struct.unpack_from("<2I", data, start)
    binary = _slice(data, start + 8, size, "binary chunk")
    return text, binary if kind == _BIN else memoryview(b"")


def _slice(data: memoryview, start: Any, size: Any, what: str) -> memoryview:
    if not isinstance(start, int) or not isinstance(size, int) or start < 0 or size < 0:
        raise TronError(f"model has a {what} of no sensible size")
    if start + size > len(data):
        raise TronError(f"model's {what} ends at byte {start + size:,} of {len(data):,}")
    return data[start : start + size]


def node_matrix(node: Mapping[str, Any]) -> np.ndarray:
    """(4, 4) from a node's frame to its parent's (glTF 2.0, section 3.5.2)."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    turn = Rotation.from_quat(node.get("rotation", (0.0, 0.0, 0.0, 1.0))).as_matrix()
    matrix[:3, :3] = turn * np.asarray(node.get("scale", (1.0, 1.0, 1.0)), np.float64)
    matrix[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return matrix


def binary_file(tree: Mapping[str, Any], binary: bytes) -> bytes:
    """A .glb (glTF 2.0, section 4.4) of a JSON and of its buffer, of whole times 4 bytes."""
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(binary))
    head += struct.pack("<I4s", len(text), b"JSON")
    return head + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary


def _mapped(path: Path) -> memoryview:
    """A file's bytes, read when they are needed."""
    if path.stat().st_size == 0:
        raise TronError("file is empty", path)
    return np.memmap(path, np.uint8, "r").data
