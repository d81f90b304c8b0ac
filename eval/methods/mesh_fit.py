"""Fit materials and light of a mesh to photos by Mitsuba, and path-trace the mesh under new lights.

This is what an engineer would do today without Gaussians. The mesh is the surface of the capture: depths of
many views are fused, then meshed by marching cubes (:mod:`tron.meshing.surface`). The depths and the initial
colours come from TRON's own reconstruction; no material and no light of ours is used. Base color, roughness
and metallic are stored at the vertices, which are as dense as the grid, so there is no atlas whose seams
would hinder smoothing. They are fitted together with a lat-long light by Mitsuba's ``prb`` (path replay
backpropagation, Vicini et al. 2021) and Adam; ``path`` renders the mesh under other lights, and Intel's Open
Image Denoise filters the frames.
"""

# pyright: reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false
# pyright: reportIndexIssue=false
from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from pydantic import BaseModel, ConfigDict, Field, NonNegativeFloat, PositiveFloat, PositiveInt
from scipy.spatial import KDTree

from tron.brdf.bsdf import metallic_roughness
from tron.cameras import Camera, mitsuba_sensor
from tron.captures import Capture, View
from tron.captures.view import CLIPPED, decoded, linear_light
from tron.color import luminance
from tron.denoising import denoised
from tron.errors import TronError
from tron.gaussians.harmonics import SH_C0
from tron.gaussians.scene import GaussianScene
from tron.meshing.surface import SIDE, VIEWS, surface_of
from tron.models.shapes import flat, mitsuba_mesh
from tron.runtime import aligned, lanes
from tron.seeds import generator, integer
from tron.shading.environments.environment import EnvironmentMap
from tron.tracing.tracer import SurfelTracer
from tron.trajectories import film_with

Track = Callable[[Iterable[Any], str], Iterable[Any]]

COVERED = 0.999
"""Coverage from which a photo's pixel shows nothing but surfaces."""
DENOISER = "oidn"
"""Of the frames."""
BOUNCES = 4
"""Of a rendered frame's light between surfaces, as the truth has."""
MATERIALS = {"base_color": 3, "roughness": 1, "metallic": 1}
"""What is fitted at the vertices -> its channels."""
RANGES = {"base_color": (0.01, 1.0), "roughness": (0.05, 1.0), "metallic": (0.0, 1.0)}
MOST_TRIANGLES = 2_000_000
"""Of the surface: it is as fine as its grid, so that patterns on flat ground have vertices too."""
_NEAR = 4
"""Surfels whose mean colour a vertex begins with."""
_FLOOR = 0.05
"""Added to what errors are relative to; 1 is the photos' white. Darker pixels hold noise and few bits."""
_BRIGHT = 0.5
"""Base color that the brightest twentieth of the photos begins with."""
_EDGE = 0.02
"""Step between two vertices from which smoothness is linear, not quadratic: edges stay."""


