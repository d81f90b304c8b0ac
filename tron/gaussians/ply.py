"""Gaussian scenes as PLY files that every 3D Gaussian Splatting reader opens.

The vertex element holds float32, little endian, in the order of the 3DGS reference code: x y z, nx ny nz,
f_dc_0..2, f_rest_0..44 (channel-major: 15 red, 15 green, 15 blue), opacity (logit), scale_0..2 (log),
rot_0..3 (w, x, y, z). The third scale is along the normal; of a flat surfel it is written negligibly small
for readers that expect it. Our materials follow as extra properties that other readers skip: base_color_0..2
(linear), roughness, metallic and object_id (int). What belongs to the whole scene stands in comments:
``comment tron spacing 0.01``.

The header of a file is held against the file's size before anything is allocated, so that a few hostile bytes
cannot ask for terabytes.
"""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import plyfile
from scipy.special import expit

from tron.color import srgb_to_linear
from tron.errors import TronError
from tron.estimation import MATERIAL
from tron.gaussians.fields import FIELDS, MATERIALS, third_scales
from tron.gaussians.foreign_files import (
    beginning,
    foreign_kernels,
    is_gzipped,
    largest,
    refuse_foreign,
    round_ones,
    smoothed,
    stated_up,
    thin_last,
    usable_splats,
    whole,
)
from tron.gaussians.foreign_properties import plain_columns, refuse_points
from tron.gaussians.formats.registry import FORMATS, Format
from tron.gaussians.formats.splats import Splats
from tron.gaussians.harmonics import SH_COUNT, dc_to_rgb
from tron.gaussians.packed_files import PACKED_SPLATS, Packing, packing, unpacked
from tron.gaussians.ply_arrays import columns_in
from tron.gaussians.projections import DISKS, FILTER, PROJECTIONS, stated_projection
from tron.gaussians.spz_header import read_header
from tron.gaussians.stored_values import as_3dgs_stores
from tron.io.local_frame import local_origin, said
from tron.io.recognised import refuse_placeholder
from tron.storage import atomic_path

log = logging.getLogger(__name__)

NORMAL = ("nx", "ny", "nz")
REST = tuple(f"f_rest_{i}" for i in range(3 * (SH_COUNT - 1)))
(THIRD_SCALE,) = FIELDS["log_thickness"].properties
MATERIAL_PROPERTIES = tuple(name for material in MATERIALS for name in FIELDS[material].properties)
REQUIRED = tuple(
    name
    for field in ("means", "sh", "opacity_logits", "log_scales", "quats")
    for name in FIELDS[field].properties
)

# What a Gaussian without materials is taken to be made of: a rough dielectric in its own colours.
GUESSED_ROUGHNESS = 0.6
GUESSED_METALLIC = 0.0
# Up in a file that does not say: 3DGS keeps COLMAP's world, whose y axis points down where photos are level.
GUESSED_UP = (0.0, -1.0, 0.0)

_HEADER_LIMIT = 1 << 16
_PROJECTION = "tron projection "
_MATERIAL = "tron material "
_VISIBLE = 1 / 255
"""Opacity below which a splat is not drawn (conventions.md, 6)."""
_COARSE = 0.25
"""Steps of stored positions, in widths of splats, from which they are seen."""
_TYPE_BYTES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "int32", "uint32", "float", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}
NOT_READ = "not read, so that it may look different here"
_EXPORT = "is it a Gaussian scene? export it as an uncompressed 3DGS or 2DGS PLY"


