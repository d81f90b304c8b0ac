"""Scenes as captures to reconstruct: path-traced views from all sides under one light, with the true maps.

What a photographer would have brought home, and what he could not: alpha, normals, materials, irradiance,
depth and the light itself, and the held-out views under lights that were not there (:mod:`datagen.relit`). A
capture is the test split's scene of the same index; its folder appears whole (``tron.captures.folder``) and
after those, so it is finished when it is there.
"""

from __future__ import annotations

import gc
import json
import logging
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from datagen.build import Geometry
from datagen.capture_manifest import CaptureManifest
from datagen.capture_recipe import adopt_recipe
from datagen.capture_settings import CaptureSettings
from datagen.clusters import logs_folder, require_cluster
from datagen.drawn_scene import draw_and_build
from datagen.failures import record_failures, summary
from datagen.pathtrace import gbuffers, render_frames
from datagen.photographs import Photograph, described, drift
from datagen.plan import Sources, Work, chosen
from datagen.ready_sources import ready_sources
from datagen.relit import RELIT, record_relit, relit_folders, straightened, write_relit
from datagen.scene import SceneSpec, scene_name
from datagen.scheduling import make_each
from datagen.settings import Settings
from datagen.true_maps import MAPS, true_maps
from tron.cameras import Camera
from tron.captures import Capture, View
from tron.captures.folder import read_capture_folder, write_capture
from tron.color import to_display
from tron.errors import TronError
from tron.images import encode_exr
from tron.runtime import activate
from tron.seeds import generator, integer
from tron.shading.environment import EnvironmentMap
from tron.storage import locked, require_free_space

log = logging.getLogger(__name__)

HELD_OUT = 8
"""Each view of this distance is a test view, the first included, as COLMAP's captures are split."""

GROUP_PIXELS = 2**20
"""Pixels of the views that are rendered together: bounds memory."""

CAPTURES = "captures"
"""Folder of the captures within output_dir."""

ENVIRONMENT_NAME = "environment.exr"
SPEC_NAME = "spec.json"
PHOTOGRAPHS_NAME = "photographs.json"
PHOTOGRAPHED = ("image", "mask")
"""Fields of a view that is a photograph: no map tells anyone more of it."""
PIXEL_BYTES = 4 + 2 * (3 + 3 + 1 + 1 + 3) + 4
RELIT_PIXEL_BYTES = 2 * 4


def make_captures(settings: Settings) -> int:
    """Make what is missing of ``output_dir/captures``; return how many captures failed.

    Raises:
        TronError: wrong settings, a folder in use, made otherwise or not writable, too little space: all
            before the first scene.
    """
    wanted = settings.capture
    items = [Work("test", i, scene_name("test", i), first_shard=0) for i in range(wanted.scenes)]
    items = chosen(items, settings.only)
    require_cluster(settings)
    activate(settings.variant, threads=1)
    sources = ready_sources(settings)
    folder = settings.output_dir / CAPTURES
    with locked(settings.output_dir):
        adopt_recipe(folder, settings.capture_recipe())
        manifest = CaptureManifest.load(folder)
        missing = [item for item in items if not _finished(folder / item.name, wanted)]
        require_free_space(folder, len(missing) * _estimate_bytes(settings))
        failed = make_each(make_capture, missing, settings, sources, lambda _: wanted.views, "views")
        finished = [item for item in items if item.name not in failed]
        for item in finished:
            if item in missing or item.name not in manifest.captures:  # made now, or by an older engine
                manifest.record(folder / item.name)
        manifest.save(folder)
        record_relit(settings.output_dir / RELIT, [item.name for item in finished], wanted.relights)
        failures = record_failures(folder, settings, items, failed, {item.name: () for item in finished})
    log.info("%d of %d captures are in %s", len(finished), len(items), folder)
    if failures:
        log.error("%s", summary(failures, folder, logs_folder(settings)))
    return failures


