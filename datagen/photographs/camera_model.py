"""Interface of the camera models of captures: their scenes, and the folders that they write.

Modes ``captures`` and ``pseudo_captures`` differ only in the camera model (``datagen.run.captures``). The
first is a perfect camera (``datagen.photographs.perfect``), with ``capture.photographs`` a photographer's
(``datagen.photographs.phone``); the other is a phone (``datagen.photographs.pseudo_captures``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from datagen.dataset.records import Work
from datagen.settings.captures import ViewSettings
from datagen.settings.command import Settings
from datagen.truth.build import Geometry
from datagen.truth.pathtrace import direct_irradiance, gbuffers, metered, render_frames
from datagen.world.scene import SceneSpec
from tron.cameras import Camera
from tron.captures import Capture, View
from tron.captures.folder import write_capture
from tron.errors import TronError
from tron.io.images import encode_exr
from tron.seeds import integer
from tron.shading.environments.environment import EnvironmentMap

HELD_OUT = 8
"""Each view of this distance is a test view, the first included, as COLMAP's captures are split."""

CAPTURES, TRUTH = "captures", "truth"
"""Folders within output_dir: of the captures, and of their truth where that is kept apart."""
RELIT = "relit"
"""Folder of the held-out views under lights that the photos never saw: the truth of relighting.

It holds a capture folder for each scene and light: linear radiance, coverage as the mask, irradiance, and
the light itself as environment.exr.
"""

ENVIRONMENT_NAME = "environment.exr"
SPEC_NAME = "spec.json"
PHOTOGRAPHS_NAME = "photographs.json"


@dataclass(frozen=True)
class Stage:
    """A scene ready for the camera.

    Attributes:
        spec, geometry: the scene and its meshes.
        environment: its light, baked.
        cameras: name of a view -> its true camera.
    """

    spec: SceneSpec
    geometry: Geometry
    environment: EnvironmentMap
    cameras: Mapping[str, Camera]


class CameraModel(Protocol):
    """A camera model that photographs scenes.

    Attributes:
        called: words for captures and views in messages.
        folders: folders in output_dir, captures first; the last has the recipe and the failures.
    """

    called: tuple[str, str]
    folders: tuple[str, ...]

    def settings(self, settings: Settings) -> ViewSettings:
        """Return this camera model's settings."""
        ...

    def recipe(self, settings: Settings) -> dict[str, Any]:
        """Return the keys that decide a capture's content, as plain values."""
        ...

    def scenes(self, settings: Settings) -> dict[str, int]:
        """Return split -> number of scenes to photograph."""
        ...

    def views(self, item: Work, settings: Settings) -> int:
        """Return the number of a capture's views."""
        ...

    def bytes(self, item: Work, settings: Settings) -> int:
        """Return the bytes of a capture on disk, without compression."""
        ...

    def shoot(self, stage: Stage, settings: Settings) -> None:
        """Write the folders of a capture, each whole or not at all; the capture itself is last.

        A second run writes the same bytes.

        Raises:
            TronError: a frame is not finite, or a folder cannot be written.
        """

    def require_whole(self, name: str, settings: Settings) -> None:
        """Raise TronError unless all folders of a capture exist and can be read."""


def view_names(count: int) -> list[str]:
    """Return the names of a capture's views, in order."""
    return [f"view_{number:05d}" for number in range(count)]


def held_out(cameras: Mapping[str, Camera]) -> dict[str, Camera]:
    """Return the held-out views, for judging reconstructions."""
    return dict(list(cameras.items())[::HELD_OUT])


def relit_cameras(
    spec: SceneSpec, cameras: Mapping[str, Camera], settings: ViewSettings
) -> dict[str, Camera]:
    """Return the cameras of relit views: the capture's held-out ones, or the scene's clip path."""
    if settings.film_frames is None:
        return held_out(cameras)
    film = spec.cameras.film.cameras(settings.film_frames, settings.width, settings.height)
    return {f"frame_{number:05d}": camera for number, camera in enumerate(film)}


def relit_folders(folder: Path, name: str, families: Sequence[str]) -> list[Path]:
    """Return the folders of a scene's relit views, one per light, such as ``relit/test-000000_1_sun``."""
    return [folder / f"{name}_{number}_{family}" for number, family in enumerate(families, start=1)]


def write_relit(
    folder: Path,
    spec: SceneSpec,
    geometry: Geometry,
    environments: Sequence[EnvironmentMap],
    cameras: Mapping[str, Camera],
    settings: ViewSettings,
) -> None:
    """Path-trace the views and their irradiance under each of the lights, and write a capture folder of each.

    Args:
        folder: parent of all folders.
        spec: the scene; names the random streams.
        geometry: its meshes.
        environments: one for each of ``settings.relights``.
        cameras: name of a view -> camera.
        settings: families of the lights, paths per pixel; whether true maps stand beside.

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
        frames = render_frames(
            scene, list(cameras.values()), settings.relight_spp, seeds, spec.path_bounces, transparent=True
        )
        shots = [straightened(frame, f"{name} of {path.name}") for name, frame in zip(cameras, frames)]
        direct = [
            direct_irradiance(geometry, scene, camera, settings.relight_spp, seed).shadowed
            for camera, seed in zip(cameras.values(), seeds)
        ]
        surfaces = [{}] * len(shots) if settings.film_frames is None else _surfaces(geometry, cameras)
        views = [
            View(name, camera, straight, "linear", mask=mask, irradiance=arriving, **maps)
            for (name, camera), (straight, mask), arriving, maps in zip(
                cameras.items(), shots, direct, surfaces, strict=True
            )
        ]
        exposure = shown_with(spec, environment, frames)
        capture = Capture(tuple(views), up=np.array([0.0, 0.0, 1.0]), exposure=exposure)
        beside = {"environment.exr": encode_exr(environment.image, half=False)}
        path.parent.mkdir(parents=True, exist_ok=True)
        write_capture(path, capture, overwrite=True, beside=beside)


def _surfaces(geometry: Geometry, cameras: Mapping[str, Camera]) -> list[dict[str, np.ndarray]]:
    """Return true base color and normals of each view, zero off surfaces."""
    return [
        {
            "base_color": np.where(seen.valid[..., None], seen.base_color, 0),
            "normal": np.where(seen.valid[..., None], seen.normal, 0),
        }
        for seen in gbuffers(geometry, list(cameras.values()))
    ]


def shown_with(spec: SceneSpec, environment: EnvironmentMap, frames: np.ndarray) -> float:
    """Return the exposure of views under a light: the light's own; indoors, metered on surfaces.

    Args:
        spec: the scene; it decides whether exposure is metered.
        environment: the light.
        frames: (K, H, W, 4) linear radiance and coverage.
    """
    exposure = environment.exposure()
    return metered(frames[..., :3], frames[..., 3] >= 1, exposure) if spec.metered else exposure


def straightened(frame: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Unpremultiply linear radiance with coverage (H, W, 4): straight radiance (H, W, 3), mask (H, W).

    The tone curve is not linear, so this comes before it: the rim of an object then has the object's colours,
    not darker ones. Uncovered pixels are black.

    Raises:
        TronError: the frame is not finite, which the tone curve would hide.
    """
    bad = int((~np.isfinite(frame)).sum())
    if bad:
        raise TronError(f"the path-traced frame has {bad} values that are not finite", where)
    mask = np.clip(frame[..., 3], 0.0, 1.0)
    covered = mask[..., None] > 0
    return np.where(covered, frame[..., :3] / np.where(covered, mask[..., None], 1.0), 0.0), mask
