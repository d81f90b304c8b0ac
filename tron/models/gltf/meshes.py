"""Meshes of a glTF file's scene as parts, one a material (glTF 2.0, sections 3.5 and 3.7)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import DracoPy
import numpy as np
import trimesh

from tron.errors import TronError
from tron.io.gltf_document import Document, node_matrix, read_document
from tron.models.alpha import without_clear
from tron.models.gltf.materials import Material, Materials, TextureUse
from tron.models.parts import Part, Sampling, Wrap, joined

MOST_NODES = 20_000
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_DRACO_METADATA = 0x8000
_SURFACES = (_TRIANGLES, _STRIP, _FAN)


@dataclass
class _Geometry:
    """Arrays of a primitive: faces (F, 3), and for each vertex what the file's attributes mean."""

    faces: np.ndarray
    attributes: dict[str, np.ndarray]


def read_parts(path: Path, most_triangles: int) -> list[Part]:
    """Parts of a file's scene, in its own frame and units; they may be empty.

    Raises:
        TronError: anything that is damaged, not read, or larger than ``most_triangles``.
    """
    document = read_document(path)
    instances = _instances(document)
    _require_few(document, instances, most_triangles)
    materials = Materials(document)
    groups: dict[tuple[Any, ...], list[Part]] = {}
    primitives: dict[tuple[int, int], tuple[tuple[Any, ...], Part]] = {}
    for mesh, matrix in instances:
        for number, primitive in enumerate(document.item("meshes", mesh)["primitives"]):
            if primitive.get("mode", _TRIANGLES) not in _SURFACES:
                continue  # points and lines have no surface
            if (mesh, number) not in primitives:
                geometry = _read_primitive(document, primitive)
                sets = frozenset(int(n[9:]) for n in geometry.attributes if n.startswith("TEXCOORD_"))
                index = primitive.get("material")
                part = _part(geometry, materials.read(index, sets))
                key = (index, sets, part.tint is None, part.base_color.ndim)
                primitives[mesh, number] = key, part
            key, part = primitives[mesh, number]
            groups.setdefault(key, []).append(part.transformed(matrix))
    return [_without_even_tint(joined(parts)) for parts in groups.values()]


def _instances(document: Document) -> list[tuple[int, np.ndarray]]:
    """(mesh, (4, 4) to the scene's frame) of every node with a mesh, parents before children."""
    scenes = document.tree.get("scenes", [])
    nodes = document.tree.get("nodes", [])
    if len(nodes) > MOST_NODES:
        raise TronError(f"model has more than {MOST_NODES:,} nodes", mend="join its meshes")
    if scenes:
        roots = document.item("scenes", document.tree.get("scene", 0)).get("nodes", [])
    else:
        children = {child for node in nodes for child in node.get("children", [])}
        roots = [i for i in range(len(nodes)) if i not in children]
    waiting = [(root, np.eye(4)) for root in reversed(roots)]
    seen: set[int] = set()
    found = []
    while waiting:
        index, above = waiting.pop()
        node = document.item("nodes", index)
        if index in seen:
            raise TronError("model's nodes do not form a tree")
        seen.add(index)
        if "EXT_mesh_gpu_instancing" in node.get("extensions", {}):
            raise TronError("model uses EXT_mesh_gpu_instancing, which is not read", mend="export it without")
        matrix = above @ node_matrix(node)
        if not np.isfinite(matrix).all():
            raise TronError("model has a node whose transform is not finite")
        if "mesh" in node and abs(np.linalg.det(matrix[:3, :3])) > 0:  # scaled to nothing is how some hide
            found.append((node["mesh"], matrix))
        waiting += [(child, matrix) for child in reversed(node.get("children", []))]
    return found


def _require_few(document: Document, instances: list[tuple[int, np.ndarray]], most: int) -> None:
    """Refuse too many triangles by what the file announces, before any is read."""
    announced = {}
    for mesh in {mesh for mesh, _ in instances}:
        primitives = document.item("meshes", mesh).get("primitives")
        if not primitives:
            raise TronError(f"model's mesh {mesh} has no primitives")
        announced[mesh] = sum(_triangles(document, primitive) for primitive in primitives)
    if sum(announced[mesh] for mesh, _ in instances) > most:
        raise TronError(f"model has more than {most:,} triangles", mend="simplify it")


def _triangles(document: Document, primitive: dict[str, Any]) -> int:
    mode = primitive.get("mode", _TRIANGLES)
    if mode not in _SURFACES:
        return 0
    indexed = "indices" in primitive
    index = primitive["indices"] if indexed else primitive["attributes"].get("POSITION")
    count = document.count(index)
    return count // 3 if mode == _TRIANGLES else max(count - 2, 0)


