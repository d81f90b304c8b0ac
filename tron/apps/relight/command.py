"""tron-relight: a Gaussian scene under new lights, along a camera path.

Three passes over the frames, each from the files of the one before it, so that a run that was cut short goes
on where it stopped: guidance (linear EXR, and PNG to look at), the neural renderer where there is one, and
videos. Several lights share the scene and what each camera sees of it.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from tron.apps.relight.clip import Clip, trace
from tron.apps.relight.network import averaged_frames_of, chosen_network, describe_network, shown_guidance
from tron.apps.relight.settings import Settings
from tron.apps.scene_file import require_file
from tron.cameras import Camera
from tron.cli.progress import track, working
from tron.denoising import require
from tron.editing.models import foot_of, read_model
from tron.editing.motion import Motion
from tron.editing.moving import MovingScene, in_motion
from tron.errors import TronError
from tron.gaussians.formats.registry import check_header, refuse_foreign
from tron.io.cameras.registry import UPRIGHT
from tron.neural.shipped import SHIPPED, checkpoint_file
from tron.runtime import activate
from tron.scans.camera_files import CAMERAS, in_frame_of, read_cameras
from tron.scans.scan import LIGHT, Scan
from tron.storage import locked, require_free_space
from tron.trajectories import keyframed, turn_cameras

if TYPE_CHECKING:
    from tron.models.parts import Part
    from tron.neural.protocols import Renderer
    from tron.relighting.ground import Ground
    from tron.shading.environments.environment import EnvironmentMap

    Models = Sequence[Sequence[Part]]

log = logging.getLogger(__name__)


def run(settings: Settings) -> None:
    """Do what the command does; its ``main`` says what that is."""
    clock = _Clock()
    given = _read(settings)
    settings, lights = given.settings, given.settings.by_light()
    with working("reading the scene"):
        scan = Scan.open(
            settings.scene, up=settings.up, projection=settings.projection, materials=settings.materials,
            surroundings=settings.surroundings, seed=settings.seed, apart=settings.output_dir, track=track,
        )  # fmt: skip
    cameras = _cameras(given, scan)
    network = describe_network(settings, given.renderer, len(cameras))
    clips = _clips(given, scan, len(cameras))
    ground = scan.ground(cameras, settings.ground)
    meshes = _meshes(given, scan, ground)
    moving = _moving(given, scan, (len(cameras) - 1) / settings.fps, ground, meshes)
    clock.lap("loading")

    pixels = len(clips) * len(cameras) * math.prod(settings.size)
    require_free_space(settings.output_dir, pixels * 6 * (len(clips[0].folder.buffers) + 3))
    log.info(clips[0].picture.describe())
    with locked(settings.output_dir):
        for light, clip in zip(lights, clips):
            clip.folder.claim(light.made_with(len(cameras), scan.turn[2]), settings.overwrite)
        with working("surfels of the models") if meshes else nullcontext():
            lit = scan.relighter(settings.estimation(), ground=ground, proxy=settings.proxy, meshes=meshes)
        trace(lit, cameras, clips, settings.seed, moving, settings.fps)
        clock.lap("guidance")
        if given.renderer is not None:
            averaged = averaged_frames_of(settings, len(cameras))
            for clip in clips:
                tuned = settings.window, settings.overlap, settings.weights
                clip.draw(given.renderer, *tuned, cameras, averaged)
            clock.lap("neural")
        with working("videos and contact sheets"):
            for light, clip in zip(lights, clips):
                clip.assemble(light.output_dir, settings.fps)
        clock.lap("videos")
        for light, clip in zip(lights, clips):
            clip.report(light, scan, cameras, clock.laps, network)


@dataclass(frozen=True)
class _Given:
    """All that a run reads beside the scan: cameras in their own frame; maps by files, a motion's too."""

    settings: Settings
    renderer: Renderer | None
    cameras: list[Camera] | None
    motion: Motion | None
    models: Models
    maps: Mapping[Path, EnvironmentMap]


def _read(settings: Settings) -> _Given:
    """Find and read everything that can be wrong before the scan, which takes longer."""
    from tron.shading.environments.environment import EnvironmentMap  # Mitsuba: not for --help

    if settings.denoiser is not None:
        require(settings.denoiser, f"denoise={settings.denoiser}")
    _check_paths(settings)
    settings = settings.shaped()
    file, cameras = settings.cameras, None
    if file is not None:
        cameras = read_cameras(file, *settings.size, settings.fps)
    if settings.trajectory == "keyframes":
        if cameras is None:
            raise TronError("trajectory=keyframes has none", mend="give cameras=FILE")
        cameras = keyframed(cameras, settings.frames)
    motion = None if settings.motion is None else Motion.read(settings.motion)
    moving = () if motion is None else motion.maps
    for environment in moving:
        require_file(environment, f"{settings.motion} names it")
    named = track(settings.meshes, "reading the models") if settings.meshes else ()
    models = [read_model(each.file) for each in named]
    with working("reading the lights and the network"):
        files = dict.fromkeys((*(light.light for light in settings.by_light()), *moving))
        maps = {path: EnvironmentMap.load(path) for path in files}
        activate(settings.variant, settings.threads)
        settings, renderer = chosen_network(settings)
    return _Given(settings, renderer, cameras, motion, models, maps)


