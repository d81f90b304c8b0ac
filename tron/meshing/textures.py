"""Textures of a mesh from surfels: what rays meet that look at the surface from just outside.

xatlas lays the triangles out flat, Mitsuba finds which one covers a texel, and the tracer composites the
surfels along the normal there, as a camera would see them.
"""

from __future__ import annotations

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
_AT_ONCE = 1 << 20


def textured(tracer: SurfelTracer, surface: Triangles, size: int) -> Part:
    """The mesh with base color, roughness and metallic of the surfels in one texture.

    Args:
        tracer: the scene. Surfels whose normals have no sign are turned the way that the surface looks.
        surface: of it, by :func:`tron.meshing.surface.surface_of`.
        size: texels a side.
    """
    import xatlas

    vertices, normals, faces, voxel = surface
    height = _HEIGHT * voxel
    if not tracer.scene.oriented:
        nearest = KDTree(vertices).query(tracer.scene.means)[1]
        tracer = tracer.turned_over((tracer.scene.normals() * normals[nearest]).sum(1) < 0)
    atlas = xatlas.Atlas()
    atlas.add_mesh(vertices.astype(np.float32), faces.astype(np.uint32), normals.astype(np.float32))
    packing = xatlas.PackOptions()
    packing.resolution, packing.padding, packing.bilinear = size, PADDING, True
    atlas.generate(pack_options=packing)
    origin, faces, uv = atlas[0]
    vertices, normals = vertices[origin], normals[origin]
    place, normal, covered = _texels(vertices, normals, faces, uv, size)
    base_color, roughness, metallic = np.zeros((size, size, 3), np.float32), *np.zeros((2, size, size))
    known = np.zeros((size, size), bool)
    rows, columns = np.nonzero(covered)
    for start in range(0, len(rows), _AT_ONCE):
        at = rows[start : start + _AT_ONCE], columns[start : start + _AT_ONCE]
        along = lanes(mi.Vector3f, -normal[at])
        seen = tracer.trace(lanes(mi.Point3f, place[at] + height * normal[at]), along)
        dr.eval(seen)
        known[at] = np.array(seen.opacity) > _OPAQUE
        base_color[at] = np.array(seen.base_color).T
        roughness[at], metallic[at] = np.array(seen.roughness), np.array(seen.metallic)
    # What nothing covers has the nearest texel that something does, so that no lookup mixes in black.
    texel = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    assert isinstance(texel, np.ndarray)
    row, column = texel
    base_color, roughness, metallic = (each[row, column] for each in (base_color, roughness, metallic))
    return Part(
        vertices=vertices, normals=normals, faces=faces.astype(np.int64), uv=uv.astype(np.float32),
        base_color=np.clip(base_color, 0, 1), roughness=np.clip(roughness, 0, 1),
        metallic=np.clip(metallic, 0, 1), normal_map=None,
    )  # fmt: skip


def _texels(
    vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray, uv: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places and unit normals (size, size, 3) of the texels, and which of them triangles cover."""
    flat = mi.Mesh("atlas", len(uv), len(faces))
    parameters = mi.traverse(flat)
    parameters["vertex_positions"] = np.pad(uv, ((0, 0), (0, 1))).astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    scene = mi.load_dict({"type": "scene", "atlas": flat})
    middle = (np.arange(size) + 0.5) / size
    at = np.stack([*np.meshgrid(middle, middle), np.ones((size, size))], axis=-1).reshape(-1, 3)
    found = scene.ray_intersect_preliminary(
        mi.Ray3f(lanes(mi.Point3f, at), dr.tile(mi.Vector3f(0, 0, -1), len(at)))
    )
    covered = np.array(found.is_valid())
    corner = faces[np.where(covered, np.array(found.prim_index), 0)]
    b, c = np.array(found.prim_uv)
    weights = np.stack([1 - b - c, b, c], axis=1)
    place, normal = (np.einsum("nk,nkc->nc", weights, each[corner]) for each in (vertices, normals))
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    grid = (size, size)
    return place.reshape(*grid, 3), normal.reshape(*grid, 3), covered.reshape(grid)