def _read_primitive(document: Document, primitive: dict[str, Any]) -> _Geometry:
    indices: dict[str, int] = primitive["attributes"]
    wanted = {
        name: index
        for name, index in indices.items()
        if name in ("POSITION", "NORMAL", "COLOR_0") or name.startswith("TEXCOORD_")
    }
    if "POSITION" not in wanted:
        raise TronError("model has a primitive without positions")
    packed = primitive.get("extensions", {}).get("KHR_draco_mesh_compression")
    attributes: dict[str, np.ndarray] = {}
    faces = None
    if packed is not None:
        ids = {name: number for name, number in packed["attributes"].items() if name in wanted}
        blob = bytes(document.view(packed["bufferView"]))
        faces, decoded = _of_draco(blob, ids, _triangles(document, primitive))
        attributes = {name: document.meant(wanted[name], values) for name, values in decoded.items()}
    for name, index in wanted.items():
        if name not in attributes:
            attributes[name] = document.meant(index, document.stored(index))
    count = len(attributes["POSITION"])
    if faces is None:
        faces = _faces(document, primitive, count)
    if len(faces) and int(faces.max()) >= count:
        raise TronError("model has a triangle of a vertex that it does not hold")
    widths = {"POSITION": (3,), "NORMAL": (3,), "COLOR_0": (3, 4)}
    for name, values in attributes.items():
        if len(values) != count or values.shape[1] not in widths.get(name, (2,)):
            raise TronError(f"model's attribute {name} does not fit its positions")
    return _Geometry(faces, attributes)


