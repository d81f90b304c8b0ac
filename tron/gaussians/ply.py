"""Gaussian scenes as PLY files that every 3D Gaussian Splatting reader opens.

The vertex element holds float32, little endian, in the order of the 3DGS reference code: x y z, nx ny nz,
f_dc_0..2, f_rest_0..44 (channel-major: 15 red, 15 green, 15 blue), opacity (logit), scale_0..2 (log),
rot_0..3 (w, x, y, z). The third scale is along the normal; of a flat surfel it is written negligibly small
for readers that expect it. Our materials follow as extra properties that other readers skip: base_color_0..2
(linear), roughness, metallic and object_id (int), of scenes that glow emission_0..2 (linear). What belongs to
the whole scene stands in comments: ``comment tron spacing 0.01``.

The header of a file is held against the file's size before anything is allocated, so that a few hostile bytes
cannot ask for terabytes. A file may be compressed by gzip.
"""

from __future__ import annotations

import gzip
import io
import math
import os
import re
import zlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import plyfile

from tron.errors import TronError
from tron.estimation import MATERIAL
from tron.gaussians.fields import FIELDS, MATERIALS, third_scales
from tron.gaussians.foreign_properties import refuse_points
from tron.gaussians.harmonics import SH_COUNT
from tron.gaussians.projections import DISKS, PROJECTIONS, stated_projection
from tron.storage import atomic_path

NORMAL = ("nx", "ny", "nz")
REST = tuple(f"f_rest_{i}" for i in range(3 * (SH_COUNT - 1)))
(THIRD_SCALE,) = FIELDS["log_thickness"].properties
EMISSION_PROPERTIES = FIELDS["emission"].properties
MATERIAL_PROPERTIES = tuple(name for material in MATERIALS for name in FIELDS[material].properties)
REQUIRED = tuple(
    name
    for field in ("means", "sh", "opacity_logits", "log_scales", "quats")
    for name in FIELDS[field].properties
)
GUESSED_UP = (0.0, -1.0, 0.0)
"""Up where a file says none: 3DGS keeps COLMAP's world, whose y axis points down where photos are level."""
EXPORT = "is it a Gaussian scene? export it as an uncompressed 3DGS or 2DGS PLY"

HEADER_LIMIT = 1 << 16
_PROJECTION = "tron projection "
_MATERIAL = "tron material "
_TYPE_BYTES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "int32", "uint32", "float", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}
_END = re.compile(rb"end_header\r?\n")
_COUNT = re.compile(rb"^(element[ \t]+\S+[ \t]+)(\d+)", re.MULTILINE)


class Stored(NamedTuple):
    """What a file of splats holds, by the names of 3DGS' properties.

    Attributes:
        columns: (M,) each.
        comments: of a PLY's header.
        up: (3,) that the file states; None where it does not.
        turn: (3, 3) from the file's frame to that of 3DGS' PLYs, where the format has another: a rotation, or
            a mirror image.
        up_known: whether ``up`` is stated; False where it is the format's usual one.
        antialiased: whether the splats are to be drawn with Mip-Splatting's filter of the screen.
    """

    columns: dict[str, np.ndarray]
    comments: Sequence[str] = ()
    up: np.ndarray | None = None
    turn: np.ndarray = np.eye(3)
    up_known: bool = True
    antialiased: bool = False


def write_ply(
    target: str | Path | BinaryIO,
    scene: Mapping[str, Any],
    comments: Sequence[str] = (),
    plain: bool = False,
    changing: bool = True,
) -> None:
    """Write what a valid scene holds, by the names of GaussianScene's attributes, and its ``normals`` (M, 3).

    Args:
        target: the file, or a stream.
        scene: its values.
        comments: that stand in the header, after those of the scene.
        plain: the properties of 3DGS alone, without materials and objects.
        changing: with harmonics beyond degree 0.

    Raises:
        TronError: the file cannot be written.
    """
    sh, log_scales = scene["sh"], scene["log_scales"]
    columns: dict[str, np.ndarray] = {}

    def add(names: Sequence[str], values: np.ndarray) -> None:
        columns.update(zip(names, values.reshape(len(sh), -1).T))

    add(FIELDS["means"].properties, scene["means"])
    add(NORMAL, scene["normals"])
    add(FIELDS["sh"].properties, sh[:, 0])
    if changing:
        add(REST, sh[:, 1:].transpose(0, 2, 1))
    add(FIELDS["opacity_logits"].properties, scene["opacity_logits"])
    add(FIELDS["log_scales"].properties, log_scales)
    add([THIRD_SCALE], third_scales(log_scales, scene["log_thickness"]))
    own = () if plain else (*MATERIALS, "object_id", *(["emission"] if np.any(scene["emission"]) else []))
    for name in ("quats", *own):
        add(FIELDS[name].properties, scene[name])
    kinds = {name: "<f8" if values.dtype == np.float64 else "<f4" for name, values in columns.items()}
    rows = np.empty(len(sh), dtype=list((kinds if plain else kinds | {"object_id": "<i4"}).items()))
    for name, values in columns.items():
        rows[name] = values
    element = plyfile.PlyElement.describe(rows, "vertex")
    data = plyfile.PlyData([element], byte_order="<", comments=[*_constants(scene), *comments])
    if not isinstance(target, str | Path):
        data.write(target)
        return
    with atomic_path(target) as temporary:
        data.write(str(temporary))


