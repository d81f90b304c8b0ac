"""A perfect camera: captures of path-traced views from all sides, with true maps.

Besides pictures, a capture has what no photographer can measure: alpha, normals, materials, irradiance, depth
and the light. A capture is the test split's scene of the same index; its folder appears whole
(``tron.captures.folder``).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import mitsuba as mi
import numpy as np

from datagen.dataset.records import Work
from datagen.photographs.camera_model import (
    CAPTURES,
    ENVIRONMENT_NAME,
    HELD_OUT,
    PHOTOGRAPHS_NAME,
    SPEC_NAME,
    CameraModel,
    Stage,
    straightened,
    view_names,
)
from datagen.photographs.meter import balanced
from datagen.photographs.phone import Photograph, described, drift
from datagen.settings.captures import CaptureSettings
from datagen.settings.command import Settings
from datagen.truth.build import Geometry
from datagen.truth.pathtrace import direct_irradiance, gbuffers, render_frames
from datagen.world.scene import SceneSpec
from tron.cameras import Camera
from tron.captures import Capture, View
from tron.captures.folder import read_capture_folder, write_capture
from tron.color import to_display
from tron.errors import TronError
from tron.gaussians.initialize import GBufferView
from tron.io.images import encode_exr
from tron.seeds import generator, integer
from tron.shading.environments.environment import EnvironmentMap

STREAM = "capture"
"""Name of the random streams of this camera."""
GROUP_PIXELS = 2**20
"""Pixels of the views that are rendered together: bounds memory."""

PIXEL_BYTES = 4 + 2 * (3 + 3 + 1 + 1 + 3) + 4
RELIT_PIXEL_BYTES = 2 * (4 + 3)
MAPS = ("normal", "base_color", "roughness", "metallic", "irradiance", "depth")
"""Fields of a view (``tron.captures.View``) that :func:`true_maps` gives."""
PHOTOGRAPHED = ("image", "mask")
"""Fields of a view that is a photograph: no map tells anyone more of it."""


class PerfectCamera(CameraModel):
    """Path-traced radiance with true maps or, with ``photographs``, a photographer's photos of it."""

    called, folders = ("captures", "views"), (CAPTURES,)

    def settings(self, settings: Settings) -> CaptureSettings:
        """Return the settings ``capture``."""
        return settings.capture

    def recipe(self, settings: Settings) -> dict[str, Any]:
        """Return the keys, with the style of the test split."""
        return settings.capture_recipe()

    def scenes(self, settings: Settings) -> dict[str, int]:
        """Return ``capture.scenes`` scenes of the test split."""
        return {"test": settings.capture.scenes}

    def views(self, item: Work, settings: Settings) -> int:  # noqa: ARG002 as all cameras
        """Return the number of views in the settings."""
        return settings.capture.views

    def bytes(self, item: Work, settings: Settings) -> int:  # noqa: ARG002 as all cameras
        """Return the bytes of pictures and maps of all views, of relit views and of the light."""
        wanted = settings.capture
        pixels = wanted.views * wanted.width * wanted.height
        shown = wanted.views // HELD_OUT if wanted.film_frames is None else wanted.film_frames
        relit = shown * wanted.width * wanted.height * len(wanted.relights) * RELIT_PIXEL_BYTES
        return relit + pixels * PIXEL_BYTES + wanted.views * 10_000 + settings.environment_height**2 * 2 * 12

    def shoot(self, stage: Stage, settings: Settings) -> None:
        """Write one folder; if points are wanted it is written again with them."""
        wanted, spec, geometry = settings.capture, stage.spec, stage.geometry
        folder = settings.output_dir / CAPTURES / spec.name
        photographs = taken(spec, wanted)
        environment, exposure = stage.environment, stage.environment.exposure()
        if photographs:
            environment, exposure = balanced(spec, geometry, environment, wanted, STREAM)
        beside = {
            SPEC_NAME: spec.to_json().encode(),
            ENVIRONMENT_NAME: encode_exr(environment.image, half=False),
        }
        if photographs:
            text = json.dumps(described(list(photographs.items())), indent=1) + "\n"
            beside[PHOTOGRAPHS_NAME] = text.encode()
        write = partial(write_capture, folder, overwrite=True, beside=beside)
        write(captured(spec, geometry, environment, wanted, photographs, exposure))
        if wanted.points is not None:
            # Read back, for points have the colours of the pictures, and views are not held in memory.
            capture = read_capture_folder(folder)
            points, colors = surface_points(capture, wanted.points, spec, geometry)
            write(replace(capture, points=points, point_colors=colors))

    def require_whole(self, name: str, settings: Settings) -> None:
        """Raise TronError unless the folder can be read, with points if they are wanted."""
        folder = settings.output_dir / CAPTURES / name
        if read_capture_folder(folder).points is None and settings.capture.points is not None:
            raise TronError("the capture has no points yet", folder)


def taken(spec: SceneSpec, settings: CaptureSettings) -> dict[str, Photograph]:
    """Return the photograph of each training view; empty if captures are true renders."""
    if not settings.photographs:
        return {}
    names = [name for number, name in enumerate(view_names(settings.views)) if number % HELD_OUT]
    path = (spec.split, spec.index, STREAM)
    return dict(zip(names, drift(len(names), settings.sensor, spec.seed, *path)))


