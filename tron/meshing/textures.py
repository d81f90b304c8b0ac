"""Textures of a mesh from surfels, by rays onto the surface from just outside.

xatlas lays the triangles out flat, Mitsuba finds which one covers a texel, and the tracer composites the
surfels along the normal there, as a camera would see them.

xatlas cannot tell how far it has come, and takes longer than in proportion to the triangles. So it cuts the
mesh piece by piece, and packs what it has cut of all: of a scan's 56,000 triangles 1,023 charts in 8 s of
processor time, where it took 34 s for 1,870 of the whole; texels are as fine.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from tron.meshing.surface import Triangles
from tron.models.parts import Part
from tron.runtime import lanes
from tron.tracing.tracer import SurfelTracer

PADDING = 4
"""Texels around the pieces of an atlas."""
_OPAQUE = 0.1
_HEIGHT = 2.0
"""Voxels above the surface from which it is looked at."""
_AT_ONCE = 1 << 16
"""Texels whose rays go together, which are a step of progress."""
_PIECE = 4000
"""Triangles that are cut into charts together, at most."""

Track = Callable[[Sequence[Any], str], Iterable[Any]]


def textured(
    tracer: SurfelTracer, surface: Triangles, size: int, track: Track = lambda items, _: items
) -> Part:
    """The mesh with base color, roughness and metallic of the surfels in one texture.

    Args:
        tracer: the scene. Surfels whose normals have no sign are turned the way that the surface looks.
        surface: of it, by :func:`tron.meshing.surface.surface_of`.
        size: texels a side.
        track: wraps the loops over pieces and texels, each with its label, to show progress.
    """
    vertices, normals, faces, voxel = surface
    height = _HEIGHT * voxel
    if not tracer.scene.oriented:
        nearest = KDTree(vertices).query(tracer.scene.means)[1]
        tracer = tracer.turned_over((tracer.scene.normals() * normals[nearest]).sum(1) < 0)
    origin, faces, uv = _unwrapped(vertices, normals, faces, size, track)
    vertices, normals = vertices[origin], normals[origin]
    flat = _flat(faces, uv)
    base_color, roughness, metallic = np.zeros((size, size, 3), np.float32), *np.zeros((2, size, size))
    emission = np.zeros_like(base_color) if tracer.scene.emission.any() else None
    known = np.zeros((size, size), bool)
    for start in track(range(0, size, max(1, _AT_ONCE // size)), "textures"):
        at, place, normal = _texels(flat, vertices, normals, faces, size, start)
        if not len(place):
            continue
        along = lanes(mi.Vector3f, -normal)
        seen = tracer.trace(lanes(mi.Point3f, place + height * normal), along)
        dr.eval(seen)
        known[at] = np.array(seen.opacity) > _OPAQUE
        base_color[at] = np.array(seen.base_color).T
        roughness[at], metallic[at] = np.array(seen.roughness), np.array(seen.metallic)
        if emission is not None:
            emission[at] = np.array(seen.emission).T
    # What nothing covers has the nearest texel that something does, so that no lookup mixes in black.
    texel = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    assert isinstance(texel, np.ndarray)
    row, column = texel
    base_color, roughness, metallic = (each[row, column] for each in (base_color, roughness, metallic))
    return Part(
        vertices=vertices, normals=normals, faces=faces.astype(np.int64), uv=uv,
        base_color=np.clip(base_color, 0, 1), roughness=np.clip(roughness, 0, 1),
        metallic=np.clip(metallic, 0, 1), normal_map=None,
        emission=None if emission is None else emission[row, column],
    )  # fmt: skip


def _unwrapped(
    vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray, size: int, track: Track
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A mesh laid out flat, in charts that do not overlap.

    Returns (N,) which of the vertices each of the new ones is, (F, 3) faces of new ones, in another order,
    and (N, 2) float32 uv in [0, 1].
    """
    import xatlas

    charts = []
    for piece in track(_pieces(vertices[faces].mean(1), np.arange(len(faces))), "cutting the surface"):
        used, own = np.unique(faces[piece], return_inverse=True)
        atlas, options = xatlas.Atlas(), xatlas.PackOptions()
        options.padding = 1  # charts that touch would be one when they are packed
        own = own.reshape(-1, 3).astype(np.uint32)
        atlas.add_mesh(vertices[used].astype(np.float32), own, normals[used].astype(np.float32))
        atlas.generate(pack_options=options)
        origin, cut, uv = atlas[0]
        in_units = (
            uv * (atlas.width, atlas.height) / atlas.texels_per_unit
        )  # texels of one size in all pieces
        charts.append((used[origin], in_units.astype(np.float32), cut))
    first = _packed(charts, size, 0.0)  # roughly as large
    atlas = _packed(charts, 0, first.texels_per_unit * size / max(first.width, first.height))
    origins, new_faces, uvs, count = [], [], [], 0
    for number, (origin, _, _) in enumerate(charts):
        again, cut, uv = atlas[number]
        origins.append(origin[again])
        new_faces.append(cut.astype(np.int64) + count)
        uvs.append(uv)
        count += len(uv)
    return np.concatenate(origins), np.concatenate(new_faces), np.concatenate(uvs).astype(np.float32)


