"""Meshes beside surfels: one more occluder, and an opaque layer behind the surfels in front of it.

Camera rays are traced against the mesh first (Embree, OptiX). Where they meet it, surfels count up to that
distance, and the remaining transmittance T ends at the mesh, as at one more surfel of opacity 1:

    opacity    1                        where a mesh is met
    materials  (1 - T) surfels + T mesh     the same for normals and values
    position   of the surfels where T < 0.5, else of the mesh

Rays that leave a mesh leave it along its triangles' normal, not along the shading normal, which may look
below the triangle (the terminator problem).

Light bounces among surfels only. So a mesh gets stand-in surfels, spread evenly over it, which take part in
bounces; no camera ray and no shadow ray meets them.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import reduce
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import KDTree

from tron.errors import TronError
from tron.gaussians.edit import joined, moved
from tron.gaussians.scene import GaussianScene
from tron.models.shapes import Shape, emission_at, materials_at, surface_points, textured
from tron.runtime import aligned, lanes
from tron.tracing.gbuffer import GBuffer, tile_rays
from tron.tracing.surface import seen_normal
from tron.tracing.tracer import SurfelTracer

if TYPE_CHECKING:
    from tron.cameras import Camera
    from tron.models.parts import Part

STAND_INS = 20_000
"""Number of stand-in surfels of all meshes together, for bounced light."""
_REACH = 3.0
"""Spacings behind the mesh up to which its stand-ins count for a pixel."""
_COVERED = 0.5
Pose = tuple[np.ndarray, np.ndarray, np.ndarray]
"""A rotation (3, 3), the point (3,) that it keeps, and the shift (3,) after it, world."""


@dataclass
class MeshView(GBuffer):
    """A view with a mesh in it.

    Attributes:
        leaving: offset direction of rays that leave a pixel, world: the normal; on a mesh the triangle's
            normal, scaled by the mesh's clearance over the surfels'.
    """

    leaving: mi.Vector3f

    def raised(self, offset: mi.Float) -> mi.Point3f:
        """:meth:`Surface.raised`."""
        return mi.Point3f(dr.detach(self.position)) + dr.detach(self.leaving) * offset


@dataclass(frozen=True, eq=False)
class _Model:
    """One model at its place.

    Attributes:
        parts: its triangles, world. shapes: the same triangles as Mitsuba shapes.
        stand_ins: surfels on the triangles.
        nearest: (F,) uint32 the stand-in nearest to the middle of each triangle, part after part.
    """

    parts: tuple[Part, ...]
    shapes: tuple[Shape, ...]
    stand_ins: GaussianScene
    nearest: np.ndarray

    @classmethod
    def of(cls, parts: Sequence[Part], name: str, surfels: int, seed: int) -> _Model:
        from tron.models.sides import spacing_of, two_sided  # trimesh: needed for meshes only
        from tron.models.surfels import surfels_of_model

        if not sum(len(part.faces) for part in parts):
            raise TronError("a mesh has no triangles", mend="leave it out")
        shapes = tuple(textured(part, f"{name}-{number}") for number, part in enumerate(parts))
        sides = two_sided(parts)
        made = surfels_of_model(sides, spacing_of(sides, surfels), seed=seed)
        made = replace(made, means=_onto(shapes, made))
        if len(sides) > len(parts):
            backs = [textured(part, f"back{n}") for n, part in enumerate(sides[len(parts) :])]
            made = replace(made, means=_onto(backs, made))
        middles = np.concatenate([part.vertices[part.faces].mean(axis=1) for part in parts])
        nearest = KDTree(made.means).query(middles)[1].astype(np.uint32)
        return cls(tuple(parts), shapes, made, nearest)

    def moved(self, pose: Pose) -> _Model:
        rotation, pivot, shift = pose
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation, pivot + shift - rotation @ pivot
        parts = tuple(part.moved(matrix) for part in self.parts)
        shapes = tuple(shape.elsewhere(part) for shape, part in zip(self.shapes, parts))
        every = np.ones(len(self.stand_ins), bool)
        stand_ins = moved(self.stand_ins, every, rotation, shift, pivot)
        return _Model(parts, shapes, stand_ins, self.nearest)


class Meshes:
    """Opaque models in the world of a scene.

    Args:
        models: the parts of each (:func:`tron.models.load.load_model`), placed in the world, world units.
        seed: root of the random numbers that place the stand-ins.

    Attributes:
        stand_ins: surfels on the models' surface, for bounced light.

    Raises:
        TronError: a model has no triangles.
    """

    def __init__(self, models: Sequence[Sequence[Part]], seed: int = 0) -> None:
        surfels = STAND_INS // len(models)
        self._stand([_Model.of(parts, f"mesh{k}", surfels, seed) for k, parts in enumerate(models)])

    def __len__(self) -> int:
        return len(self._models)

    def _stand(self, models: Sequence[_Model]) -> None:
        self._models = models
        self._shapes = [shape for model in models for shape in model.shapes]
        self._scene = _scene_of(self._shapes)
        self.stand_ins = reduce(joined, [model.stand_ins for model in models])
        ends = np.cumsum([len(model.stand_ins) for model in models])
        nearest = [model.nearest + end - len(model.stand_ins) for model, end in zip(models, ends)]
        self._nearest = mi.UInt32(aligned(np.concatenate(nearest).astype(np.uint32)))
        self._tracer = SurfelTracer(self.stand_ins)

    def moved(self, poses: Sequence[Pose | None]) -> Meshes:
        """The models at new places: for each a pose relative to its present place; None: unmoved."""
        other = copy(self)
        other._stand(
            [model if pose is None else model.moved(pose) for model, pose in zip(self._models, poses)]
        )
        return other

    def blocked(self, origin: mi.Point3f, direction: mi.Vector3f, active: mi.Bool) -> mi.Bool:
        """Whether a mesh blocks rays from ``origin`` along unit ``direction``."""
        return self._scene.ray_test(mi.Ray3f(origin, direction), active)

    def seen(self, camera: Camera, spacing: float) -> MeshLayer:
        """Trace the meshes for a camera.

        Args:
            camera: the view.
            spacing: of the scene's surfels, world units; it sets the offset of rays that leave surfaces.
        """
        rays = tile_rays(camera)
        si, shading = surface_points(
            self._shapes, self._scene, mi.Ray3f(rays.origin, rays.direction), rays.inside
        )
        met = si.is_valid()
        base_color, roughness, metallic = materials_at(self._shapes, si)
        normal = mi.Normal3f(dr.select(met, seen_normal(mi.Vector3f(shading), rays.direction), 0))
        side = dr.select(dr.dot(si.n, rays.direction) > 0, -si.n, si.n)
        clearance = dr.opaque(mi.Float, min(1.0, self.stand_ins.spacing / spacing))
        face, first = mi.UInt32(si.prim_index), 0
        for each in self._shapes:
            here = si.shape == mi.ShapePtr(each.shape)
            face = dr.select(here, si.prim_index + dr.opaque(mi.UInt32, first), face)
            first += each.shape.face_count()
        layer = MeshLayer(
            met=met,
            depth=dr.select(met, si.t, 0),
            position=mi.Point3f(dr.select(met, si.p, 0)),
            normal=normal,
            leaving=mi.Vector3f(dr.select(met, side * clearance, 0)),
            base_color=mi.Color3f(dr.clip(base_color, 0, 1)),
            roughness=dr.clip(roughness, 0, 1),
            metallic=dr.clip(metallic, 0, 1),
            face=face,
            emission=emission_at(self._shapes, si),
        )
        dr.eval(layer)
        return layer

    def values_at(self, camera: Camera, layer: MeshLayer, values: Sequence[mi.Float]) -> list[mi.Float]:
        """Values of the stand-ins at the meshes' pixels.

        They are composited like those of a scene's surfels; in a hole between stand-ins, the value of the one
        nearest to the triangle.
        """
        if not values:
            return []
        reach = dr.opaque(mi.Float, _REACH * self.stand_ins.spacing)
        limit = dr.select(layer.met, layer.depth + reach, -1)
        dr.eval(limit)
        covering = self._tracer.gbuffer(camera, values, limit)
        held = covering.opacity > _COVERED
        nearest = dr.gather(mi.UInt32, self._nearest, layer.face, layer.met & ~held)
        return [
            dr.select(held, composited, dr.gather(mi.Float, value, nearest, layer.met & ~held))
            for composited, value in zip(covering.values, values, strict=True)
        ]


@dataclass
class MeshLayer:
    """The mesh surface that each camera ray meets, in tile order; 0 where it meets none.

    Attributes:
        met: mi.Bool, whether the ray meets a mesh.
        depth: along the unit ray, world units. position: world.
        normal: unit shading normal that faces the ray. leaving: as in :class:`MeshView`.
        base_color, roughness, metallic: of the material there, linear.
        face: mi.UInt32, number of the triangle, counted over all parts.
        emission: linear radiance emitted towards the ray; None if no mesh glows.
    """

    met: mi.Bool
    depth: mi.Float
    position: mi.Point3f
    normal: mi.Normal3f
    leaving: mi.Vector3f
    base_color: mi.Color3f
    roughness: mi.Float
    metallic: mi.Float
    face: mi.UInt32
    emission: mi.Color3f | None

    @property
    def limit(self) -> mi.Float:
        """Distance beyond which no surfel is seen."""
        limit = dr.select(self.met, self.depth, dr.inf)
        dr.eval(limit)
        return limit

    def behind(self, surfels: GBuffer, values: Sequence[mi.Float]) -> MeshView:
        """Composite surfels, traced up to :attr:`limit`, over the meshes behind them.

        ``values``: the meshes' counterpart of the surfels' ``values``.
        """
        share = dr.select(self.met, 1 - surfels.opacity, 0)

        def mixed(front: mi.Float, back: mi.Float) -> mi.Float:
            return dr.select(self.met, dr.fma(share, back - front, front), front)

        own = self.met & ~(surfels.depth > 0)
        normal = mi.Vector3f(surfels.normal) * (1 - share) + mi.Vector3f(self.normal) * share
        length = dr.norm(normal)
        normal = dr.select(self.met & (length > 0), normal / dr.select(length > 0, length, 1), surfels.normal)
        colors = zip(surfels.base_color, self.base_color, strict=True)
        emission = None
        if surfels.emission is not None or self.emission is not None:
            glows = [mi.Color3f(0) if each is None else each for each in (surfels.emission, self.emission)]
            emission = mi.Color3f(*[mixed(front, back) for front, back in zip(*glows, strict=True)])
        view = MeshView(
            position=mi.Point3f(dr.select(own, self.position, surfels.position)),
            depth=dr.select(own, self.depth, surfels.depth),
            lift=dr.select(own, 0, surfels.lift),
            normal=mi.Normal3f(normal),
            normal_sum=mi.Normal3f(surfels.normal_sum + mi.Vector3f(self.normal) * share),
            base_color=mi.Color3f(*[mixed(front, back) for front, back in colors]),
            roughness=mixed(surfels.roughness, self.roughness),
            metallic=mixed(surfels.metallic, self.metallic),
            rgb=surfels.rgb,
            opacity=dr.select(self.met, 1, surfels.opacity),
            direction=surfels.direction,
            values=[mixed(front, back) for front, back in zip(surfels.values, values, strict=True)],
            emission=emission,
            leaving=dr.select(own, self.leaving, normal),
            width=surfels.width,
            height=surfels.height,
        )
        dr.eval(view)
        return view


def _scene_of(shapes: Sequence[Shape]) -> mi.Scene:
    """A Mitsuba scene without light, for ray intersection."""
    return mi.load_dict({"type": "scene"} | {f"mesh{i}": each.shape for i, each in enumerate(shapes)})


def _onto(shapes: Sequence[Shape], surfels: GaussianScene) -> np.ndarray:
    """Project centres (M, 3) onto the triangles: a mean of points on a bent surface lies beneath it."""
    reach, normals = 2 * surfels.spacing, surfels.normals()
    start, along = surfels.means + 0.5 * reach * normals, lanes(mi.Vector3f, -normals)
    ray = mi.Ray3f(lanes(mi.Point3f, start), along)
    ray.maxt = mi.Float(reach)
    si = _scene_of(shapes).ray_intersect(ray)
    met = np.array(si.is_valid() & (dr.dot(si.n, along) < 0))
    return np.where(met[:, None], np.array(si.p).T, surfels.means).astype(np.float32)