def read(path: Path) -> Stored:
    """What a PLY holds.

    Raises:
        TronError: it is none, declares more than it holds, or expands without limit.
    """
    with _readable(path):
        if is_gzipped(path):
            columns, comments = columns_in(_whole(path), path)
            return Stored(columns, comments)
        data = plyfile.PlyData.read(str(path))
        vertex = data["vertex"]
        return Stored({each.name: vertex[each.name] for each in vertex.properties}, data.comments)


def columns_in(content: bytes, path: Path) -> tuple[dict[str, np.ndarray], list[str]]:
    """Columns of the vertex element of a PLY in memory, and the comments of its header.

    They are read as one array where rows are of one size: plyfile maps files, and reads what lies in memory
    value by value: 150,000 packed splats took 8.4 s, 0.5 s so.

    Args:
        content: a whole PLY.
        path: what it was made from, for the line.

    Raises:
        TronError: it is no PLY of splats, or declares more than it holds.
    """
    check_sizes(content[:HEADER_LIMIT], len(content), path)
    with _readable(path):
        end = _END.search(content)
        if end is not None:
            # plyfile knows the grammar of headers: it reads this one, of an empty file.
            header = plyfile.PlyData.read(io.BytesIO(_COUNT.sub(rb"\g<1>0", content[: end.end()])))
            first = header.elements[0] if header.elements else None
            counts = [int(each[2]) for each in _COUNT.finditer(content[: end.end()])]
            plain = first is not None and not any(
                isinstance(each, plyfile.PlyListProperty) for each in first.properties
            )
            if first is not None and plain and first.name == "vertex" and not header.text:
                kind = np.dtype(first.dtype(header.byte_order))
                rows = np.frombuffer(content, kind, counts[0], end.end())
                return {name: rows[name] for name in kind.names or ()}, list(header.comments)
        data = plyfile.PlyData.read(io.BytesIO(content))
        vertex = data["vertex"]
        return {each.name: vertex[each.name] for each in vertex.properties}, list(data.comments)


def beginning(path: Path) -> tuple[bytes, int]:
    """The first bytes of a PLY, of what it holds where it is gzipped, and the most bytes that it may have.

    Raises:
        TronError: it cannot be read, or the gzip is damaged.
    """
    with _readable(path):
        if is_gzipped(path):
            return _expanded(path, HEADER_LIMIT), _largest(path)
        with open(path, "rb") as stream:
            return stream.read(HEADER_LIMIT), os.fstat(stream.fileno()).st_size


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """What plyfile raises becomes a TronError of the file."""
    try:
        yield
    except OSError as error:
        raise TronError(f"cannot read: {error.strerror or error}", path) from error
    except (plyfile.PlyParseError, ValueError) as error:  # ValueError: text that is no number
        raise TronError(f"not a readable PLY: {error}", path) from error


def header_comments(path: Path) -> list[str]:
    """Comments of a PLY's header; none where the file is not there or no PLY."""
    return [line[len("comment ") :].rstrip() for line in _header(path) if line.startswith("comment ")]


def header_elements(path: Path) -> set[str]:
    """Names of the elements of a PLY; none where the file is not there or no PLY."""
    return {line.split()[1] for line in _header(path) if line.startswith("element ")}


def _header(path: Path) -> list[str]:
    try:
        with path.open("rb") as file:
            header, end, _ = file.read(HEADER_LIMIT).decode("ascii", "replace").partition("end_header")
    except OSError:
        return []
    return header.splitlines() if end else []