def write_ply(
    path: str | Path,
    scene: Mapping[str, Any],
    comments: Sequence[str] = (),
    plain: bool = False,
    changing: bool = True,
) -> None:
    """Write what a valid scene holds, by the names of GaussianScene's attributes, and its ``normals`` (M, 3).

    Args:
        path: the file.
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
    for name in ("quats", *(() if plain else (*MATERIALS, "object_id"))):
        add(FIELDS[name].properties, scene[name])
    kinds = {name: "<f8" if values.dtype == np.float64 else "<f4" for name, values in columns.items()}
    rows = np.empty(len(sh), dtype=list((kinds if plain else kinds | {"object_id": "<i4"}).items()))
    for name, values in columns.items():
        rows[name] = values
    element = plyfile.PlyElement.describe(rows, "vertex")
    with atomic_path(path) as temporary:
        plyfile.PlyData([element], byte_order="<", comments=[*_constants(scene), *comments]).write(
            str(temporary)
        )


def read_splats(path: str | Path) -> dict[str, Any]:
    """Attributes of the GaussianScene in a file of splats; ``spacing`` only if the file says it.

    Of three scales the smallest is the thickness, and the rotation is permuted, so that the normal is the
    axis along which the Gaussian was thinnest; ``round_ones`` (M,) bool tells where there is no such axis.
    Quaternions are normalised. f_rest of degree 0 to 3 is accepted. A file without materials gets guessed
    ones (base colour from the mean colour, rough, not metallic) and says so in `materials_guessed`; a file
    that is not TRON's has unoriented normals (`oriented` is False) and kernel degree 2. Up is what a comment
    says, TRON's or another's (:mod:`tron.gaussians.foreign_files`); where none does it is -y, and
    `up_guessed` is True. Mip-Splatting's ``filter_3D`` is folded in. An opacity logit of +infinity means
    opaque; splats that are broken are left out (:mod:`tron.gaussians.foreign_files`). The middle of large
    coordinates is taken away in float64, and is in `offset` (:mod:`tron.io.local_frame`). Each of these says
    so in one line.

    The file may be compressed by gzip, packed (:mod:`tron.gaussians.packed_files`), or of another program
    (:mod:`tron.gaussians.formats`). ``turn`` (3, 3) leads from the frame of a file of .spz into that of 3DGS'
    PLYs (:mod:`tron.gaussians.spz_header`): a rotation or a mirror image. Where the file does not state its
    frame, `up_guessed` is True. glTF and USD say which way is up.

    Raises:
        TronError: files that are missing, are neither a PLY nor packed splats, lack properties (named),
            declare more than they hold, expand without limit, or hold no splat.
    """
    path = Path(path)
    known = check_header(path)
    if isinstance(known, Format):
        splats = known.read(path)
        columns, comments, up = _columns(splats), [], splats.up
    else:
        columns, comments = _parsed(path, known)
        up = stated_up(comments)
    turn, up_stated, antialiased = np.eye(3), True, False
    if known == PACKED_SPLATS[".spz"]:
        header = read_header(path.read_bytes())
        turn, up_stated, antialiased = header.turn, header.stated, header.antialiased
        up = GUESSED_UP @ turn
    constants = _read_constants(comments, path)
    columns = plain_columns(columns, bool(constants), path)
    _check_properties(columns, comments, path)
    scales = [name for name in (*FIELDS["log_scales"].properties, THIRD_SCALE) if name in columns]
    if not constants:
        columns = as_3dgs_stores(columns, scales, path)
    # Before they are smoothed: a filter much wider than a splat hides its axes, not where it faces.
    columns["round_ones"] = round_ones(np.stack([columns[name] for name in scales], axis=-1))
    if FILTER in columns:
        columns = _filtered(columns, scales, path)
    colors = [name for name in (*FIELDS["sh"].properties, *REST) if name in columns]
    columns = usable_splats(columns, scales, colors, path)

    def stack(names: Sequence[str]) -> np.ndarray:
        return np.stack([np.asarray(columns[name], dtype=np.float32) for name in names], axis=-1)

    def field(name: str) -> np.ndarray:
        values = stack(FIELDS[name].properties)
        return values if FIELDS[name].shape else values[:, 0]

    if not len(columns["x"]):
        raise TronError("the scene has no surfels", path)
    offset = constants.get("offset", [0.0, 0.0, 0.0])
    means = field("means")
    # Where a file of TRON's stands was decided when it was written, but where its coordinates were put back.
    if not constants or columns["x"].dtype == np.float64:
        means, offset = _about_local_origin(columns, path)
    quats, log_scales, log_thickness = thin_last(field("quats"), stack(scales))
    sh = _harmonics(columns, stack, path)
    guessed = MATERIAL_PROPERTIES[0] not in columns
    stated, oriented = constants.get("up", up), bool(constants.get("oriented", [0])[0])
    return {
        "means": means,
        "quats": quats,
        "log_scales": log_scales,
        "log_thickness": log_thickness,
        "round_ones": columns["round_ones"],
        "opacity_logits": field("opacity_logits"),
        "sh": sh,
        **(_guess(sh) if guessed else {name: field(name) for name in MATERIALS}),
        "object_id": _object_id(columns, len(means), path),
        "kernel_degree": int(constants.get("kernel_degree", [2])[0]),
        **({"spacing": constants["spacing"][0]} if "spacing" in constants else {}),
        "turn": turn,
        "up": np.array(GUESSED_UP if stated is None else stated),
        "up_guessed": stated is None or not up_stated or bool(constants.get("up_guessed", [0])[0]),
        "materials_guessed": guessed or bool(constants.get("materials_guessed", [0])[0]),
        "oriented": oriented,
        "offset": np.array(offset),
        "projection": _projection(columns, comments, bool(constants) and oriented, antialiased, path),
    }


def check_header(path: Path) -> Packing | Format | None:
    """Look at the first bytes of a scene's file alone: a wrong one is found before anything is loaded.

    Returns the format of packed splats or of another program's, None of a PLY.

    Raises:
        TronError: it cannot be opened, is no PLY of Gaussians as far as its header tells, or is shorter than
            the header says.
    """
    refuse_placeholder(path)
    other = FORMATS.get(path.suffix.lower())
    if other is not None:
        refuse_foreign(path)
        other.check(path)
        return other
    try:
        with open(path, "rb") as stream:
            packed = packing(path, stream.read(_HEADER_LIMIT))
        if packed in PACKED_SPLATS.values():
            return packed
        if is_gzipped(path):
            head, size = beginning(path, _HEADER_LIMIT), largest(path)
        else:
            with open(path, "rb") as stream:
                head, size = stream.read(_HEADER_LIMIT), os.fstat(stream.fileno()).st_size
    except OSError as error:
        raise TronError(f"cannot read: {error.strerror or error}", path) from error
    if not head.startswith(b"ply"):
        refuse_foreign(path)
        raise TronError("not a PLY file", path, _EXPORT)
    _check_sizes(head, size, path)
    return packed


def header_comments(path: Path) -> list[str]:
    """Comments of a PLY's header; none where the file is not there or no PLY."""
    return [line[len("comment ") :].rstrip() for line in _header(path) if line.startswith("comment ")]