def make_capture(item: Work, settings: Settings, sources: Sources) -> Path:
    """Make one capture and return its folder. Runs in a worker; a second run writes the same bytes.

    Raises:
        TronError: a buffer holds NaN or infinity, or the folder cannot be written.
    """
    activate(settings.variant, threads=1)
    wanted = settings.capture
    folder = settings.output_dir / CAPTURES / item.name
    family = wanted.lights[item.index % len(wanted.lights)]
    spec, geometry = draw_and_build(item, settings, sources, [family, *wanted.relights])
    environment, *others = (
        light.bake(settings.environment_height, settings.environments).baked() for light in spec.lights
    )
    write_relit(settings.output_dir / RELIT, spec, geometry, others, held_out_cameras(spec, wanted), wanted)
    photographs = taken(spec, wanted)
    beside = {
        SPEC_NAME: spec.to_json().encode(),
        ENVIRONMENT_NAME: encode_exr(environment.image, half=False),
    }
    if photographs:
        text = json.dumps(described(list(photographs.items())), indent=1) + "\n"
        beside[PHOTOGRAPHS_NAME] = text.encode()
    write = partial(write_capture, folder, overwrite=True, beside=beside)
    write(captured(spec, geometry, environment, wanted, photographs))
    if wanted.points is not None:
        # Read back, for points have the colours of the pictures, and views are not held in memory.
        capture = read_capture_folder(folder)
        points, colors = surface_points(capture, wanted.points, spec)
        write(replace(capture, points=points, point_colors=colors))
    del geometry
    gc.collect()
    dr.flush_malloc_cache()
    return folder


def view_names(settings: CaptureSettings) -> list[str]:
    """Names of a capture's views, in order."""
    return [f"view_{number:05d}" for number in range(settings.views)]


def held_out_cameras(spec: SceneSpec, settings: CaptureSettings) -> dict[str, Camera]:
    """The held-out views by their names."""
    cameras = spec.views(settings.views, settings.width, settings.height)
    return dict(list(zip(view_names(settings), cameras))[::HELD_OUT])


def taken(spec: SceneSpec, settings: CaptureSettings) -> dict[str, Photograph]:
    """Photograph of each training view; nothing where captures are true renders."""
    if not settings.photographs:
        return {}
    names = [name for number, name in enumerate(view_names(settings)) if number % HELD_OUT]
    path = (spec.split, spec.index, "capture")
    return dict(zip(names, drift(len(names), settings.sensor, spec.seed, *path)))


def captured(
    spec: SceneSpec,
    geometry: Geometry,
    environment: EnvironmentMap,
    settings: CaptureSettings,
    photographs: Mapping[str, Photograph] | None = None,
) -> Capture:
    """The capture of a scene under a light; views are rendered when they are read, best in their order.

    Images are AgX of straight (not premultiplied) radiance times the light's exposure, with anti-aliased
    coverage as their mask; those that ``photographs`` names are what a camera made of that radiance, and no
    map tells more of them. Maps are of the pixel centres, zero where there is no surface.
    """
    cameras = spec.views(settings.views, settings.width, settings.height)
    shots = _Shots(spec, geometry, environment, cameras, settings, photographs or {})
    views = []
    for number, (name, camera) in enumerate(zip(view_names(settings), cameras)):
        known = PHOTOGRAPHED if photographs and name in photographs else _Shots.FIELDS
        fields: dict[str, Any] = {field: partial(shots.read, number, field) for field in known}
        views.append(View(name, camera, space="display", **fields))
    test = frozenset(view.name for view in views[::HELD_OUT])
    return Capture(tuple(views), test, up=np.array([0.0, 0.0, 1.0]), exposure=environment.exposure())


