"""The truth of relighting: held-out views of a capture, path-traced under lights that its photos never saw.

``output_dir/relit`` holds a capture folder for each scene and light: linear radiance, coverage as the mask,
and the light itself as environment.exr.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from datagen.build import Geometry
from datagen.capture_manifest import CaptureManifest
from datagen.capture_settings import ViewSettings
from datagen.exposure import metered
from datagen.pathtrace import render_frames
from datagen.scene import SceneSpec
from tron.cameras import Camera
from tron.captures import Capture, View
from tron.captures.folder import write_capture
from tron.errors import TronError
from tron.images import encode_exr
from tron.seeds import integer
from tron.shading.environment import EnvironmentMap

RELIT = "relit"
"""Folder of the relit views within output_dir."""


def relit_folders(folder: Path, name: str, families: Sequence[str]) -> list[Path]:
    """Folders of a scene's held-out views under each of the lights, such as ``relit/test-000000_1_sun``."""
    return [folder / f"{name}_{number}_{family}" for number, family in enumerate(families, start=1)]


def write_relit(
    folder: Path,
    spec: SceneSpec,
    geometry: Geometry,
    environments: Sequence[EnvironmentMap],
    cameras: Mapping[str, Camera],
    settings: ViewSettings,
) -> None:
    """Path-trace the views under each of the lights, and write a capture folder of each.

    Args:
        folder: the one that they share.
        spec: the scene; names the random streams.
        geometry: its meshes.
        environments: one for each of ``settings.relights``.
        cameras: name of a view -> camera.
        settings: families of the lights, paths per pixel.

    Raises:
        TronError: a frame is not finite, or a folder cannot be written.
    """
    for number, (path, environment) in enumerate(
        zip(relit_folders(folder, spec.name, settings.relights), environments), start=1
    ):
        scene = geometry.lit(environment)
        seeds = [
            integer(spec.seed, spec.split, spec.index, "relit", number, name, "path") for name in cameras
        ]
        frames = render_frames(scene, list(cameras.values()), settings.relight_spp, seeds, transparent=True)
        shots = [straightened(frame, f"{name} of {path.name}") for name, frame in zip(cameras, frames)]
        views = [
            View(name, camera, straight, "linear", mask=mask)
            for (name, camera), (straight, mask) in zip(cameras.items(), shots)
        ]
        exposure = shown_with(spec, environment, frames)
        capture = Capture(tuple(views), up=np.array([0.0, 0.0, 1.0]), exposure=exposure)
        beside = {"environment.exr": encode_exr(environment.image, half=False)}
        path.parent.mkdir(parents=True, exist_ok=True)
        write_capture(path, capture, overwrite=True, beside=beside)


def record_relit(folder: Path, names: Sequence[str], families: Sequence[str]) -> None:
    """Take down the files of the relit views of some scenes, where there are any lights."""
    if not families:
        return
    manifest = CaptureManifest.load(folder)
    for name in names:
        for path in relit_folders(folder, name, families):
            manifest.record(path)
    manifest.save(folder)


def shown_with(spec: SceneSpec, environment: EnvironmentMap, frames: np.ndarray) -> float:
    """Exposure of views under a light: the light's own; indoors, that of what covers their pixels.

    Args:
        spec: of the scene; says whether it is metered.
        environment: the light.
        frames: (K, H, W, 4) linear radiance and coverage.
    """
    exposure = environment.exposure()
    return metered(frames[..., :3], frames[..., 3] >= 1, exposure) if spec.metered else exposure


def straightened(frame: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Premultiplied linear radiance and coverage (H, W, 4) -> straight radiance (H, W, 3), mask (H, W).

    The tone curve bends, so colours are straightened before it: the rim of an object has the object's
    colours, not darker ones. What is not covered is black.

    Raises:
        TronError: the frame is not finite, which the tone curve would hide.
    """
    bad = int((~np.isfinite(frame)).sum())
    if bad:
        raise TronError(f"the path-traced frame has {bad} values that are not finite", where)
    mask = np.clip(frame[..., 3], 0.0, 1.0)
    covered = mask[..., None] > 0
    return np.where(covered, frame[..., :3] / np.where(covered, mask[..., None], 1.0), 0.0), mask
