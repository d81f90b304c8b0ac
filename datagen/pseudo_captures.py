"""Pseudo-captures: scenes as a phone would bring them home, and the truth in a folder that nobody opens.

    captures/NAME    photos, poses a little off, sparse points, masks where they are asked for
                     (``datagen.blind_capture``); nothing else
    truth/NAME       the same views as a capture folder: true cameras, linear radiance with coverage as mask,
                     true maps of the held-out views, environment.exr, spec.json, photographs.json
    relit/NAME_K_L   the held-out views under other lights (``datagen.relit``)

What is reconstructed from ``captures`` is judged by the others. A capture is finished when all of its folders
are there; the photos are written last.
"""

from __future__ import annotations

import gc
import json
import logging
from collections.abc import Mapping
from pathlib import Path

import drjit as dr
import numpy as np

from datagen.blind_capture import read_blind_capture, write_blind_capture
from datagen.build import Geometry
from datagen.capture_export import (
    CAPTURES,
    ENVIRONMENT_NAME,
    HELD_OUT,
    PHOTOGRAPHS_NAME,
    SPEC_NAME,
)
from datagen.capture_manifest import CaptureManifest
from datagen.capture_recipe import CONFIG_NAME, adopt_recipe, require_nobodys
from datagen.clusters import logs_folder, require_cluster
from datagen.drawn_scene import draw_and_build
from datagen.exposure import metered
from datagen.failures import record_failures, summary
from datagen.pathtrace import gbuffers, render_frames
from datagen.phone import Phone, draw_phone
from datagen.plan import Sources, Work, chosen, plan
from datagen.pose_noise import disturbed
from datagen.ready_sources import ready_sources
from datagen.relit import RELIT, record_relit, relit_folders, straightened, write_relit
from datagen.scene import SceneSpec
from datagen.scheduling import make_each
from datagen.settings import SPLITS, Settings
from datagen.true_maps import true_maps
from tron.cameras import Camera
from tron.captures import Capture, View
from tron.captures.folder import read_capture_folder, write_capture
from tron.errors import TronError
from tron.gaussians.initialize import GBufferView
from tron.images import encode_exr, encode_jpeg, encode_png
from tron.runtime import activate
from tron.seeds import generator, integer
from tron.shading.environment import EnvironmentMap
from tron.storage import locked, require_free_space

log = logging.getLogger(__name__)

TRUTH = "truth"
"""Folder of the truth within output_dir; the recipe and what failed lie there too."""

STREAM = "pseudo_capture"
FINER = 4
"""Looks at the light a pixel's side, where it is seen behind the surfaces."""

PHOTO_BYTES = 3
TRUE_BYTES = 2 * 4
MAPS_BYTES = 2 * (3 + 3 + 1 + 1 + 3) + 4


def make_pseudo_captures(settings: Settings) -> int:
    """Make what is missing of the captures and their truth; return how many failed.

    Raises:
        TronError: wrong settings, a folder in use, made otherwise or not writable, too little space: all
            before the first scene.
    """
    items = plan(settings)
    wanted = chosen(items, settings.only)
    require_cluster(settings)
    activate(settings.variant, threads=1)
    sources = ready_sources(settings)
    captures, truth = settings.output_dir / CAPTURES, settings.output_dir / TRUTH
    with locked(settings.output_dir):
        if not (truth / CONFIG_NAME).exists():
            require_nobodys(captures)
        adopt_recipe(truth, settings.pseudo_capture_recipe(), may_grow=SPLITS)
        manifests = {folder: CaptureManifest.load(folder) for folder in (captures, truth)}
        missing = [item for item in wanted if not _finished(item, settings, manifests)]
        require_free_space(captures, sum(_estimate_bytes(item, settings) for item in missing))
        failed = make_each(
            make_pseudo_capture,
            missing,
            settings,
            sources,
            lambda item: len(photo_names(item, settings)),
            "photos",
        )
        finished = [item.name for item in wanted if item.name not in failed]
        made = {item.name for item in missing}
        for folder, manifest in manifests.items():
            for name in finished:
                if name in made or name not in manifest.captures:
                    manifest.record(folder / name)
            manifest.save(folder)
        record_relit(settings.output_dir / RELIT, finished, settings.pseudo_capture.relights)
        failures = record_failures(truth, settings, wanted, failed, dict.fromkeys(finished, ()))
    log.info("%d of %d pseudo-captures are in %s", len(finished), len(wanted), captures)
    if failures:
        log.error("%s", summary(failures, truth, logs_folder(settings)))
    return failures