class MeshSettings(BaseModel):
    """Settings of mesh and fit; defaults were chosen on development scenes (dev/LOG.md, 2026-11-27)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    voxels: PositiveInt = Field(default=128, description="voxels of the mesh's grid along its longest side")
    light_height: PositiveInt = Field(default=32, description="rows of the fitted light")
    steps: PositiveInt = Field(default=150, description="steps of Adam, one photo each")
    spp: PositiveInt = Field(default=8, description="samples per pixel of a step, and again of its gradient")
    bounces: PositiveInt = Field(default=1, description="bounces of light between surfaces in the fit")
    color_rate: PositiveFloat = Field(default=0.03, description="learning rate of base color")
    surface_rate: PositiveFloat = Field(default=0.03, description="learning rate of roughness and metallic")
    light_rate: PositiveFloat = Field(default=0.05, description="learning rate of the logarithm of the light")
    smooth_color: NonNegativeFloat = Field(
        default=0.02, description="smoothing weight of base color at edges"
    )
    smooth_surface: NonNegativeFloat = Field(default=0.02, description="smoothing of roughness and metallic")
    smooth_light: NonNegativeFloat = Field(
        default=0.002, description="smoothing weight of the light's logarithm"
    )
    plain: NonNegativeFloat = Field(
        default=0.01, description="weight that pulls metallic to 0 and roughness to its initial value"
    )
    frame_spp: PositiveInt = Field(default=64, description="samples per pixel of a frame under a new light")


@dataclass(frozen=True, eq=False)
class PaintedMesh:
    """Triangles with materials at their vertices.

    Attributes:
        vertices, normals: (V, 3) world; unit normals point outside.
        faces: (F, 3) int32.
        base_color: (V, 3) linear.
        roughness, metallic: (V,).
    """

    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    base_color: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray

    def lit(self, light: EnvironmentMap) -> mi.Scene:
        """Return the mesh under a light, two-sided, with the material of :mod:`tron.brdf`."""
        attributes = {name: {"type": "mesh_attribute", "name": f"vertex_{name}"} for name in MATERIALS}
        bsdf = {"type": "twosided", "bsdf": metallic_roughness(**attributes)}
        mesh = mitsuba_mesh("mesh", mi.load_dict(bsdf), self.vertices, self.normals, self.faces, None)
        for name, channels in MATERIALS.items():
            mesh.add_attribute(f"vertex_{name}", channels, flat(getattr(self, name)))
        return mi.load_dict({"type": "scene", "mesh": mesh, "light": light.to_mitsuba()})


@dataclass(frozen=True, eq=False)
class MeshFit:
    """A fitted mesh.

    Attributes:
        mesh: mesh with fitted materials.
        light: light of the photos, in their unit.
        seconds: time of meshing and fit, without making the surfels.
        losses: loss of every step.
    """

    mesh: PaintedMesh
    light: EnvironmentMap
    seconds: dict[str, float]
    losses: list[float]


def fit_mesh(
    capture: Capture, scene: GaussianScene, settings: MeshSettings, seed: int, track: Track
) -> MeshFit:
    """Make a mesh of a capture, and fit its materials and light to the training photos.

    Args:
        capture: photos with their cameras; if they have masks, only covered pixels count.
        scene: surfels of the capture in its world, z up; their depths and mean colours are used.
        settings: settings of mesh and fit.
        seed: seed of every random choice.
        track: progress wrapper of loops, with their labels.

    Raises:
        TronError: the views see no surface, or the photos show none of it.
    """
    started = time.perf_counter()
    mesh = plain_mesh(capture, scene, settings, track)
    meshed = time.perf_counter()
    fit = _Fit(mesh, capture, settings, seed)
    losses = [fit.step(number) for number in track(range(settings.steps), "materials and light")]
    seconds = {"mesh": meshed - started, "fit": time.perf_counter() - meshed}
    return MeshFit(fit.mesh(), fit.light(), seconds, losses)


def plain_mesh(capture: Capture, scene: GaussianScene, settings: MeshSettings, track: Track) -> PaintedMesh:
    """Return the mesh in the colours of the photos, dielectric, with medium roughness."""
    cameras = capture.train_cameras
    longer = max(max(camera.width, camera.height) for camera in cameras)
    surface = surface_of(
        SurfelTracer(scene.validate()), film_with(cameras, VIEWS, min(2 * longer, SIDE)),
        voxels=settings.voxels, triangles=MOST_TRIANGLES, track=lambda some: track(some, "depths"),
    )  # fmt: skip
    display = np.clip(SH_C0 * scene.sh[:, 0] + 0.5, 0, 1)
    shown = decoded(display, capture.tone_curve)
    shown = shown * (_BRIGHT / max(np.quantile(shown.max(axis=1), 0.95), 1e-6))
    near = KDTree(scene.means).query(surface.vertices, _NEAR)[1]
    count = len(surface.vertices)
    return PaintedMesh(
        surface.vertices, surface.normals, surface.faces,
        base_color=np.clip(shown[near].mean(axis=1), 0.02, 1.0).astype(np.float32),
        roughness=np.full(count, 0.6, np.float32), metallic=np.full(count, 0.02, np.float32),
    )  # fmt: skip


def lit_frames(
    mesh: PaintedMesh,
    cameras: Sequence[Camera],
    light: EnvironmentMap,
    spp: int,
    seeds: Sequence[int],
    background: bool = True,
) -> Iterator[np.ndarray]:
    """Path-trace and denoise a mesh under a light, one frame per camera.

    Args:
        mesh: mesh of a :class:`MeshFit`.
        cameras: cameras of the frames.
        light: the new light.
        spp: samples per pixel.
        seeds: one per frame.
        background: whether the light itself is seen behind the mesh; black otherwise.

    Yields:
        (H, W, 3) float32 linear radiance.
    """
    scene, depth = mesh.lit(light), BOUNCES + 2
    path = {"type": "path", "max_depth": depth, "rr_depth": depth, "hide_emitters": not background}
    integrator = mi.load_dict({"type": "aov", "aovs": "albedo:albedo", "img": path})
    for camera, seed in zip(cameras, seeds, strict=True):
        sensor = mi.load_dict(mitsuba_sensor(camera, spp))
        found = np.array(
            mi.render(scene, sensor=sensor, integrator=integrator, spp=spp, seed=mi.UInt32(seed))
        )
        guides = {"albedo": np.clip(found[..., -3:], 0, 1)}
        yield denoised(DENOISER, np.maximum(found[..., :3], 0), guides)


def surface_maps(mesh: PaintedMesh, cameras: Sequence[Camera]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield linear base color and unit world normals (H, W, 3) at pixel centres; 0 off the mesh."""
    scene = mesh.lit(EnvironmentMap.constant(1.0))
    for camera in cameras:
        along = camera.rays().reshape(-1, 3)
        hit = scene.ray_intersect(mi.Ray3f(mi.Point3f(*camera.position.tolist()), lanes(mi.Vector3f, along)))
        there, size = np.array(hit.is_valid())[:, None], (camera.height, camera.width, 3)
        color = hit.shape.eval_attribute_3("vertex_base_color", hit, hit.is_valid())
        seen, normal = (
            np.where(there, np.array(each).T, 0).reshape(size) for each in (color, hit.sh_frame.n)
        )
        yield seen, normal


