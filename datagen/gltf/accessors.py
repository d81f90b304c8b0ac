"""Accessors: typed arrays in a glTF file's buffers (glTF 2.0, sections 3.6.2 and 3.6.2.3 for sparse ones)."""

from __future__ import annotations

from typing import Any

import numpy as np

from datagen.gltf.document import Document
from tron.errors import TronError

MOST_ELEMENTS = 15_000_000
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_KINDS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}


def read_raw(document: Document, index: Any) -> np.ndarray:
    """(count, width) values as stored; zeros where an accessor has no buffer view and is not sparse."""
    accessor = document.item("accessors", index)
    count = element_count(document, index)
    width, kind = _WIDTHS.get(accessor.get("type", "")), _KINDS.get(accessor.get("componentType", 0))
    if width is None or kind is None:
        raise TronError(f"model's accessor {index} has an unknown type", document.path)
    view = accessor.get("bufferView")
    if view is None:
        values = np.zeros((count, width), kind)
    else:
        stride = document.item("bufferViews", view).get("byteStride")
        values = _array(document, view, accessor.get("byteOffset", 0), count, width, kind, stride)
    sparse = accessor.get("sparse")
    if sparse is None:
        return values
    changed, where, what = sparse["count"], sparse["indices"], sparse["values"]
    if not isinstance(changed, int) or not 0 <= changed <= count:
        raise TronError(f"model's sparse accessor {index} changes more than it holds", document.path)
    whole = _KINDS.get(where["componentType"], "")
    if "u" not in whole:
        raise TronError(
            f"model's sparse accessor {index} has indices that are not whole numbers", document.path
        )
    places = _array(document, where["bufferView"], where.get("byteOffset", 0), changed, 1, whole, None)
    if changed and int(places.max()) >= count:
        raise TronError(f"model's sparse accessor {index} changes what it does not hold", document.path)
    values = values.copy()
    values[places[:, 0]] = _array(
        document, what["bufferView"], what.get("byteOffset", 0), changed, width, kind, None
    )
    return values


def element_count(document: Document, index: Any) -> int:
    """The number of elements an accessor announces; TronError where it makes no sense."""
    count = document.item("accessors", index).get("count")
    if not isinstance(count, int) or count < 0:
        raise TronError(f"model's accessor {index} has no count", document.path)
    if count > MOST_ELEMENTS:
        raise TronError(f"model's accessor {index} has more than {MOST_ELEMENTS:,} elements", document.path)
    return count


def meant(document: Document, index: Any, stored: np.ndarray) -> np.ndarray:
    """float64 of stored values: normalised integers become [0, 1] or [-1, 1] (glTF 2.0, section 3.11)."""
    if document.item("accessors", index).get("normalized") and stored.dtype.kind in "iu":
        return np.maximum(stored / np.iinfo(stored.dtype).max, -1.0)
    return np.asarray(stored, np.float64)


def read_values(document: Document, index: Any) -> np.ndarray:
    """(count, width) float64 of what an accessor means."""
    return meant(document, index, read_raw(document, index))


def _array(
    document: Document, view: Any, offset: Any, count: int, width: int, kind: str, stride: Any
) -> np.ndarray:
    data = document.view(view)
    item = np.dtype(kind).itemsize
    size = item * width
    stride = size if stride is None else stride
    if not isinstance(offset, int) or not isinstance(stride, int) or offset < 0 or stride < size:
        raise TronError("model has an accessor of no sensible layout", document.path)
    if count and offset + (count - 1) * stride + size > len(data):
        raise TronError("model has an accessor that ends after its buffer view", document.path)
    if not count:
        return np.zeros((0, width), kind)
    return np.ndarray((count, width), kind, data, offset, (stride, item))