def make_pseudo_capture(item: Work, settings: Settings, sources: Sources) -> Path:
    """Make one capture and its truth, and return the capture's folder.

    Runs in a worker; a second run writes the same bytes. Its frames and G-buffers are in memory together.

    Raises:
        TronError: a frame is not finite, or a folder cannot be written.
    """
    activate(settings.variant, threads=1)
    wanted, names = settings.pseudo_capture, photo_names(item, settings)
    family = wanted.lights[item.index % len(wanted.lights)]
    spec, geometry = draw_and_build(item, settings, sources, [family, *wanted.relights])
    environment, *others = (
        light.bake(settings.environment_height, settings.environments).baked() for light in spec.lights
    )
    cameras = dict(zip(names, spec.views(len(names), wanted.width, wanted.height)))
    held_out = dict(list(cameras.items())[::HELD_OUT])
    write_relit(settings.output_dir / RELIT, spec, geometry, others, held_out, wanted)

    seeds = [integer(spec.seed, spec.split, spec.index, STREAM, name, "path") for name in names]
    spp = wanted.path_spp if wanted.indoor_spp is None or not spec.metered else wanted.indoor_spp
    frames = render_frames(geometry.lit(environment), list(cameras.values()), spp, seeds, transparent=True)
    buffers = dict(zip(names, gbuffers(geometry, list(cameras.values()))))
    shots = dict(zip(names, frames))
    phone = draw_phone(wanted, names, spec.seed, spec.split, spec.index, STREAM)
    # A phone meters what it sees, outdoors as well.
    exposure = metered(frames[..., :3], frames[..., 3] >= 1, environment.exposure())

    true_capture = _true_capture(spec, geometry, environment, cameras, shots, buffers, exposure, settings)
    told = {"exposure": exposure, **phone.described()}
    beside = {
        SPEC_NAME: spec.to_json().encode(),
        ENVIRONMENT_NAME: encode_exr(environment.image, half=False),
        PHOTOGRAPHS_NAME: (json.dumps(told, indent=1) + "\n").encode(),
    }
    write_capture(settings.output_dir / TRUTH / item.name, true_capture, overwrite=True, beside=beside)
    path = settings.output_dir / CAPTURES / item.name
    _write_photos(path, spec, environment, phone, cameras, shots, buffers, exposure, settings)
    del geometry
    gc.collect()
    dr.flush_malloc_cache()
    return path


def photo_names(item: Work, settings: Settings) -> list[str]:
    """Names of a capture's photos, in order; their number is drawn."""
    low, high = settings.pseudo_capture.views
    rng = generator(settings.seed, item.split, item.index, STREAM, "views")
    return [f"view_{number:05d}" for number in range(int(rng.integers(low, high + 1)))]


def before_light(frame: np.ndarray, environment: EnvironmentMap, camera: Camera) -> np.ndarray:
    """Linear radiance (H, W, 3) of a frame (H, W, 4) before the light that is seen directly behind it."""
    rows, columns = np.nonzero(frame[..., 3] < 1)
    light = frame[..., :3].astype(np.float32)
    rays = camera.resized(FINER * camera.width, FINER * camera.height).rays()
    rays = rays.reshape(camera.height, FINER, camera.width, FINER, 3)[rows, :, columns]
    behind = environment.lookup(rays).mean(axis=(1, 2))
    light[rows, columns] += (1 - frame[rows, columns, 3:]) * behind
    return light


