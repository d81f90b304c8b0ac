"""A glTF file's JSON and bytes, bounded and confined to its folder.

Nothing is read that the file does not hold, nothing outside its folder, nothing over a network. Bytes are
mapped, not loaded, so a file that lies about its lengths costs what its JSON costs.
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from datagen.gltf.extensions import require_known
from tron.errors import TronError

LARGEST_JSON = 64 * 2**20
MOST_JSON_ITEMS = 1_000_000
_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942


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


def _mapped(path: Path) -> memoryview:
    """A file's bytes, read when they are needed."""
    if path.stat().st_size == 0:
        raise TronError("file is empty", path)
    return np.memmap(path, np.uint8, "r").data