def _check_paths(settings: Settings) -> None:
    """Every file is there and is of its kind as far as names and headers tell, before anything is loaded."""
    lights, models = [each.light for each in settings.by_light()], [each.file for each in settings.meshes]
    asked = None if settings.takes_default else settings.checkpoint  # the default may be missing
    checkpoint = None if asked is None else checkpoint_file(asked)
    given = (settings.scene, *lights, *models, settings.cameras, settings.motion, checkpoint, settings.vae)
    for path in (path for path in given if path is not None):
        names = f"checkpoints of the package are {', '.join(SHIPPED)}" if path == checkpoint else ""
        if path.name == LIGHT:
            names = "tron-reconstruct writes it beside its scene: the light of the capture"
        require_file(path, names)
    if settings.output_dir.exists() and not settings.output_dir.is_dir():
        raise TronError("output_dir is a file", settings.output_dir, "give a folder, which need not exist")
    refuse_foreign(settings.scene)
    check_header(settings.scene)


def _cameras(given: _Given, scan: Scan) -> list[Camera]:
    """Cameras of the film, upright."""
    settings, file, cameras = given.settings, given.settings.cameras, given.cameras
    if cameras is not None and file is not None:
        cameras = in_frame_of(scan.offset, cameras, file)
    with working("looking for surroundings"):
        _ = scan.content
    if cameras is not None and file is not None:
        return cameras if file.suffix.lower() in UPRIGHT else turn_cameras(cameras, scan.turn)
    assert settings.trajectory != "keyframes"
    assert settings.fov is not None
    if scan.filmed is not None and settings.trajectory in ("orbit", "still"):
        beside = settings.scene.with_name(CAMERAS)
        whose = str(beside) if beside.is_file() else "its one view"
        log.info("the orbit stays between the %d cameras of %s", len(scan.filmed), whose)
    return scan.film(settings.trajectory, settings.frames, *settings.size, settings.fov, settings.distance)


def _clips(given: _Given, scan: Scan, frames: int) -> list[Clip]:
    """A clip for each light."""
    settings, maps = given.settings, {path: scan.over(each, path) for path, each in given.maps.items()}
    guidance = shown_guidance(settings, given.renderer)
    averaged = averaged_frames_of(settings, frames) > 1
    clips = [Clip.of(each, maps[each.light], frames, guidance, averaged) for each in settings.by_light()]
    if given.motion is not None:
        for clip in clips:
            clip.follow(given.motion, settings.fps, maps)
    return clips


def _meshes(given: _Given, scan: Scan, ground: Ground | None) -> list[list[Part]]:
    """The models where they stand."""
    if ground is not None:
        height = ground.height + float(scan.turn[2] @ scan.offset)
        log.info("it stands on a ground at height %.4g; ground=none takes it away", height)
    named, height = given.settings.meshes, ground and ground.height
    placing = track(named, "placing the models") if named else ()
    return [each.stood(parts, scan.content, scan.turn, height) for each, parts in zip(placing, given.models)]


def _moving(
    given: _Given, scan: Scan, end: float, ground: Ground | None, meshes: Models
) -> MovingScene | None:
    """The scan in motion until ``end``, seconds, with the models that stand in it; None: all stands still."""
    motion, fps = given.motion, given.settings.fps
    if motion is None:
        return None
    if scan.offset.any():
        log.info("coordinates of the motion are about %s", scan.offset.tolist())
    if motion.end > end:
        shows = motion.end, end, math.ceil(motion.end * fps) + 1
        log.info("the motion lasts %g s, the film %g s: frames=%d shows all of it", *shows)
    with working("what moves"):
        height, feet = ground and ground.height, [foot_of(parts, scan.content.up) for parts in meshes]
        return in_motion(motion, scan.scene, end, scan.turn, height, scan.backdrop, feet)


@dataclass
class _Clock:
    """Seconds of each part of a run."""

    laps: dict[str, float] = field(default_factory=dict)
    last: float = field(default_factory=time.perf_counter)

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name], self.last = round(now - self.last, 3), now
