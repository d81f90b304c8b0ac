"""Pseudo-captures: scenes photographed as by a phone, with the truth in separate folders.

    captures/NAME    photos, poses a little off, sparse points, masks where they are asked for
                     (``datagen.photographs.pseudo_captures``); nothing else
    truth/NAME       the same views as a capture folder: true cameras, linear radiance with coverage as mask,
                     true maps of the held-out views, environment.exr, spec.json, photographs.json; in the
                     colours of a camera that balances white (``datagen.photographs.meter``)
    relit/NAME_K_L   the held-out views under other lights (``datagen.photographs.camera_model``)

Reconstructions from ``captures`` are judged by the others. A capture is finished when all of its folders
exist; the photos are written last. ``captures/NAME`` is what a camera and structure from motion give:

    transforms.json     nerfstudio's: intrinsics, OpenGL camera-to-world matrices
    images/NAME.jpg     8 bits (or .png)
    masks/NAME.png      8 bits, what is subject; where they are asked for
    sparse.ply          points and their colours, if some are known

It has no object "tron" (``tron.captures.folder``), so ``load_capture`` reads it as ordinary photos: without
maps, and with unknown exposure and tone curve.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from datagen.dataset.records import Work
from datagen.photographs.camera_model import (
    CAPTURES,
    ENVIRONMENT_NAME,
    HELD_OUT,
    PHOTOGRAPHS_NAME,
    SPEC_NAME,
    TRUTH,
    CameraModel,
    Stage,
    straightened,
)
from datagen.photographs.meter import balanced
from datagen.photographs.perfect import true_maps
from datagen.photographs.phone import Phone, draw_phone
from datagen.settings.captures import PseudoCaptureSettings
from datagen.settings.command import Settings
from datagen.truth.pathtrace import gbuffers, render_frames
from tron.cameras import Camera, opencv_to_opengl
from tron.captures import Capture, LoadSettings, View, load_capture
from tron.captures.folder import TRANSFORMS_NAME, encode_points, read_capture_folder, write_capture
from tron.errors import TronError
from tron.gaussians.initialize import GBufferView
from tron.io.images import encode_exr, encode_jpeg, encode_png
from tron.seeds import generator, integer
from tron.shading.environments.environment import EnvironmentMap
from tron.storage import atomic_folder

STREAM = "pseudo_capture"
JPEG_QUALITY = 92
"""Of Pillow's scale: a phone's photos are about so large."""
PHOTO_BYTES = 3
TRUE_BYTES = 2 * 4
MAPS_BYTES = 2 * (3 + 3 + 1 + 1 + 3) + 4
FINER = 4
"""Looks at the light a pixel's side, where it is seen behind the surfaces."""