def header_elements(path: Path) -> set[str]:
    """Names of the elements of a PLY; none where the file is not there or no PLY."""
    return {line.split()[1] for line in _header(path) if line.startswith("element ")}


def _header(path: Path) -> list[str]:
    try:
        with path.open("rb") as file:
            header, end, _ = file.read(_HEADER_LIMIT).decode("ascii", "replace").partition("end_header")
    except OSError:
        return []
    return header.splitlines() if end else []


def _parsed(path: Path, packed: Packing | None) -> tuple[dict[str, np.ndarray], list[str]]:
    """Columns of the vertex element, and comments of the header."""
    try:
        if packed is None and not is_gzipped(path):
            data = plyfile.PlyData.read(str(path))
            return {each.name: data["vertex"][each.name] for each in data["vertex"].properties}, data.comments
        content = whole(path) if packed is None else unpacked(path, packed)
        _check_sizes(content[:_HEADER_LIMIT], len(content), path)
        return columns_in(content)
    except OSError as error:
        raise TronError(f"cannot read: {error.strerror or error}", path) from error
    except (plyfile.PlyParseError, ValueError) as error:  # ValueError: text that is no number
        raise TronError(f"not a readable PLY: {error}", path) from error


def _columns(splats: Splats) -> dict[str, np.ndarray]:
    """By the names of 3DGS' properties."""
    rest = splats.sh[:, 1:].transpose(0, 2, 1).reshape(len(splats.sh), -1).T
    return {
        **dict(zip(FIELDS["means"].properties, splats.means.T)),
        **dict(zip(FIELDS["sh"].properties, splats.sh[:, 0].T)),
        **dict(zip(REST, rest)),
        "opacity": splats.opacity_logits,
        **dict(zip((*FIELDS["log_scales"].properties, THIRD_SCALE), splats.log_scales.T)),
        **dict(zip(FIELDS["quats"].properties, splats.quats.T)),
    }


def _filtered(columns: dict[str, np.ndarray], scales: Sequence[str], path: Path) -> dict[str, np.ndarray]:
    """The columns with the 3D smoothing filter in scales and opacity."""
    log_scales = np.stack([columns[name] for name in scales], axis=-1)
    widened, logits = smoothed(log_scales, columns["opacity"], columns[FILTER])
    before, after = (float(np.nanmedian(expit(each))) for each in (columns["opacity"], logits))
    log.log(
        logging.INFO if after >= _VISIBLE else logging.WARNING,
        "%s: %s of Mip-Splatting is taken into scales and opacities, whose median goes from %.2g to %.2g%s",
        path, FILTER, before, after, "" if after >= _VISIBLE else ": most splats cannot be seen",
    )  # fmt: skip
    return columns | dict(zip(scales, widened.T)) | {"opacity": logits}


