"""tron-relight: a Gaussian scene under new lights, along a camera path.

Three passes over the frames, each from the files of the one before it, so that a run that was cut short goes
on where it stopped: guidance (linear EXR, and PNG to look at), the neural renderer where there is one, and
videos. Several lights share the scene and what each camera sees of it.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

import tron
from tron.apps.camera_files import read_cameras
from tron.apps.clip import DEPTH, Clip, trace
from tron.apps.filmed_space import CAMERAS, filmed_cameras, filmed_orbit
from tron.apps.frame_folder import FrameFolder
from tron.apps.framing import plan_cameras, turn_cameras, upright
from tron.apps.relight_network import averaged_frames_of, chosen_network, describe_network
from tron.apps.relight_settings import Settings
from tron.apps.relit import RelitPicture
from tron.cameras import Camera
from tron.cli.command_line import command
from tron.cli.recipes import model_defaults
from tron.errors import TronError
from tron.gaussians.foreign_files import refuse_foreign
from tron.gaussians.ply import check_header
from tron.gaussians.scene import GaussianScene
from tron.neural.shipped import SHIPPED, checkpoint_file
from tron.runtime import activate, describe_machine
from tron.shards.schema import GUIDANCE
from tron.storage import locked, require_free_space, sha256, write_atomic

if TYPE_CHECKING:
    from tron.shading.environment import EnvironmentMap

log = logging.getLogger(__name__)


def main(settings: Settings) -> None:
    """Light a Gaussian scene with environment maps and film it along a camera path.

    Writes frames/NNNN.relit.png, relit.mp4 (the neural renderer's pictures where there is a checkpoint,
    otherwise shadows, reflections and the light that bounces between the surfels), what they are made of as
    frames/NNNN.{pbr,irradiance,...}.exr (linear) and .png (AgX), guidance.mp4, contact_sheet.png and
    relight.json; with a checkpoint also NNNN.neural.png and neural.mp4. An interrupted run resumes when it is
    started again.
    """
    from tron.shading.environment import EnvironmentMap  # Mitsuba: not for --help or a mistyped key

    clock = _Clock()
    lights = settings.by_light()
    _check_paths(settings, lights)
    size = settings.width, settings.height
    given = None if settings.cameras is None else read_cameras(settings.cameras, *size)
    environments = [EnvironmentMap.load(light.light) for light in lights]
    settings, renderer = chosen_network(settings)
    lights = settings.by_light()
    scene = _load_scene(settings)
    turn = upright(scene.up)  # to +z, which is up in environment maps
    scene = scene if np.allclose(turn, np.eye(3)) else scene.rotated(turn)
    if given is not None:
        cameras = turn_cameras(given, turn)
    else:
        cameras = _planned(settings, scene, turn)
    activate(settings.variant, settings.threads)
    # Without a network the relit picture is one of them, and is shown as such; so is lit if nothing bounces.
    guidance = [name for name in GUIDANCE if name != settings.source and (settings.bounces or name != "lit")]
    guidance = guidance if renderer is None else renderer.config.guidance
    averaged = averaged_frames_of(settings, len(cameras))
    network = describe_network(settings, renderer, len(cameras))
    clips = [_clip(*each, len(cameras), guidance, averaged > 1) for each in zip(lights, environments)]
    clock.lap("loading")

    pixels = len(clips) * len(cameras) * settings.width * settings.height
    require_free_space(settings.output_dir, pixels * 6 * (len(clips[0].folder.buffers) + 3))
    log.info(clips[0].picture.describe())
    with locked(settings.output_dir):
        for light, clip in zip(lights, clips):
            clip.folder.claim(_made_with(light, cameras, turn), settings.overwrite, model_defaults(Settings))
        trace(scene, cameras, clips, estimation=settings.estimation(), seed=settings.seed)
        clock.lap("guidance")
        if renderer is not None:
            for clip in clips:
                tuned = settings.window, settings.overlap, settings.weights
                clip.draw(renderer, *tuned, cameras, averaged)
            clock.lap("neural")
        for light, clip in zip(lights, clips):
            clip.assemble(light.output_dir, settings.fps)
        clock.lap("videos")
        for light, clip in zip(lights, clips):
            report = _report(light, clip, scene, turn_cameras(cameras, turn.T), clock)
            report["network"] = network
            write_atomic(light.output_dir / "relight.json", json.dumps(report, indent=1) + "\n")
            made = len(cameras), len(clip.seconds), light.output_dir / "relit.mp4"
            log.info("%d frames, %d of them rendered now: look at %s", *made)


def _planned(settings: Settings, scene: GaussianScene, turn: np.ndarray) -> list[Camera]:
    """The camera path that the settings name, in the world in which up is +z."""
    view = {
        "width": settings.width,
        "height": settings.height,
        "fov_deg": settings.fov,
        "distance": settings.distance,
    }
    filmed = None
    if settings.trajectory in ("orbit", "still"):
        try:
            filmed = filmed_cameras(settings.scene)
        except TronError as error:
            log.warning("%s; the orbit is planned without it", error)
    if filmed is None:
        return plan_cameras(scene, settings.trajectory, settings.frames, **view)
    log.info("the orbit stays between the %d cameras of %s", len(filmed), settings.scene.with_name(CAMERAS))
    filmed = turn_cameras(filmed, turn)
    if settings.trajectory == "orbit":
        return filmed_orbit(filmed, settings.frames, up=scene.up, **view)
    return filmed_orbit(filmed, 1, up=scene.up, **view) * settings.frames


class _Clock:
    """Seconds of each part of a run."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = round(now - self._last, 3)
        self._last = now


