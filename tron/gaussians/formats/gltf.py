"""glTF with KHR_gaussian_splatting, by its release candidate of July 2026 (github.com/KhronosGroup/glTF).

A primitive of points has a splat a point: ROTATION (x, y, z, w), SCALE and OPACITY as they are, and a
coefficient of the harmonics an attribute. Values are display-referred sRGB; y is up.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import expit

from tron.color import srgb_to_linear
from tron.errors import TronError
from tron.gaussians.formats.splats import Y_UP, Splats, joined, logarithms, logits, one_line
from tron.gaussians.harmonics import SH_COUNT, dc_to_rgb
from tron.io.gltf_document import Document, binary_file, node_matrix, read_document

EXTENSION = "KHR_gaussian_splatting"
_SPACE = "srgb_rec709_display"
_KERNEL = {"kernel": "ellipse", "colorSpace": _SPACE, "sortingMethod": "cameraDistance"}
_KERNEL |= {"projection": "perspective"}
_COEFFICIENTS = [f"SH_DEGREE_{degree}_COEF_{n}" for degree in range(4) for n in range(2 * degree + 1)]
_DEEPEST = 64
_FLOAT, _BYTE, _POINTS, _ARRAY_BUFFER = 5126, 5121, 0, 34962


def check(path: Path) -> None:
    """Raise TronError unless a file's JSON tells of splats."""
    with one_line(path):
        if not any(EXTENSION in each.get("extensions", {}) for each in _primitives(read_document(path))):
            mend = "a mesh is put beside a scene: tron-relight meshes=[{file: MODEL.glb}]"
            raise TronError(f"this glTF holds no splats ({EXTENSION})", path, mend)


def read(path: Path) -> Splats:
    """All splats of the file's scene, y up.

    Raises:
        TronError: it holds none, or what is damaged or not read.
    """
    with one_line(path):
        document = read_document(path)
        tree = document.tree
        number = tree.get("scene", 0)
        roots = document.item("scenes", number).get("nodes", []) if tree.get("scenes") else []
        parts = [part for root in roots for part in _of_node(document, root, np.eye(4), 0)]
        if not parts:
            raise TronError(f"the scene of this glTF holds no splats ({EXTENSION})", path)
        return joined(parts, Y_UP)


def write(splats: Splats) -> bytes:
    """A .glb of splats of degree 3, y up, that others show as points in their mean colours."""
    base = srgb_to_linear(np.clip(dc_to_rgb(splats.sh[:, 0]), 0, 1))
    opacity = expit(np.asarray(splats.opacity_logits, np.float64))
    color = np.concatenate([base, opacity[:, None]], axis=1)
    values = {
        "POSITION": splats.means,
        "COLOR_0": (color * 255).round().astype(np.uint8),
        f"{EXTENSION}:ROTATION": splats.quats[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": np.exp(splats.log_scales),
        f"{EXTENSION}:OPACITY": opacity,
        **{f"{EXTENSION}:{name}": splats.sh[:, k] for k, name in enumerate(_COEFFICIENTS)},
    }
    views, accessors, binary = [], [], bytearray()
    for name, each in values.items():
        rows = each if each.dtype == np.uint8 else each.astype("<f4")
        content = rows.tobytes()  # of 4 bytes each, so that all begin at a multiple of 4
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(content)})
        views[-1]["target"] = _ARRAY_BUFFER
        kind = "SCALAR" if rows.ndim == 1 else f"VEC{rows.shape[1]}"
        accessor: dict[str, Any] = {"bufferView": len(accessors), "count": len(rows), "type": kind}
        accessor["componentType"] = _BYTE if rows.dtype == np.uint8 else _FLOAT
        if rows.dtype == np.uint8:
            accessor["normalized"] = True
        if name == "POSITION":
            accessor |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        accessors.append(accessor)
        binary += content
    primitive = {"attributes": {name: k for k, name in enumerate(values)}, "mode": _POINTS}
    tree = {
        "asset": {"version": "2.0", "generator": "TRON"},
        "extensionsUsed": [EXTENSION],
        "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive | {"extensions": {EXTENSION: _KERNEL}}]}],
        "accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": len(binary)}],
    }  # fmt: skip
    return binary_file(tree, bytes(binary))


def _primitives(document: Document) -> Iterator[dict[str, Any]]:
    for mesh in document.tree.get("meshes", []):
        yield from mesh.get("primitives", [])


def _of_node(document: Document, number: Any, above: np.ndarray, depth: int) -> Iterator[Splats]:
    """Splats of a node and of those under it, in the scene."""
    if depth > _DEEPEST:
        raise TronError(f"nodes stand more than {_DEEPEST} deep in one another")
    node = document.item("nodes", number)
    matrix = above @ node_matrix(node)
    if "mesh" in node:
        for primitive in document.item("meshes", node["mesh"]).get("primitives", []):
            if EXTENSION in primitive.get("extensions", {}):
                yield _of_primitive(document, primitive).placed(matrix)
    for child in node.get("children", []):
        yield from _of_node(document, child, matrix, depth + 1)


def _of_primitive(document: Document, primitive: dict[str, Any]) -> Splats:
    """Splats in their node's frame."""
    says = primitive["extensions"][EXTENSION]
    if says.get("kernel") != _KERNEL["kernel"]:
        raise TronError(
            f"its splats have the kernel '{str(says.get('kernel'))[:40]}'", mend="ellipse is read"
        )
    if says.get("colorSpace") != _SPACE:
        space = str(says.get("colorSpace"))[:40]
        raise TronError(f"its colours are in the space '{space}'", mend=f"{_SPACE} is read")
    if says.get("extensions"):
        raise TronError(
            f"its splats are stored by {next(iter(says['extensions']))[:60]}", mend="export without"
        )
    attributes = primitive["attributes"]

    def values(name: str) -> np.ndarray:
        index = attributes[name]
        return document.meant(index, document.stored(index)).astype(np.float32)

    names = [f"{EXTENSION}:{name}" for name in _COEFFICIENTS]
    bands = next((k for k, name in enumerate(names) if name not in attributes), SH_COUNT)
    return Splats(
        means=values("POSITION"),
        quats=values(f"{EXTENSION}:ROTATION")[:, [3, 0, 1, 2]],
        log_scales=logarithms(values(f"{EXTENSION}:SCALE"), document.path),
        opacity_logits=logits(values(f"{EXTENSION}:OPACITY")[:, 0], document.path),
        sh=np.stack([values(name) for name in names[: max(bands, 1)]], axis=1),
    )