def _faces(document: Document, primitive: dict[str, Any], count: int) -> np.ndarray:
    """(F, 3) int64 triangles of a list, strip or fan (glTF 2.0, section 3.7.2.1)."""
    if "indices" in primitive:
        order = document.stored(primitive["indices"])
        if order.dtype.kind != "u" or order.shape[1] != 1:
            raise TronError("model has indices that are not whole numbers")
        order = order[:, 0].astype(np.int64)
    else:
        order = np.arange(count)
    mode = primitive.get("mode", _TRIANGLES)
    if mode == _TRIANGLES:
        return order[: len(order) // 3 * 3].reshape(-1, 3)
    if len(order) < 3:
        return np.zeros((0, 3), np.int64)
    if mode == _FAN:
        return np.column_stack([order[1:-1], order[2:], np.full(len(order) - 2, order[0])])
    i = np.arange(len(order) - 2)
    odd = i % 2
    return np.column_stack([order[i], order[i + 1 + odd], order[i + 2 - odd]])


def _part(geometry: _Geometry, material: Material) -> Part:
    """A primitive with its material, in the mesh's frame."""
    attributes = geometry.attributes
    if "NORMAL" not in attributes:  # then each triangle is flat (glTF 2.0, section 3.7.2.1)
        corners = geometry.faces.ravel()
        attributes = {name: values[corners] for name, values in attributes.items()}
        geometry = _Geometry(np.arange(len(corners)).reshape(-1, 3), attributes)
    uv, sampling = _coordinates(attributes, material.uses)
    color = attributes.get("COLOR_0")
    base, tint = material.base_color, None
    if color is not None:
        tint = np.clip(color[:, :3], 0.0, 1.0).astype(np.float32)
        if base.ndim == 1:
            base, tint = (base * tint).astype(np.float32), None
    part = Part(
        vertices=attributes["POSITION"],
        normals=_normals(geometry),
        faces=geometry.faces,
        uv=uv,
        base_color=base,
        roughness=material.roughness,
        metallic=material.metallic,
        normal_map=material.normal_map,
        emission=material.emission,
        tint=tint,
        sampling=sampling,
    )
    if material.alpha is not None:
        vertex_alpha = color[:, 3] if color is not None and color.shape[1] == 4 else None
        part = without_clear(part, material.alpha, material.cutoff, vertex_alpha)
    return part


def _without_even_tint(part: Part) -> Part:
    """The part with a tint that is one colour everywhere multiplied into its image.

    Only after parts are joined: primitives of one material may differ in their colours.
    """
    tint = part.tint
    if tint is None or not len(tint) or np.ptp(tint, axis=0).max() > 1e-6:
        return part
    return replace(part, base_color=part.base_color * tint[0], tint=None)


def _normals(geometry: _Geometry) -> np.ndarray:
    """(V, 3) unit normals; where the file's are unusable, the mean of the triangles around."""
    positions, faces = geometry.attributes["POSITION"], geometry.faces
    normals = geometry.attributes.get("NORMAL")
    normals = np.zeros_like(positions) if normals is None else normals.copy()
    length = np.linalg.norm(normals, axis=1)
    bad = ~(np.isfinite(length) & (length > 1e-6))
    if bad.any():
        a, b, c = (positions[faces[:, i]] for i in range(3))
        cross = np.cross(b - a, c - a)
        size = np.linalg.norm(cross, axis=1, keepdims=True)
        flat = np.divide(cross, size, out=np.zeros_like(cross), where=size > 0)
        own = np.asarray(trimesh.geometry.mean_vertex_normals(len(positions), faces, flat))
        found = np.linalg.norm(own, axis=1) > 0.5
        own[~found] = (0.0, 0.0, 1.0)
        normals[bad], length[bad] = own[bad], np.linalg.norm(own[bad], axis=1)
    return normals / length[:, None]


def _coordinates(
    attributes: dict[str, np.ndarray], uses: dict[str, TextureUse]
) -> tuple[np.ndarray | None, dict[str, Sampling]]:
    """Texture coordinates (V, 2) float32 of a part, and how its textures are looked up from them.

    They are those of the normal map, if there is one, for its tangents follow from them.
    """
    if not uses:
        return None, {}
    leading = next(
        uses[name] for name in ("normal_map", "base_color", "roughness", "emission") if name in uses
    )
    if any(use.texcoord != leading.texcoord for use in uses.values()):
        raise TronError("a material's textures lie on two sets of texture coordinates", mend="bake it to one")
    # A transform that is not invertible (one texel for all) is left to the look-up.
    invertible = abs(np.linalg.det(leading.matrix)) > 1e-12
    matrix = leading.matrix if invertible else np.eye(3)
    raw = attributes[f"TEXCOORD_{leading.texcoord}"]
    if not np.isfinite(raw).all():
        raise TronError("model has texture coordinates that are not finite")
    uv = raw @ matrix[:2, :2].T + matrix[:2, 2]
    sampling = {}
    for name, use in uses.items():
        relative = use.matrix @ np.linalg.inv(matrix)
        relative = np.eye(3) if np.allclose(relative, np.eye(3), atol=1e-9) else relative
        at = uv @ relative[:2, :2].T + relative[:2, 2]
        sampling[name] = Sampling(relative, _wrap(use.wrap, at))
    if "roughness" in sampling:
        sampling["metallic"] = sampling["roughness"]
    return uv.astype(np.float32), sampling


def _wrap(wrap: tuple[Wrap, Wrap], uv: np.ndarray) -> Wrap:
    """One way to continue an image, for Mitsuba has one for both axes: that of the axis that leaves it."""
    leaves = [bool(len(uv)) and bool((uv[:, i].min() < 0) or (uv[:, i].max() > 1)) for i in range(2)]
    return wrap[1] if leaves[1] and not leaves[0] else wrap[0]


def _of_draco(
    blob: bytes, ids: dict[str, int], most_triangles: int
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Decode a primitive of KHR_draco_mesh_compression by DracoPy.

    Args:
        blob: the compressed buffer view.
        ids: glTF attribute -> Draco's unique id.
        most_triangles: that the primitive's accessors say there are.

    Returns:
        faces (F, 3) int64, and glTF attribute -> (V, C) values as stored.

    Raises:
        TronError: damaged data, more triangles than announced, or an attribute that is not there.
    """
    # Draco allocates what the header says before it reads on.
    triangles = _announced_triangles(blob)
    if triangles > most_triangles:
        raise TronError(f"Draco mesh announces {triangles:,} triangles, its accessors {most_triangles:,}")
    try:
        mesh = DracoPy.decode(blob)
    except Exception as error:  # DracoPy has no exception of its own for damaged data
        raise TronError(f"Draco mesh cannot be decoded: {error}") from error
    faces = getattr(mesh, "faces", None)
    if faces is None:
        raise TronError("Draco buffer holds points, not triangles")
    stored = {attribute["unique_id"]: attribute["data"] for attribute in mesh.attributes}
    if missing := [name for name, number in ids.items() if number not in stored]:
        raise TronError(f"Draco mesh lacks the attribute {missing[0]}")
    values = {name: np.asarray(stored[number]) for name, number in ids.items()}
    columns = {name: each[:, None] if each.ndim == 1 else each for name, each in values.items()}
    return np.asarray(faces, np.int64).reshape(-1, 3), columns


def _announced_triangles(blob: bytes) -> int:
    """Number of triangles in Draco's header (Draco bitstream specification 2.2, sections 3 and 4)."""
    try:
        if blob[:5] != b"DRACO" or blob[7] != 1:
            raise TronError("Draco buffer holds no mesh")
        major, minor, edgebreaker = blob[5], blob[6], blob[8]
        if (major, minor) < (2, 2):
            raise TronError(f"Draco bitstream {major}.{minor} is older than 2.2")
        if int.from_bytes(blob[9:11], "little") & _DRACO_METADATA:
            raise TronError("Draco mesh with metadata is not read", mend="compress it without")
        if not edgebreaker:
            return _varint(blob, 11)[0]
        _, place = _varint(blob, 12)  # a byte of traversal type, then the number of vertices
        return _varint(blob, place)[0]
    except IndexError as error:
        raise TronError("Draco buffer is too short") from error


def _varint(blob: bytes, place: int) -> tuple[int, int]:
    """Unsigned LEB128 number, and where it ends."""
    value = shift = 0
    while True:
        byte = blob[place]
        value |= (byte & 0x7F) << shift
        place, shift = place + 1, shift + 7
        if byte < 0x80 or shift > 63:
            return value, place