@dataclass(frozen=True)
class _Photo:
    """Target of a step: linear radiance in the photos' unit, and the mask of pixels that count."""

    sensor: mi.Sensor
    light: mi.TensorXf
    weight: mi.TensorXf
    pixels: float


class _Fit:
    """Materials and light during the fit."""

    def __init__(self, mesh: PaintedMesh, capture: Capture, settings: MeshSettings, seed: int) -> None:
        self._mesh, self._settings, self._seed = mesh, settings, seed
        photos = (_photo(view, capture) for view in capture.train_views)
        self._photos = [photo for photo in photos if photo is not None]
        if not self._photos:
            raise TronError("no training photo shows a surface", mend="give photos whose masks cover pixels")
        height, width = settings.light_height, 2 * settings.light_height
        self._scene = mesh.lit(EnvironmentMap.constant(1.0, height))
        self._parameters = mi.traverse(self._scene)
        self._parameters.keep([*(f"mesh.vertex_{name}" for name in MATERIALS), "light.data"])
        depth = settings.bounces + 2
        self._integrator = mi.load_dict(
            {"type": "prb", "max_depth": depth, "rr_depth": depth, "hide_emitters": True}
        )
        # Mitsuba's maps repeat their first column behind the last.
        rows, columns = np.mgrid[:height, : width + 1]
        texel = (rows * width + columns % width)[..., None] * 3 + np.arange(3)
        self._wrapped, self._shape = mi.UInt32(aligned(texel.astype(np.uint32).ravel())), texel.shape
        edges = np.unique(np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
        self._edges = [mi.UInt32(aligned(end.astype(np.uint32))) for end in edges.T]
        begun = np.full((height, width, 3), np.log(self._first_light()), np.float32)
        # Texels at the poles are small.
        areas = np.sin((np.arange(height) + 0.5) * np.pi / height)[:, None, None]
        self._areas = mi.TensorXf(aligned(areas.astype(np.float32)))
        self._rates = {"base_color": settings.color_rate, "roughness": settings.surface_rate}
        self._rates |= {"metallic": settings.surface_rate, "light": settings.light_rate}
        # Gradients of a vertex are some 1e-8: Adam must not take them for none.
        self._optimizer = mi.ad.Adam(lr=settings.color_rate, beta_2=0.99, epsilon=1e-15)
        for name in MATERIALS:
            self._optimizer[name] = mi.Float(flat(getattr(mesh, name)))
        self._optimizer["light"] = mi.TensorXf(aligned(begun))
        self._order, self._queue = generator(seed, "mesh peer", "photos"), list[int]()

    def _first_light(self) -> float:
        """Return the constant radiance under which the mesh is as bright as the photos."""
        arrived, shown = np.zeros(3), np.zeros(3)
        for photo in self._photos[:: max(len(self._photos) // 8, 1)]:
            image = mi.render(self._scene, sensor=photo.sensor, integrator=self._integrator, spp=4)
            arrived += np.array(image * photo.weight).sum((0, 1))
            shown += np.array(photo.light * photo.weight).sum((0, 1))
        return max(float(luminance(shown) / max(luminance(arrived), 1e-12)), 1e-6)

    def _show(self) -> None:
        """Copy the values into Mitsuba's scene."""
        for name in MATERIALS:
            self._parameters[f"mesh.vertex_{name}"] = self._optimizer[name]
        self._parameters["light.data"] = self._around(dr.exp(self._optimizer["light"]))
        self._parameters.update()

    def _around(self, texels: mi.TensorXf) -> mi.TensorXf:
        return mi.TensorXf(dr.gather(mi.Float, texels.array, self._wrapped), self._shape)

    def step(self, number: int) -> float:
        """Fit to one photo; return the loss."""
        settings = self._settings
        if not self._queue:
            self._queue = self._order.permutation(len(self._photos)).tolist()
        photo = self._photos[self._queue.pop()]
        seeds = [integer(self._seed, "mesh peer", number, which) for which in ("paths", "gradient")]
        # Adam wanders by its rate: the last half of the steps goes down to a tenth of it.
        decay = 0.1 ** max(0.0, 2 * number / settings.steps - 1)
        self._optimizer.set_learning_rate({name: rate * decay for name, rate in self._rates.items()})
        self._show()
        image = mi.render(
            self._scene, self._parameters, sensor=photo.sensor, integrator=self._integrator, spp=settings.spp,
            seed=mi.UInt32(seeds[0]), seed_grad=mi.UInt32(seeds[1]),
        )  # fmt: skip
        # The photo alone says what an error counts, so that noise does not bias the gradient.
        error = (image - photo.light) / (photo.light + _FLOOR)
        loss = dr.sum(photo.weight * dr.square(error), axis=None) / photo.pixels
        dr.backward(loss + self._penalty())
        self._optimizer.step()
        for name, (low, high) in RANGES.items():
            self._optimizer[name] = dr.clip(dr.detach(self._optimizer[name]), low, high)
        return float(loss.array[0])

    def _penalty(self) -> Any:
        s, of = self._settings, self._optimizer
        found = s.smooth_color * self._steps(mi.Color3f, of["base_color"])
        for name in ("roughness", "metallic"):
            found += s.smooth_surface * self._steps(mi.Float, of[name])
        light = of["light"]
        around = self._around(light)
        beside = dr.square(around[:, 1:] - around[:, :-1]) * self._areas
        below = dr.square(light[1:] - light[:-1])
        found += s.smooth_light * (dr.mean(beside, axis=None).array + dr.mean(below, axis=None).array)
        plain = dr.mean(dr.square(of["roughness"] - float(np.mean(self._mesh.roughness))))
        return found + s.plain * (plain + dr.mean(of["metallic"]))

    def _steps(self, kind: Any, values: mi.Float) -> Any:
        """Return the mean difference along edges: quadratic below _EDGE, linear above (Charbonnier)."""
        one, other = (dr.gather(kind, values, end) for end in self._edges)
        return dr.mean(dr.sqrt(dr.squared_norm(one - other) + _EDGE**2) - _EDGE)

    def mesh(self) -> PaintedMesh:
        """Return the mesh with its current materials."""
        values = {name: np.array(self._optimizer[name]) for name in MATERIALS}
        return replace(self._mesh, **values | {"base_color": values["base_color"].reshape(-1, 3)})

    def light(self) -> EnvironmentMap:
        """Return the current light."""
        return EnvironmentMap(np.exp(np.array(self._optimizer["light"])))


def _photo(view: View, capture: Capture) -> _Photo | None:
    """Load a training photo onto the device; None if no pixel counts."""
    counts = view.believed()
    if view.has("mask"):
        counts &= view.read("mask") > COVERED
    if view.space == "display":
        counts &= (view.read() < CLIPPED).all(-1)
    if not counts.any():
        return None
    light = linear_light(view, capture.exposure, capture.tone_curve)
    weight = np.broadcast_to(counts[..., None], light.shape).astype(np.float32)
    return _Photo(
        mi.load_dict(mitsuba_sensor(view.camera)), mi.TensorXf(aligned(light)), mi.TensorXf(aligned(weight)),
        3.0 * float(counts.sum()),
    )  # fmt: skip