def _pieces(middles: np.ndarray, which: np.ndarray) -> list[np.ndarray]:
    """Triangles ``which``, by their middles (F, 3), halved along the longest axis until few are together."""
    if len(which) <= _PIECE:
        return [which]
    own = middles[which]
    ordered = which[np.argsort(own[:, np.ptp(own, axis=0).argmax()], kind="stable")]
    half = len(ordered) // 2
    return [*_pieces(middles, ordered[:half]), *_pieces(middles, ordered[half:])]


def _packed(charts: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]], size: int, density: float) -> Any:
    """An xatlas.Atlas of pieces that are cut: (origin, uv in world units, faces) each.

    Args:
        size: of its sides, roughly; 0: what it takes.
        density: texels a world unit; 0: what ``size`` allows.
    """
    import xatlas

    atlas, options = xatlas.Atlas(), xatlas.PackOptions()
    for _, uv, cut in charts:
        atlas.add_uv_mesh(uv, cut)
    options.resolution, options.texels_per_unit = size, density
    options.padding, options.bilinear = PADDING, True
    atlas.generate(pack_options=options)
    return atlas


def _flat(faces: np.ndarray, uv: np.ndarray) -> mi.Scene:
    """A mesh in its texture, at height 0."""
    flat = mi.Mesh("atlas", len(uv), len(faces))
    parameters = mi.traverse(flat)
    parameters["vertex_positions"] = np.pad(uv, ((0, 0), (0, 1))).astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    return mi.load_dict({"type": "scene", "atlas": flat})


def _texels(
    flat: mi.Scene, vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray, size: int, start: int
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray, np.ndarray]:
    """Texels that triangles cover, of some rows from ``start`` on.

    Returns their N rows and columns, places and unit normals (N, 3).
    """
    rows = np.arange(start, min(start + max(1, _AT_ONCE // size), size))
    row, column = (each.ravel() for each in np.meshgrid(rows, np.arange(size), indexing="ij"))
    at = np.stack([(column + 0.5) / size, (row + 0.5) / size, np.ones(len(row))], axis=-1)
    found = flat.ray_intersect_preliminary(
        mi.Ray3f(lanes(mi.Point3f, at), dr.tile(mi.Vector3f(0, 0, -1), len(at)))
    )
    covered = np.array(found.is_valid())
    corner = faces[np.array(found.prim_index)[covered]]
    b, c = np.array(found.prim_uv)[:, covered]
    weights = np.stack([1 - b - c, b, c], axis=1)
    place, normal = (np.einsum("nk,nkc->nc", weights, each[corner]) for each in (vertices, normals))
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    return (row[covered], column[covered]), place, normal