def _check_paths(settings: Settings, lights: Sequence[Settings]) -> None:
    """Every file is there and is of its kind as far as names and headers tell, before anything is loaded."""
    maps = [light.light for light in lights]
    # The default checkpoint is no mistake where it is missing.
    asked = None if settings.takes_default else settings.checkpoint
    checkpoint = None if asked is None else checkpoint_file(asked)
    for path in (settings.scene, *maps, settings.cameras, checkpoint, settings.vae):
        if path is not None and not path.is_file():
            if path.is_dir():
                raise TronError("cannot read: is a folder", path, "give one file of it")
            names = f"checkpoints of the package are {', '.join(SHIPPED)}" if path == checkpoint else ""
            raise TronError("file not found", path, names)
    if settings.output_dir.exists() and not settings.output_dir.is_dir():
        raise TronError("output_dir is a file", settings.output_dir, "give a folder, which need not exist")
    refuse_foreign(settings.scene)
    check_header(settings.scene)


def _load_scene(settings: Settings) -> GaussianScene:
    scene = GaussianScene.load(settings.scene)
    if scene.materials_guessed:
        log.warning(
            "%s has no materials%s: they are guessed from its colours, which keep the light it was captured "
            "in; tron-reconstruct capture=%s output_dir=OUT finds surfaces, materials and light",
            settings.scene, "" if scene.oriented else " and normals without a sign", settings.scene,
        )  # fmt: skip
    if settings.up is not None:
        scene.up = np.array(settings.up) / np.linalg.norm(settings.up)
    elif scene.up_guessed:
        log.warning(
            "%s does not say which way is up: -y is taken, as in most 3DGS files; up=[0,0,1] (or another "
            "direction) changes it",
            settings.scene,
        )
    return scene


def _clip(
    light: Settings, environment: EnvironmentMap, frames: int, guidance: Sequence[str], averaged: bool
) -> Clip:
    picture = RelitPicture(light.background, light.source)
    needed = (*guidance, *picture.buffers, *light.buffers, *([DEPTH] if averaged else []))
    buffers = [name for name in needed if name != "relit"]
    return Clip(
        environment=environment,
        rotations=light.rotations(frames),
        exposure=environment.exposure() if light.exposure == "auto" else light.exposure,
        picture=picture,
        folder=FrameFolder(light.output_dir / "frames", tuple(dict.fromkeys(buffers))),
        guidance=guidance,
        keeps_linear="relit" in light.buffers,
    )


def _made_with(light: Settings, cameras: Sequence[Camera], turn: np.ndarray) -> dict[str, Any]:
    """Recipe of the linear frames: all that their pixels depend on, as JSON values."""
    filmed = light.scene.with_name(CAMERAS)
    keys = {"rotation", "trajectory", "quality", "width", "height", "fov", "distance", "seed", "variant"}
    return {
        "scene_sha256": sha256(light.scene),
        "environment_sha256": sha256(light.light),
        "filmed_sha256": sha256(filmed) if light.cameras is None and filmed.is_file() else None,
        "cameras_sha256": None if light.cameras is None else sha256(light.cameras),
        "frames": len(cameras),
        "up": [round(float(value), 6) for value in turn[2]],
        **light.model_dump(mode="json", include=keys),
        **light.estimation().model_dump(mode="json"),
        "version": tron.__version__,
    }


def _report(
    light: Settings, clip: Clip, scene: GaussianScene, cameras: Sequence[Camera], clock: _Clock
) -> dict[str, Any]:
    return {
        "version": tron.__version__,
        "settings": light.model_dump(mode="json"),
        "relit": clip.picture.source,
        "scene": {
            "surfels": len(scene),
            "kernel_degree": scene.kernel_degree,
            "spacing": scene.spacing,
            "materials_guessed": scene.materials_guessed,
            "oriented": scene.oriented,
        },
        "exposure": clip.exposure,
        "frames": len(cameras),
        "frames_rendered": len(clip.seconds),
        "first_frame_seconds": clip.seconds[0] if clip.seconds else None,
        "frame_seconds_median": float(np.median(clip.seconds)) if clip.seconds else None,
        "seconds": clock.laps,
        "machine": describe_machine(),
        "rotations": list(clip.rotations),
        "cameras": [camera.to_dict() for camera in cameras],
    }


cli = command(
    "tron-relight",
    "conf.relight",
    Settings,
    main,
    examples=(
        "tron-relight scene=surfels.ply environment=studio.hdr output_dir=outputs/relit",
        "tron-relight scene=surfels.ply environment=studio.hdr quality=final reflections=16 output_dir=out",
        "tron-relight scene=scan.ply up=[0,0,1] environment=[dawn.hdr,night.hdr] output_dir=out",
        "tron-relight scene=surfels.ply environment=a.hdr trajectory=still rotation=[0,360] output_dir=out",
        "tron-relight scene=surfels.ply environment=a.hdr background=transparent output_dir=out",
        "tron-relight scene=surfels.ply environment=a.hdr checkpoint=renderer.safetensors output_dir=out",
        "tron-relight scene=surfels.ply environment=a.hdr checkpoint=pair overlap=newest "
        "'weights={pbr: 0.3, irradiance: 0.7}' output_dir=out",
    ),
)

if __name__ == "__main__":
    cli()
