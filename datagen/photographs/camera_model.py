"""What every camera model of captures can do: which scenes it is held to, and what it writes of one.

Modes ``captures`` and ``pseudo_captures`` differ in nothing else (``datagen.run.captures``). The first is a
perfect camera (``datagen.photographs.perfect``), with ``capture.photographs`` a photographer's
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
    """A scene before the camera.

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
    """A camera that scenes are photographed with.

    Attributes:
        called: captures and views in a message.
        folders: within output_dir, of the captures first; the last holds the recipe and what failed.
    """

    called: tuple[str, str]
    folders: tuple[str, ...]

    def settings(self, settings: Settings) -> ViewSettings:
        """Its own settings among all."""
        ...

    def recipe(self, settings: Settings) -> dict[str, Any]:
        """Keys that decide a capture's content, as plain values."""
        ...

    def scenes(self, settings: Settings) -> dict[str, int]:
        """Split -> number of its scenes that it is held to."""
        ...

    def views(self, item: Work, settings: Settings) -> int:
        """Number of a capture's views."""
        ...

    def bytes(self, item: Work, settings: Settings) -> int:
        """Bytes on disk of a capture, as if nothing compressed."""
        ...

    def shoot(self, stage: Stage, settings: Settings) -> None:
        """Write the folders of a capture, each whole or not at all, the captures' last.

        A second run writes the same bytes.

        Raises:
            TronError: a frame is not finite, or a folder cannot be written.
        """

    def require_whole(self, name: str, settings: Settings) -> None:
        """Raise TronError unless the folders of a capture are there and can be read."""


def view_names(count: int) -> list[str]:
    """Names of a capture's views, in order."""
    return [f"view_{number:05d}" for number in range(count)]


def held_out(cameras: Mapping[str, Camera]) -> dict[str, Camera]:
    """Those of the views that reconstructions are judged by."""
    return dict(list(cameras.items())[::HELD_OUT])


def relit_cameras(
    spec: SceneSpec, cameras: Mapping[str, Camera], settings: ViewSettings
) -> dict[str, Camera]:
    """Cameras that other lights are shown to: the held-out ones of a capture, or the scene's own film."""
    if settings.film_frames is None:
        return held_out(cameras)
    film = spec.cameras.film.cameras(settings.film_frames, settings.width, settings.height)
    return {f"frame_{number:05d}": camera for number, camera in enumerate(film)}


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
    """Path-trace the views and their irradiance under each of the lights, and write a capture folder of each.

    Args:
        folder: the one that they share.
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
    """True base color and normals of each view, zero where there is no surface."""
    return [
        {
            "base_color": np.where(seen.valid[..., None], seen.base_color, 0),
            "normal": np.where(seen.valid[..., None], seen.normal, 0),
        }
        for seen in gbuffers(geometry, list(cameras.values()))
    ]


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