def check_sizes(head: bytes, size: int, path: Path) -> None:
    """Raise TronError unless the elements that the header declares fit into the bytes that follow it.

    `head` holds the first bytes of the file, `size` is the file's length. Only sizes are judged here; the
    grammar is plyfile's business.
    """
    end = head.find(b"end_header")
    if end < 0:
        raise TronError("the PLY header has no end", path)
    ascii_body = False
    elements: list[tuple[str, int, int]] = []  # name, count, least bytes of a row
    vertex: set[str] = set()
    for line in head[:end].decode("ascii", "replace").splitlines():
        words = line.split()
        if words[:2] == ["format", "ascii"]:
            ascii_body = True
        elif len(words) == 3 and words[0] == "element" and words[2].isdigit():
            elements.append((words[1], int(words[2]), 0))
        elif words[:1] == ["property"] and elements and len(words) >= 3:
            name, count, row = elements[-1]
            vertex |= {words[-1]} if name == "vertex" else set()
            # Of a list only its length is certain to be there. In text, a digit and a separator are.
            kind = words[2] if words[1] == "list" else words[1]
            elements[-1] = (name, count, row + (2 if ascii_body else _TYPE_BYTES.get(kind, 1)))
    if "vertex" not in [name for name, _, _ in elements]:
        raise TronError("the PLY has no vertex element", path, EXPORT)
    refuse_points([name for name, _, _ in elements], vertex, path)
    if any(row == 0 and count for _, count, row in elements):
        raise TronError("the PLY declares an element without properties", path)
    needed = sum(count * row for _, count, row in elements)
    body = size - end - len("end_header\n")
    if needed > body:
        rows = max(elements, key=lambda element: element[1] * element[2])
        raise TronError(
            f"the PLY declares {rows[1]} rows of '{rows[0]}', {needed} bytes or more, and holds {body}",
            path,
            "the file is cut short or damaged",
        )


def _constants(scene: Mapping[str, Any]) -> list[str]:
    return [
        *(["tron up_guessed 1"] if scene["up_guessed"] else []),
        f"{_PROJECTION}{scene['projection']}",
        f"{_MATERIAL}{MATERIAL}",
        f"tron kernel_degree {scene['kernel_degree']}",
        f"tron spacing {scene['spacing']!r}",
        f"tron up {' '.join(repr(float(v)) for v in scene['up'])}",
        f"tron oriented {int(scene['oriented'])}",
        f"tron materials_guessed {int(scene['materials_guessed'])}",
        *([f"tron offset {' '.join(map(repr, scene['offset'].tolist()))}"] if scene["offset"].any() else []),
    ]


def constants_of(comments: Sequence[str], path: Path) -> dict[str, list[float]]:
    """{name: numbers} of the comments that are ours, those that we do not know included."""
    constants = {}
    for comment in comments:
        words = comment.split()
        if len(words) < 3 or words[0] != "tron" or comment.startswith((_PROJECTION, _MATERIAL)):
            continue
        try:
            values = [float(word) for word in words[2:]]
        except ValueError:
            values = [math.nan]
        if not all(map(math.isfinite, values)):
            raise TronError(f"comment '{comment[:60]}' does not hold finite numbers", path)
        if words[1] in ("up", "offset") and len(values) != 3:
            raise TronError(f"comment '{comment[:60]}' does not hold three numbers", path)
        constants[words[1]] = values
    return constants


def projection_of(
    properties: Collection[str], comments: Sequence[str], ours: bool, antialiased: bool, path: Path
) -> str:
    """By what the file says; ``ours``: of TRON, with signed normals, which before was all that it said."""
    said = [comment[len(_PROJECTION) :].strip() for comment in comments if comment.startswith(_PROJECTION)]
    if said:
        if said[-1] not in PROJECTIONS:
            raise TronError(
                f"comment '{_PROJECTION}{said[-1][:40]}' names none", path, f"use {', '.join(PROJECTIONS)}"
            )
        return said[-1]
    return DISKS if ours else stated_projection(properties, comments, antialiased)


_MAGIC = b"\x1f\x8b"
_MOST_EXPANDED = 100
"""Times its size that a file may expand to; splats expand to 2 to 10 times theirs."""
_ALWAYS_ALLOWED = 1 << 26


def is_gzipped(path: Path) -> bool:
    """Whether a file begins as gzip's do; OSError if it cannot be read."""
    with open(path, "rb") as stream:
        return stream.read(len(_MAGIC)) == _MAGIC


def _largest(path: Path) -> int:
    """The most bytes that a gzipped file may expand to."""
    return max(_ALWAYS_ALLOWED, _MOST_EXPANDED * path.stat().st_size)


def _whole(path: Path) -> bytes:
    """Content of a gzipped file; TronError if it is damaged or expands beyond its limit."""
    limit = _largest(path)
    data = _expanded(path, limit + 1)
    if len(data) > limit:
        raise TronError(f"expands to more than {_MOST_EXPANDED} times its size", path, "gunzip it yourself")
    return data


def _expanded(path: Path, n_bytes: int) -> bytes:
    try:
        with gzip.open(path) as stream:
            return stream.read(n_bytes)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise TronError(f"gzip file is cut short or damaged: {error}", path) from error