def surface_points(capture: Capture, count: int, spec: SceneSpec) -> tuple[np.ndarray, np.ndarray]:
    """About ``count`` points (N, 3) that training views see, and their colours, display space."""
    rng = generator(spec.seed, spec.split, spec.index, "capture", "points")
    views = capture.train_views
    points, colors = [], []
    for view, share in zip(views, np.diff(np.arange(len(views) + 1) * count // len(views))):
        depth = view.read("depth")
        rows, columns = np.nonzero((depth > 0) & (view.read("mask") == 1))
        picked = rng.permutation(len(rows))[:share]
        pixels = rows[picked], columns[picked]
        points.append(view.camera.position + view.camera.rays()[pixels] * depth[pixels][:, None])
        colors.append(view.read()[pixels])
    return np.concatenate(points), np.concatenate(colors)


class _Shots:
    """Views that are rendered a group at a time, the group of the one that is asked for; the last is kept."""

    FIELDS = ("image", "mask", *MAPS)

    def __init__(
        self,
        spec: SceneSpec,
        geometry: Geometry,
        environment: EnvironmentMap,
        cameras: list[Camera],
        settings: CaptureSettings,
        photographs: Mapping[str, Photograph],
    ) -> None:
        self._spec, self._geometry, self._cameras, self._settings = spec, geometry, cameras, settings
        self._names, self._photographs = view_names(settings), photographs
        self._scene: mi.Scene = geometry.lit(environment)
        self._exposure = environment.exposure()
        self._size = max(GROUP_PIXELS // (settings.width * settings.height), 1)
        self._group = -1
        self._rendered: list[dict[str, np.ndarray]] = []

    def read(self, number: int, field: str) -> np.ndarray:
        """One field of one view, float32."""
        group, place = divmod(number, self._size)
        if group != self._group:
            first = group * self._size
            self._rendered = self._render(first, self._cameras[first : first + self._size])
            self._group = group
        return self._rendered[place][field]

    def _render(self, first: int, cameras: list[Camera]) -> list[dict[str, np.ndarray]]:
        seeds = [self._seed(first + i, "path") for i in range(len(cameras))]
        frames = render_frames(self._scene, cameras, self._settings.path_spp, seeds, transparent=True)
        shots = []
        for i, (camera, truth, frame) in enumerate(zip(cameras, gbuffers(self._geometry, cameras), frames)):
            seed = self._seed(first + i, "reference")
            maps = true_maps(self._geometry, self._scene, camera, truth, self._settings.reference_spp, seed)
            straight, mask = straightened(frame, f"view {first + i} of {self._spec.name}")
            image = self._picture(first + i, straight, mask)
            shots.append({"image": image, "mask": mask, **maps})
        return shots

    def _picture(self, number: int, straight: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """Display values of straight linear radiance; what is not covered is black."""
        photograph, spec = self._photographs.get(self._names[number]), self._spec
        if photograph is None:
            shown = to_display(straight, self._exposure)
        else:
            rng = generator(spec.seed, spec.split, spec.index, "capture", number, "noise")
            shown = to_display(photograph.take(self._exposure * straight, self._settings.sensor, rng), 1.0)
        return np.where(mask[..., None] > 0, shown, 0.0)

    def _seed(self, number: int, what: str) -> int:
        spec = self._spec
        return integer(spec.seed, spec.split, spec.index, "capture", number, what)


def _finished(folder: Path, settings: CaptureSettings) -> bool:
    try:
        capture = read_capture_folder(folder)
        for relit in relit_folders(folder.parent.parent / RELIT, folder.name, settings.relights):
            read_capture_folder(relit)
    except TronError:
        return False
    return settings.points is None or capture.points is not None


def _estimate_bytes(settings: Settings) -> int:
    wanted = settings.capture
    pixels = wanted.views * wanted.width * wanted.height
    relit = pixels // HELD_OUT * len(wanted.relights) * RELIT_PIXEL_BYTES
    return relit + pixels * PIXEL_BYTES + wanted.views * 10_000 + settings.environment_height**2 * 2 * 12
