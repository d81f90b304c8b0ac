"""Peers for single rays: Mitsuba's ray queries (Embree on a CPU, OptiX on a GPU) on quads around the surfels.

A quad is the square around the part of a surfel's ellipse that counts. One any hit is the least that a tracer
of triangles spends on a shadow ray, and it is not what the surfels need: it ignores opacity and sides, and
stops at corners of quads that the ellipse does not reach, mostly at the surface that the ray leaves. Mitsuba
and Dr.Jit offer no program to be run at each hit, so whoever wants all hits along a ray starts the query
again behind each: :class:`RestartedShadows`.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.cameras import Camera
from tron.gaussians.scene import GaussianScene
from tron.tracing.kernel import GEOMETRY_PACKETS, intersect
from tron.tracing.parameters import SurfelParameters, pack
from tron.tracing.tiles import TILE
from tron.tracing.transmittance import OPAQUE_TRANSMITTANCE, BackFaces, blocks

RESTART_OFFSET = 1e-4
"""Distance behind a hit at which the next query starts, world units; Mitsuba's volprim uses it too."""
MAX_RESTARTS = 512


def quads(scene: GaussianScene) -> mi.Scene:
    """Two triangles a surfel, 2 k and 2 k + 1 for surfel k, in a Mitsuba scene, its hierarchy built."""
    geometry = pack(SurfelParameters.from_scene(scene)).geometry
    # The twelfth float of a surfel's record is the squared radius that counts, in sigmas.
    reach = np.sqrt(np.maximum(np.array(geometry).reshape(len(scene), 4 * GEOMETRY_PACKETS)[:, 11], 0.0))
    tangent_u, tangent_v = scene.tangents()
    scales = scene.scales() * reach[:, None]
    a, b = tangent_u * scales[:, :1], tangent_v * scales[:, 1:]
    corners = scene.means[:, None] + np.stack([-a - b, a - b, a + b, b - a], 1)
    first = 4 * np.arange(len(scene))[:, None, None]
    faces = first + np.array([[0, 1, 2], [0, 2, 3]])
    mesh = mi.Mesh("quads", 4 * len(scene), 2 * len(scene))
    values = mi.traverse(mesh)
    values["vertex_positions"] = np.ascontiguousarray(corners, np.float32).ravel()
    values["faces"] = faces.astype(np.uint32).ravel()
    values.update()
    return mi.load_dict({"type": "scene", "quads": mesh})


def tile_rays(view: Camera) -> tuple[mi.Point3f, mi.Vector3f]:
    """Rays through the pixel centres, a 4 x 4 tile after the other: the order that is best for a packet."""
    tiles = view.rays().reshape(view.height // TILE, TILE, view.width // TILE, TILE, 3)
    rays = np.ascontiguousarray(tiles.transpose(0, 2, 1, 3, 4).reshape(-1, 3).T, np.float32)
    origin = dr.repeat(mi.Point3f([float(x) for x in view.position]), rays.shape[1])
    direction = mi.Vector3f(rays)
    dr.eval(origin, direction)
    return origin, direction


def closest_hit(
    scene: mi.Scene,
    origin: mi.Point3f,
    direction: mi.Vector3f,
    active: mi.Bool | bool = True,
    coherent: bool = False,
) -> mi.Float:
    """Distance of the nearest quad along each ray, infinite where there is none."""
    ray, flags = mi.Ray3f(origin, direction), (mi.Bool(coherent), mi.Bool(active))
    return scene.ray_intersect_preliminary(ray, *flags).t


def any_hit(
    scene: mi.Scene, origin: mi.Point3f, direction: mi.Vector3f, active: mi.Bool | bool = True
) -> mi.Bool:
    """Whether a quad lies anywhere along each ray."""
    return scene.ray_test(mi.Ray3f(origin, direction), coherent=mi.Bool(False), active=mi.Bool(active))


class RestartedShadows:
    """Transmittance by restarted closest-hit queries, under TRON's rules as far as restarts can follow them.

    Front faces count from the origin, back faces beyond two spacings, a ray ends below 0.01. Surfels that lie
    within ``RESTART_OFFSET`` behind another hit are skipped: that is what restarting loses.
    """

    def __init__(self, scene: GaussianScene, traced: mi.Scene) -> None:
        self._traced = traced
        records = pack(SurfelParameters.from_scene(scene))
        self._geometry = records.geometry
        self._degree = scene.kernel_degree
        self._back_faces = BackFaces.of(records, scene.spacing)
        dr.eval(self._geometry)

    @dr.syntax
    def transmittance(self, origin: mi.Point3f, direction: mi.Vector3f) -> mi.Float:
        """Product of (1 - alpha) over what blocks each ray; exactly 0 below 0.01."""
        product, travelled, queries = mi.Float(1), mi.Float(0), mi.UInt32(0)
        going = mi.Bool(True)
        while going:
            ray = mi.Ray3f(origin + travelled * direction, direction)
            found = self._traced.ray_intersect_preliminary(ray, coherent=mi.Bool(False), active=going)
            going &= found.is_valid()
            surfel = dr.select(going, found.prim_index >> 1, 0)
            hit = intersect(self._geometry, surfel, origin, direction, self._degree)
            counts = going & blocks(hit, self._back_faces)
            product = dr.select(counts, product * (1 - hit.alpha), product)
            travelled = dr.select(going, travelled + found.t + RESTART_OFFSET, travelled)
            queries += 1
            going &= (product >= OPAQUE_TRANSMITTANCE) & (queries < MAX_RESTARTS)
        return dr.select(product >= OPAQUE_TRANSMITTANCE, product, 0)