def _about_local_origin(columns: Mapping[str, np.ndarray], path: Path) -> tuple[np.ndarray, np.ndarray]:
    """(M, 3) float32 positions about a local origin, and the (3,) float64 offset that was taken away."""
    stored = [columns[axis] for axis in FIELDS["means"].properties]
    positions = np.stack(stored, axis=-1).astype(np.float64)
    wide = float(np.median(np.exp(np.asarray(columns["scale_0"], np.float64))))
    offset = local_origin(positions, _COARSE * wide)
    if offset.any():
        log.info("%s: large coordinates: %s is taken away from them and kept", path, said(offset))
        step = max(float(np.spacing(np.abs(each).max())) for each in stored)
        if step > _COARSE * wide:
            log.warning(
                "%s: its positions are stored in steps of %.2g, its splats are %.2g wide: surfaces fall into "
                "slices; export it with positions in doubles or about a local origin", path, step, wide,
            )  # fmt: skip
    return (positions - offset).astype(np.float32), offset


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


def _read_constants(comments: list[str], path: Path) -> dict[str, list[float]]:
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


def _projection(
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


def _check_sizes(head: bytes, size: int, path: Path) -> None:
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
        raise TronError("the PLY has no vertex element", path, _EXPORT)
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


def _check_properties(columns: dict[str, np.ndarray], comments: Sequence[str], path: Path) -> None:
    foreign = ", ".join(foreign_kernels(columns, comments))
    missing = [name for name in REQUIRED if name not in columns]
    if missing:
        made = f"made for {foreign}: export it as plain 3DGS" if foreign else _EXPORT
        raise TronError(f"the PLY lacks {', '.join(missing)}", path, made)
    read = (*REQUIRED, *REST, *MATERIAL_PROPERTIES, THIRD_SCALE, FILTER, "object_id")
    for name, values in columns.items():
        if values.dtype == object and name in read:
            raise TronError(f"property {name} is a list", path, _EXPORT)
    if foreign:
        log.warning("%s: %s: %s", path, NOT_READ, foreign)
    present = [name for name in MATERIAL_PROPERTIES if name in columns]
    if present and len(present) < len(MATERIAL_PROPERTIES):
        absent = ", ".join(name for name in MATERIAL_PROPERTIES if name not in columns)
        raise TronError(f"the PLY has {present[0]} but lacks {absent}", path, "write all materials or none")


def _guess(sh: np.ndarray) -> dict[str, np.ndarray]:
    """Materials of Gaussians known by colour alone."""
    return {
        "base_color": srgb_to_linear(np.clip(dc_to_rgb(sh[:, 0]), 0, 1)),
        "roughness": np.full(len(sh), GUESSED_ROUGHNESS),
        "metallic": np.full(len(sh), GUESSED_METALLIC),
    }


def _harmonics(
    columns: dict[str, np.ndarray], stack: Callable[[Sequence[str]], np.ndarray], path: Path
) -> np.ndarray:
    """(M, 16, 3) coefficients; degrees that the file does not have are zero."""
    dc = stack(FIELDS["sh"].properties)
    sh = np.zeros((len(dc), SH_COUNT, 3), np.float32)
    sh[:, 0] = dc
    count = sum(name.startswith("f_rest_") for name in columns)
    if count not in (0, 9, 24, 45) or any(name not in columns for name in REST[:count]):
        raise TronError(f"the PLY has {count} f_rest properties", path, "degrees 0 to 3 have 0, 9, 24 or 45")
    bands = count // 3
    if bands:
        sh[:, 1 : 1 + bands] = stack(REST[: 3 * bands]).reshape(len(dc), 3, bands).transpose(0, 2, 1)
    return sh


def _object_id(columns: dict[str, np.ndarray], count: int, path: Path) -> np.ndarray:
    if "object_id" not in columns:
        return np.zeros(count, np.int32)
    values = np.asarray(columns["object_id"], dtype=np.float64)
    whole = np.abs(values) < 2**31
    if not whole.all():
        raise TronError(f"object_id of surfel {int((~whole).argmax())} is no 32-bit number", path)
    return values.astype(np.int32)