def captured(
    spec: SceneSpec,
    geometry: Geometry,
    environment: EnvironmentMap,
    settings: CaptureSettings,
    photographs: Mapping[str, Photograph] | None = None,
    exposure: float | None = None,
) -> Capture:
    """Return the capture of a scene under a light; views are rendered on reading, fastest in order.

    Images are AgX of straight (not premultiplied) radiance times the exposure (the light's own where none is
    given), with anti-aliased coverage as their mask; those that ``photographs`` names are what a camera made
    of that radiance, and no map tells more of them. Maps are of the pixel centres, zero where there is no
    surface.
    """
    cameras = spec.views(settings.views, settings.width, settings.height)
    exposure = environment.exposure() if exposure is None else exposure
    shots = _Shots(spec, geometry, environment, cameras, settings, photographs or {}, exposure)
    views = []
    for number, (name, camera) in enumerate(zip(view_names(settings.views), cameras)):
        known = PHOTOGRAPHED if photographs and name in photographs else _Shots.FIELDS
        fields: dict[str, Any] = {field: partial(shots.read, number, field) for field in known}
        views.append(View(name, camera, space="display", **fields))
    test = frozenset(view.name for view in views[::HELD_OUT])
    return Capture(tuple(views), test, up=np.array([0.0, 0.0, 1.0]), exposure=exposure)


def surface_points(
    capture: Capture, count: int, spec: SceneSpec, geometry: Geometry
) -> tuple[np.ndarray, np.ndarray]:
    """Return about ``count`` points (N, 3) visible in training views, and their display colours.

    Photographs have no depth map, so their depth is traced in the meshes.
    """
    rng = generator(spec.seed, spec.split, spec.index, STREAM, "points")
    views = capture.train_views
    points, colors = [], []
    for view, share in zip(views, np.diff(np.arange(len(views) + 1) * count // len(views))):
        if view.has("depth"):
            depth = view.read("depth")
        else:
            (truth,) = gbuffers(geometry, [view.camera])
            depth = true_depth(truth)
        rows, columns = np.nonzero((depth > 0) & (view.read("mask") == 1))
        picked = rng.permutation(len(rows))[:share]
        pixels = rows[picked], columns[picked]
        points.append(view.camera.position + view.camera.rays()[pixels] * depth[pixels][:, None])
        colors.append(view.read()[pixels])
    return np.concatenate(points), np.concatenate(colors)


class _Shots:
    """Views rendered on demand in groups; the last group is kept."""

    FIELDS = ("image", "mask", *MAPS)

    def __init__(
        self,
        spec: SceneSpec,
        geometry: Geometry,
        environment: EnvironmentMap,
        cameras: list[Camera],
        settings: CaptureSettings,
        photographs: Mapping[str, Photograph],
        exposure: float,
    ) -> None:
        self._spec, self._geometry, self._cameras, self._settings = spec, geometry, cameras, settings
        self._names, self._photographs = view_names(settings.views), photographs
        self._scene: mi.Scene = geometry.lit(environment)
        self._exposure = exposure
        self._size = max(GROUP_PIXELS // (settings.width * settings.height), 1)
        self._group = -1
        self._rendered: list[dict[str, np.ndarray]] = []

    def read(self, number: int, field: str) -> np.ndarray:
        """Read one field of one view, float32."""
        group, place = divmod(number, self._size)
        if group != self._group:
            first = group * self._size
            self._rendered = self._render(first, self._cameras[first : first + self._size])
            self._group = group
        return self._rendered[place][field]

    def _render(self, first: int, cameras: list[Camera]) -> list[dict[str, np.ndarray]]:
        seeds = [self._seed(first + i, "path") for i in range(len(cameras))]
        frames = render_frames(
            self._scene, cameras, self._settings.path_spp, seeds, self._spec.path_bounces, transparent=True
        )
        shots = []
        for i, (camera, truth, frame) in enumerate(zip(cameras, gbuffers(self._geometry, cameras), frames)):
            seed = self._seed(first + i, "reference")
            maps = true_maps(self._geometry, self._scene, camera, truth, self._settings.reference_spp, seed)
            straight, mask = straightened(frame, f"view {first + i} of {self._spec.name}")
            image = self._picture(first + i, straight, mask)
            shots.append({"image": image, "mask": mask, **maps})
        return shots

    def _picture(self, number: int, straight: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """Return display values of straight linear radiance; uncovered pixels are black."""
        photograph, spec = self._photographs.get(self._names[number]), self._spec
        if photograph is None:
            shown = to_display(straight, self._exposure)
        else:
            rng = generator(spec.seed, spec.split, spec.index, STREAM, number, "noise")
            shown = to_display(photograph.take(self._exposure * straight, self._settings.sensor, rng), 1.0)
        return np.where(mask[..., None] > 0, shown, 0.0)

    def _seed(self, number: int, what: str) -> int:
        spec = self._spec
        return integer(spec.seed, spec.split, spec.index, STREAM, number, what)


def true_depth(truth: GBufferView) -> np.ndarray:
    """Return distances from camera to surface (H, W), world units; 0 off surfaces."""
    return np.where(truth.valid, np.linalg.norm(truth.position - truth.camera.position, axis=-1), 0)


def true_maps(
    geometry: Geometry, scene: mi.Scene, camera: Camera, truth: GBufferView, spp: int, seed: int
) -> dict[str, np.ndarray]:
    """Return field of a view -> map at the pixel centres, zero off surfaces.

    Args:
        geometry, scene: the meshes, and the same lit.
        camera: of the view.
        truth: its G-buffers (``datagen.truth.pathtrace.gbuffers``).
        spp, seed: shadow rays per pixel of the irradiance and their stream.
    """
    direct = direct_irradiance(geometry, scene, camera, spp, seed)
    maps = {
        "normal": truth.normal,
        "base_color": truth.base_color,
        "roughness": truth.roughness,
        "metallic": truth.metallic,
        "irradiance": direct.shadowed,
        "depth": true_depth(truth),
    }
    seen = truth.valid
    return {name: np.where(seen if x.ndim == 2 else seen[..., None], x, 0) for name, x in maps.items()}