def sparse_points(
    cameras: Mapping[str, Camera],
    buffers: Mapping[str, GBufferView],
    photos: Mapping[str, np.ndarray],
    count: int,
    error: float,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """About ``count`` points (N, 3) on surfaces that photos show, and their colours in the photos.

    Args:
        cameras, buffers, photos: by the names of the photos: true cameras, true surfaces, display values.
        count: of points, the same of each photo.
        error: standard deviation of each coordinate, world units.
        rng: source of places and errors.
    """
    points, colors = [], []
    shares = np.diff(np.arange(len(cameras) + 1) * count // len(cameras))
    for name, share in zip(cameras, shares):
        rows, columns = np.nonzero(buffers[name].valid)
        picked = rng.permutation(len(rows))[:share]
        pixels = rows[picked], columns[picked]
        points.append(buffers[name].position[pixels] + rng.normal(0.0, error, (len(picked), 3)))
        colors.append(photos[name][pixels])
    return np.concatenate(points), np.concatenate(colors)


def _true_capture(
    spec: SceneSpec,
    geometry: Geometry,
    environment: EnvironmentMap,
    cameras: Mapping[str, Camera],
    shots: Mapping[str, np.ndarray],
    buffers: Mapping[str, GBufferView],
    exposure: float,
    settings: Settings,
) -> Capture:
    """All views as they are, in linear light; the held-out ones with their maps."""
    scene, views = geometry.lit(environment), []
    for number, (name, camera) in enumerate(cameras.items()):
        straight, mask = straightened(shots[name], f"{name} of {spec.name}")
        maps = {}
        if number % HELD_OUT == 0:
            seed = integer(spec.seed, spec.split, spec.index, STREAM, name, "reference")
            spp = settings.pseudo_capture.reference_spp
            maps = true_maps(geometry, scene, camera, buffers[name], spp, seed)
        views.append(View(name, camera, straight, "linear", mask=mask, **maps))
    test = frozenset(list(cameras)[::HELD_OUT])
    return Capture(tuple(views), test, up=np.array([0.0, 0.0, 1.0]), exposure=exposure)


def _write_photos(
    path: Path,
    spec: SceneSpec,
    environment: EnvironmentMap,
    phone: Phone,
    cameras: Mapping[str, Camera],
    shots: Mapping[str, np.ndarray],
    buffers: Mapping[str, GBufferView],
    exposure: float,
    settings: Settings,
) -> None:
    """Photograph the frames and write the capture that reconstructions may see."""
    wanted, noise = settings.pseudo_capture, settings.pseudo_capture.pose_noise
    photos, poses = {}, {}
    distance = median_distance(cameras, buffers)
    for name, camera in cameras.items():
        stream = (spec.split, spec.index, STREAM, name)
        light = exposure * before_light(shots[name], environment, camera)
        photos[name] = phone.photo(name, light, wanted, generator(spec.seed, *stream, "noise"))
        rng = generator(spec.seed, *stream, "pose")
        poses[name] = disturbed(camera, noise.rotation_deg, noise.translation * distance, rng)
    points = None
    if wanted.points is not None:
        rng = generator(spec.seed, spec.split, spec.index, STREAM, "points")
        points = sparse_points(cameras, buffers, photos, wanted.points, noise.points * distance, rng)
    if wanted.file == "png":
        files = {name: encode_png(photo) for name, photo in photos.items()}
    else:
        files = {name: encode_jpeg(photo, wanted.jpeg_quality) for name, photo in photos.items()}
    masks = {name: encode_png(shots[name][..., 3:]) for name in cameras} if wanted.masks else None
    write_blind_capture(path, poses, files, ".png" if wanted.file == "png" else ".jpg", points, masks)


def median_distance(cameras: Mapping[str, Camera], buffers: Mapping[str, GBufferView]) -> float:
    """Median over all pixels of the distance between camera and surface, world units; 1 where there is none.

    Errors of poses are a share of it, for a world has no scale of its own.
    """
    found = [
        np.linalg.norm(buffers[name].position[buffers[name].valid] - camera.position, axis=-1)
        for name, camera in cameras.items()
    ]
    distances = np.concatenate(found)
    return float(np.median(distances)) if distances.size else 1.0


def _finished(item: Work, settings: Settings, manifests: Mapping[Path, CaptureManifest]) -> bool:
    """Whether the folders of a capture are there, readable, and as they were taken down if they were."""
    if any(
        item.name in manifest.captures and not manifest.holds(folder / item.name)
        for folder, manifest in manifests.items()
    ):
        return False
    try:
        read_blind_capture(settings.output_dir / CAPTURES / item.name)
        read_capture_folder(settings.output_dir / TRUTH / item.name)
        for relit in relit_folders(settings.output_dir / RELIT, item.name, settings.pseudo_capture.relights):
            read_capture_folder(relit)
    except TronError:
        return False
    return True


def _estimate_bytes(item: Work, settings: Settings) -> int:
    wanted, views = settings.pseudo_capture, len(photo_names(item, settings))
    held_out = -(-views // HELD_OUT)
    pixel = views * (PHOTO_BYTES + wanted.masks + TRUE_BYTES)
    pixel += held_out * (MAPS_BYTES + len(wanted.relights) * TRUE_BYTES)
    light = settings.environment_height**2 * 2 * 12
    return pixel * wanted.width * wanted.height + views * 10_000 + light * (1 + len(wanted.relights))