class PhoneCamera(CameraModel):
    """A phone with inexact poses; the truth is in a folder of its own."""

    called, folders = ("pseudo-captures", "photos"), (CAPTURES, TRUTH)

    def settings(self, settings: Settings) -> PseudoCaptureSettings:
        """Return the settings ``pseudo_capture``."""
        return settings.pseudo_capture

    def recipe(self, settings: Settings) -> dict[str, Any]:
        """Return the keys, with the styles of the splits that have scenes."""
        return settings.pseudo_capture_recipe()

    def scenes(self, settings: Settings) -> dict[str, int]:
        """Return all scenes of all splits."""
        return {split: settings.split(split).scenes for split in settings.used_splits()}

    def views(self, item: Work, settings: Settings) -> int:
        """Return the capture's random number of views."""
        low, high = settings.pseudo_capture.views
        rng = generator(settings.seed, item.split, item.index, STREAM, "views")
        return int(rng.integers(low, high + 1))

    def bytes(self, item: Work, settings: Settings) -> int:
        """Return the bytes of photos, true views, maps of held-out views, and lights."""
        wanted, views = settings.pseudo_capture, self.views(item, settings)
        held_out = -(-views // HELD_OUT)
        pixel = views * (PHOTO_BYTES + wanted.masks + TRUE_BYTES)
        pixel += held_out * (MAPS_BYTES + len(wanted.relights) * TRUE_BYTES)
        light = settings.environment_height**2 * 2 * 12
        return pixel * wanted.width * wanted.height + views * 10_000 + light * (1 + len(wanted.relights))

    def shoot(self, stage: Stage, settings: Settings) -> None:
        """Write the truth, then the photos; frames and G-buffers are in memory together."""
        wanted, spec = settings.pseudo_capture, stage.spec
        names, cameras = list(stage.cameras), list(stage.cameras.values())
        seeds = [integer(spec.seed, spec.split, spec.index, STREAM, name, "path") for name in names]
        spp = wanted.path_spp if wanted.indoor_spp is None or not spec.metered else wanted.indoor_spp
        light, exposure = balanced(spec, stage.geometry, stage.environment, wanted, STREAM)
        stage = replace(stage, environment=light)
        lit = stage.geometry.lit(light)
        frames = render_frames(lit, cameras, spp, seeds, spec.path_bounces, transparent=True)
        buffers = dict(zip(names, gbuffers(stage.geometry, cameras)))
        shots = dict(zip(names, frames))
        phone = draw_phone(wanted, names, spec.seed, spec.split, spec.index, STREAM)

        true_capture = _true_capture(stage, shots, buffers, exposure, settings)
        told = {"exposure": exposure, **phone.described()}
        beside = {
            SPEC_NAME: spec.to_json().encode(),
            ENVIRONMENT_NAME: encode_exr(stage.environment.image, half=False),
            PHOTOGRAPHS_NAME: (json.dumps(told, indent=1) + "\n").encode(),
        }
        write_capture(settings.output_dir / TRUTH / spec.name, true_capture, overwrite=True, beside=beside)
        _write_photos(stage, phone, shots, buffers, exposure, settings)

    def require_whole(self, name: str, settings: Settings) -> None:
        """Raise TronError unless photos and truth can be read."""
        read_blind_capture(settings.output_dir / CAPTURES / name)
        read_capture_folder(settings.output_dir / TRUTH / name)


def before_light(frame: np.ndarray, environment: EnvironmentMap, camera: Camera) -> np.ndarray:
    """Composite a frame (H, W, 4) over the light behind it: linear radiance (H, W, 3)."""
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
    """Return about ``count`` points (N, 3) on surfaces in the photos, and their colours in the photos.

    Args:
        cameras, buffers, photos: by the names of the photos: true cameras, true surfaces, display values.
        count: number of points, evenly over the photos.
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
    stage: Stage,
    shots: Mapping[str, np.ndarray],
    buffers: Mapping[str, GBufferView],
    exposure: float,
    settings: Settings,
) -> Capture:
    """Return all views in linear light; held-out views have maps."""
    spec, geometry, cameras = stage.spec, stage.geometry, stage.cameras
    scene, views = geometry.lit(stage.environment), []
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
    stage: Stage,
    phone: Phone,
    shots: Mapping[str, np.ndarray],
    buffers: Mapping[str, GBufferView],
    exposure: float,
    settings: Settings,
) -> None:
    """Photograph the frames, and write the capture for reconstructions."""
    path, spec, cameras = settings.output_dir / CAPTURES / stage.spec.name, stage.spec, stage.cameras
    wanted, noise = settings.pseudo_capture, settings.pseudo_capture.pose_noise
    photos, poses = {}, {}
    distance = median_distance(cameras, buffers)
    for name, camera in cameras.items():
        stream = (spec.split, spec.index, STREAM, name)
        light = exposure * before_light(shots[name], stage.environment, camera)
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
        files = {name: encode_jpeg(photo, JPEG_QUALITY) for name, photo in photos.items()}
    masks = {name: encode_png(shots[name][..., 3:]) for name in cameras} if wanted.masks else None
    write_blind_capture(path, poses, files, ".png" if wanted.file == "png" else ".jpg", points, masks)


def median_distance(cameras: Mapping[str, Camera], buffers: Mapping[str, GBufferView]) -> float:
    """Return the median camera-to-surface distance over all pixels, world units; 1 without surfaces.

    Errors of poses are a share of it, because a world has no scale of its own.
    """
    found = [
        np.linalg.norm(buffers[name].position[buffers[name].valid] - camera.position, axis=-1)
        for name, camera in cameras.items()
    ]
    distances = np.concatenate(found)
    return float(np.median(distances)) if distances.size else 1.0


def disturbed(camera: Camera, rotation_deg: float, translation: float, rng: np.random.Generator) -> Camera:
    """Turn and move a camera by normal errors.

    Args:
        camera: the true one.
        rotation_deg: standard deviation of rotation about each of its axes, degrees.
        translation: standard deviation of its place along each axis, world units.
        rng: source of the errors; three and three are drawn.
    """
    turn = Rotation.from_rotvec(rng.normal(0.0, rotation_deg, 3), degrees=True).as_matrix()
    position = camera.position + rng.normal(0.0, translation, 3)
    matrix = np.eye(4)
    matrix[:3, :3] = turn @ camera.world_to_camera[:3, :3]
    matrix[:3, 3] = -matrix[:3, :3] @ position
    return replace(camera, world_to_camera=matrix)


IMAGES = "images"
MASKS = "masks"
POINTS_NAME = "sparse.ply"


def write_blind_capture(
    path: Path,
    cameras: Mapping[str, Camera],
    photos: Mapping[str, bytes],
    suffix: str,
    points: tuple[np.ndarray, np.ndarray] | None = None,
    masks: Mapping[str, bytes] | None = None,
) -> None:
    """Write the folder; it appears whole or not at all, and replaces the one that is there.

    Args:
        path: the folder.
        cameras: name of a photo -> its inexact camera.
        photos: name -> file.
        suffix: of the files, such as ".jpg".
        points: positions (N, 3), world, and display colours (N, 3).
        masks: name -> PNG file, if there are any.

    Raises:
        TronError: something else is at ``path``, or the disk refuses.
    """
    if path.exists() and not (path / TRANSFORMS_NAME).is_file():
        raise TronError("folder holds something else than a capture", path, "choose another output_dir")
    with atomic_folder(path) as folder:
        (folder / IMAGES).mkdir()
        for name, data in photos.items():
            (folder / IMAGES / f"{name}{suffix}").write_bytes(data)
        if masks:
            (folder / MASKS).mkdir()
            for name, data in masks.items():
                (folder / MASKS / f"{name}.png").write_bytes(data)
        if points is not None:
            (folder / POINTS_NAME).write_bytes(encode_points(*points))
        text = json.dumps(_transforms(cameras, suffix, points is not None), indent=1) + "\n"
        (folder / TRANSFORMS_NAME).write_bytes(text.encode())


def read_blind_capture(path: Path) -> Capture:
    """Read the capture as ordinary photos, at its own size.

    Raises:
        TronError: a photo in the list of poses is missing or damaged, or the folder is no capture.
    """
    capture = load_capture(path, LoadSettings(format="transforms"))
    for name, why in capture.skipped.items():
        raise TronError(why, f"{path}, photo {name}")
    return capture


def _transforms(cameras: Mapping[str, Camera], suffix: str, points: bool) -> dict[str, Any]:
    intrinsics = [_intrinsics(camera) for camera in cameras.values()]
    shared = intrinsics[0] if all(each == intrinsics[0] for each in intrinsics) else {}
    frames = [
        {
            "file_path": f"{IMAGES}/{name}{suffix}",
            **({} if shared else own),
            "transform_matrix": opencv_to_opengl(camera.camera_to_world).tolist(),
        }
        for (name, camera), own in zip(cameras.items(), intrinsics)
    ]
    named = {"ply_file_path": POINTS_NAME} if points else {}
    return {"camera_model": "PINHOLE", **shared, **named, "frames": frames}


def _intrinsics(camera: Camera) -> dict[str, float]:
    return {
        "fl_x": float(camera.fx),
        "fl_y": float(camera.fy),
        "cx": float(camera.cx),
        "cy": float(camera.cy),
        "w": camera.width,
        "h": camera.height,
    }
