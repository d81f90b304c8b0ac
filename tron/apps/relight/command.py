"""tron-relight: a Gaussian scene under new lights, along a camera path.

Three passes over the frames, each from the files of the one before it, so that a run that was cut short goes
on where it stopped: guidance (linear EXR, and PNG to look at), the neural renderer where there is one, and
videos. Several lights share the scene and what each camera sees of it.
"""

from __future__ import annotations

import json
import logging
import math
import time
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import tron
from tron.apps.frame_folder import FrameFolder
from tron.apps.relight.clip import DEPTH, Clip, trace
from tron.apps.relight.settings import Settings
from tron.apps.relit import RelitPicture
from tron.cameras import Camera
from tron.cli.command_line import command
from tron.cli.installation import require_extra
from tron.cli.progress import track, working
from tron.cli.recipes import model_defaults
from tron.denoising import require_oidn
from tron.editing.models import PlacedModel, foot_of, read_model
from tron.editing.motion import Motion
from tron.editing.moving import in_motion
from tron.errors import TronError, located
from tron.gaussians.formats.registry import check_header, refuse_foreign
from tron.gaussians.scene import GaussianScene
from tron.io.cameras.registry import UPRIGHT
from tron.io.recognised import refuse_by_sight
from tron.neural.clips import check_frames
from tron.neural.network_gains import Way, best_first, quality_of
from tron.neural.shipped import DEFAULT, SHIPPED, checkpoint_file
from tron.runtime import activate, describe_machine, set_torch_threads, torch_device
from tron.scans import Scan
from tron.scans.camera_files import CAMERAS, filmed_orbit, in_frame_of, read_cameras, stated
from tron.scans.scan import LIGHT, is_of_capture
from tron.shards.schema import GUIDANCE
from tron.storage import locked, require_free_space, sha256, write_atomic
from tron.trajectories import keyframed, plan_cameras, turn_cameras

if TYPE_CHECKING:
    from tron.neural.protocols import Renderer
    from tron.shading.environments.environment import EnvironmentMap


log = logging.getLogger(__name__)

TITLES: dict[Way, str] = {"network": DEFAULT, "oidn": "Open Image Denoise"}


def main(settings: Settings) -> None:
    """Light a Gaussian scene with environment maps and film it along a camera path.

    Writes frames/NNNN.relit.png, relit.mp4 (the neural renderer's pictures where there is a checkpoint,
    otherwise shadows, reflections and the light that bounces between the surfels), what they are made of as
    frames/NNNN.{pbr,irradiance,...}.exr (linear) and .png (AgX), guidance.mp4, contact_sheet.png and
    relight.json; with a checkpoint also NNNN.neural.png and neural.mp4. An interrupted run resumes when it is
    started again.
    """
    from tron.shading.environments.environment import (
        EnvironmentMap,  # Mitsuba: not for --help or a mistyped key
    )

    clock = _Clock()
    if settings.denoise == "oidn":
        require_oidn("denoise=oidn")
    _check_paths(settings, settings.by_light())
    settings = settings.shaped()
    lights = settings.by_light()
    given = None if settings.cameras is None else read_cameras(settings.cameras, *settings.size, settings.fps)
    if settings.trajectory == "keyframes":
        if given is None:
            raise TronError("trajectory=keyframes has none", mend="give cameras=FILE")
        given = keyframed(given, settings.frames)
    motion = None if settings.motion is None else _motion(settings.motion)
    named = track(settings.meshes, "reading the models") if settings.meshes else ()
    models = [read_model(each.file) for each in named]
    with working("reading the lights and the network"):
        environments = [EnvironmentMap.load(light.light) for light in lights]
        others = {} if motion is None else {path: EnvironmentMap.load(path) for path in motion.maps}
        activate(settings.variant, settings.threads)
        settings, renderer = chosen_network(settings)
        lights = settings.by_light()
    with working("reading the scene"):
        scan = Scan.open(
            settings.scene, up=settings.up, projection=settings.projection, materials=settings.materials,
            surroundings=settings.surroundings, seed=settings.seed, apart=settings.output_dir, track=track,
        )  # fmt: skip
    offset, turn = scan.offset, scan.turn
    if given is not None and settings.cameras is not None:
        given = in_frame_of(offset, given, settings.cameras)
    environments = [scan.over(each, light.light) for light, each in zip(lights, environments)]
    others = {path: scan.over(each, path) for path, each in others.items()}
    with working("looking for surroundings"):
        content = scan.content
    if given is not None:
        upright_file = settings.cameras is not None and settings.cameras.suffix.lower() in UPRIGHT
        cameras = given if upright_file else turn_cameras(given, turn)
    else:
        cameras = _planned(settings, content, scan.filmed)
    # Without a network the relit picture is one of them, and is shown as such; so is lit if nothing bounces.
    guidance = [name for name in GUIDANCE if name != settings.source and (settings.bounces or name != "lit")]
    guidance = guidance if renderer is None else renderer.config.guidance
    averaged = averaged_frames_of(settings, len(cameras))
    network = describe_network(settings, renderer, len(cameras))
    clips = [_clip(*each, len(cameras), guidance, averaged > 1) for each in zip(lights, environments)]
    ground = scan.ground(cameras, settings.ground)
    if ground is not None:
        height = ground.height + float(turn[2] @ offset)
        log.info("it stands on a ground at height %.4g; ground=none takes it away", height)
    placing = track(settings.meshes, "placing the models") if settings.meshes else ()
    meshes = [
        each.stood(parts, content, turn, ground and ground.height) for each, parts in zip(placing, models)
    ]
    times, moving = [index / settings.fps for index in range(len(cameras))], None
    if motion is not None:
        if offset.any():
            log.info("coordinates of the motion are about %s", offset.tolist())
        if motion.end > times[-1]:
            log.info(
                "the motion lasts %g s, the film %g s: frames=%d shows all of it",
                motion.end, times[-1], math.ceil(motion.end * settings.fps) + 1,
            )  # fmt: skip
        with working("what moves"):
            height, feet = ground and ground.height, [foot_of(parts, content.up) for parts in meshes]
            moving = in_motion(motion, scan.scene, times[-1], turn, height, scan.backdrop, feet)
        for clip in clips:
            clip.lights, clip.others = [motion.light_at(time) for time in times], others
            clip.exposure = clip.first_exposure()
            clip.rotations = [a + b.rotation for a, b in zip(clip.rotations, clip.lights)]
    clock.lap("loading")

    pixels = len(clips) * len(cameras) * math.prod(settings.size)
    require_free_space(settings.output_dir, pixels * 6 * (len(clips[0].folder.buffers) + 3))
    log.info(clips[0].picture.describe())
    with locked(settings.output_dir):
        for light, clip in zip(lights, clips):
            clip.folder.claim(_made_with(light, cameras, turn), settings.overwrite, model_defaults(Settings))
        with working("surfels of the models") if meshes else nullcontext():
            lit = scan.relighter(settings.estimation(), ground=ground, proxy=settings.proxy, meshes=meshes)
        trace(lit, cameras, clips, settings.seed, moving, times)
        clock.lap("guidance")
        if renderer is not None:
            for clip in clips:
                tuned = settings.window, settings.overlap, settings.weights
                clip.draw(renderer, *tuned, cameras, averaged)
            clock.lap("neural")
        with working("videos and contact sheets"):
            for light, clip in zip(lights, clips):
                clip.assemble(light.output_dir, settings.fps)
        clock.lap("videos")
        for light, clip in zip(lights, clips):
            report = _report(light, clip, scan.scene, turn_cameras(cameras, turn.T), clock)
            report["network"] = network
            report |= stated(offset)
            write_atomic(light.output_dir / "relight.json", json.dumps(report, indent=1) + "\n")
            made = len(cameras), len(clip.seconds), light.output_dir / "relit.mp4"
            log.info("frames: %d, rendered now: %d; look at %s", *made)


def _motion(path: Path) -> Motion:
    """What moves; all that it names is there."""
    motion = Motion.read(path)
    for environment in motion.maps:
        if not environment.is_file():
            raise TronError("file not found", environment, f"{path} names it")
    return motion


def _planned(settings: Settings, scene: GaussianScene, filmed: list[Camera] | None) -> list[Camera]:
    """The camera path that the settings name, between the cameras that the scene was filmed with if any."""
    view = {
        "width": settings.width,
        "height": settings.height,
        "fov_deg": settings.fov,
        "distance": settings.distance,
    }
    assert settings.trajectory != "keyframes"
    if filmed is None or settings.trajectory not in ("orbit", "still"):
        return plan_cameras(scene, settings.trajectory, settings.frames, **view)
    beside = settings.scene.with_name(CAMERAS)
    whose = str(beside) if beside.is_file() else "its one view"
    log.info("the orbit stays between the %d cameras of %s", len(filmed), whose)
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
    models = [model.file for model in settings.meshes]
    given = (settings.scene, *maps, *models, settings.cameras, settings.motion, checkpoint, settings.vae)
    for path in given:
        if path is not None and not path.is_file():
            if path.is_dir():
                refuse_by_sight(path, "this should be a file")
                raise TronError("cannot read: is a folder", path, "give one file of it")
            names = f"checkpoints of the package are {', '.join(SHIPPED)}" if path == checkpoint else ""
            if path.name == LIGHT:
                names = "tron-reconstruct writes it beside its scene: the light of the capture"
            raise TronError("file not found", path, names)
    if settings.output_dir.exists() and not settings.output_dir.is_dir():
        raise TronError("output_dir is a file", settings.output_dir, "give a folder, which need not exist")
    refuse_foreign(settings.scene)
    check_header(settings.scene)


def _clip(
    light: Settings, environment: EnvironmentMap, frames: int, guidance: Sequence[str], averaged: bool
) -> Clip:
    picture = RelitPicture(light.background, light.source, light.look, light.denoise == "oidn")
    needed = (*guidance, *picture.buffers, *light.buffers, *([DEPTH] if averaged else []))
    buffers = [name for name in needed if name != "relit"]
    return Clip(
        environment=environment,
        rotations=light.rotations(frames),
        exposure=environment.exposure(),
        chosen=None if light.exposure == "auto" else light.exposure,
        picture=picture,
        folder=FrameFolder(light.output_dir / "frames", tuple(dict.fromkeys(buffers))),
        guidance=guidance,
        keeps_linear="relit" in light.buffers,
    )


def _made_with(light: Settings, cameras: Sequence[Camera], turn: np.ndarray) -> dict[str, Any]:
    """Recipe of the linear frames: all that their pixels depend on, as JSON values."""
    filmed = light.scene.with_name(CAMERAS)
    keys = {
        "rotation",
        "trajectory",
        "quality",
        "width",
        "height",
        "fov",
        "distance",
        "seed",
        "variant",
        "surroundings",
        "ground",
        "proxy",
        "projection",
        "materials",
    }
    return {
        "scene_sha256": sha256(light.scene),
        "environment_sha256": sha256(light.light),
        "filmed_sha256": sha256(filmed) if filmed.is_file() else None,
        "cameras_sha256": None if light.cameras is None else sha256(light.cameras),
        "frames": len(cameras),
        "up": [round(float(value), 6) for value in turn[2]],
        **light.model_dump(mode="json", include=keys),
        **light.estimation().model_dump(mode="json"),
        **({"denoise": light.denoise} if light.denoise == "oidn" else {}),  # else `filtered` says it
        **({"turned_with_scene": True} if is_of_capture(light.light, light.scene) else {}),
        **({} if light.motion is None else _motion_made_with(light.motion, light.fps)),
        **({} if not light.meshes else {"meshes": [_mesh_made_with(each) for each in light.meshes]}),
        "version": tron.__version__,
    }


def _motion_made_with(path: Path, fps: float) -> dict[str, Any]:
    return {"motion_sha256": [sha256(each) for each in (path, *Motion.read(path).maps)], "fps": fps}


def _mesh_made_with(model: PlacedModel) -> dict[str, Any]:
    return model.model_dump(mode="json", exclude={"file"}) | {"sha256": sha256(model.file)}


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
            "projection": scene.projection,
        },
        "exposure": clip.shown_exposure,
        "guidance_exposure": clip.exposure,
        "frames": len(cameras),
        "frames_rendered": len(clip.seconds),
        "first_frame_seconds": clip.seconds[0] if clip.seconds else None,
        "frame_seconds_median": float(np.median(clip.seconds)) if clip.seconds else None,
        "seconds": clock.laps,
        "machine": describe_machine(),
        "rotations": list(clip.rotations),
        "cameras": [camera.to_dict() for camera in cameras],
    }


def chosen_network(settings: Settings) -> tuple[Settings, Renderer | None]:
    """The settings as they will be followed, and the network on its device, or None without one.

    A checkpoint that was asked for has to fit. checkpoint=auto takes what surely gains most at that size and
    quality (:mod:`tron.neural.network_gains`): the shipped network, Open Image Denoise where it is
    installed and light bounces, or neither; a line in the log says which, and by how much. The network gives
    way where its libraries or its file are not installed; where nothing bounces and it is given lit; where
    denoise=oidn is. Radiance that is asked for stays as it was traced. Where window, overlap, reproject or
    weights are chosen, the network has to fit too.

    Raises:
        TronError: the checkpoint is missing, damaged, or does not fit the settings.
    """
    if settings.checkpoint is None:
        return settings, None
    if not settings.takes_default:
        return settings, _loaded(settings)
    estimation, (width, height) = settings.estimation(), settings.size
    quality = quality_of(estimation.supersample, estimation.reflections)
    gains = best_first(_ways(settings), quality, width, height)
    found = f"at least on validation scenes, {quality} at {width} x {height}"
    for way, gain in gains.items():
        others = [f"; {TITLES[each]} {dB:+.2f}" for each, dB in gains.items() if each != way]
        said = "".join([f"{gain:+.2f} dB {found}", *others])
        if way == "oidn" and gain > 0:
            log.info("%s draws the pictures: %s", TITLES[way], said)
            return settings.model_copy(update={"checkpoint": None, "denoise": "oidn"}), None
        if way == "oidn":
            continue
        try:
            chosen = _default_network(settings, gain, said)
        except TronError as error:
            if settings.tuned:
                raise
            log.info("No network: %s", error)
        else:
            log.info("%s draws the pictures: %s", TITLES[way], said)
            return chosen
    return settings.model_copy(update={"checkpoint": None}), None


def _ways(settings: Settings) -> list[Way]:
    """What checkpoint=auto chooses from.

    Open Image Denoise is no answer to settings of a network, and leaves radiance that is asked for as it is.
    """
    ways: list[Way] = ["network"]
    asked = settings.tuned or "relit" in settings.buffers
    if settings.bounces and settings.denoise is True and not asked:
        try:
            require_oidn("checkpoint=auto")
        except TronError:  # not installed here, or not for this machine
            return ways
        ways.append("oidn")
    return ways


def _default_network(settings: Settings, gain: float, said: str) -> tuple[Settings, Renderer]:
    """The shipped network where it gains and fits; TronError says why not."""
    if settings.denoise == "oidn":
        raise TronError("denoise=oidn draws the pictures")
    if "relit" in settings.buffers:
        raise TronError("buffers ask for relit.exr, and a network draws display values")
    if gain <= 0:
        raise TronError(
            f"{DEFAULT} gains nothing for sure: {said}",
            mend=f"give checkpoint={DEFAULT} to have it all the same",
        )
    settings = settings.model_copy(update={"checkpoint": Path(DEFAULT)})
    return settings, _loaded(settings)


def averaged_frames_of(settings: Settings, frames: int) -> int:
    """Frames that each one is the mean of along the camera's motion: 1 where anything else moves or turns."""
    turns = len(set(settings.rotations(frames))) > 1 or settings.motion is not None
    return 1 if settings.checkpoint is None or turns else min(settings.reproject, frames)


def describe_network(settings: Settings, renderer: Renderer | None, frames: int) -> dict[str, Any] | None:
    """Record of the network for relight.json, None without one; weights null: equal ones."""
    if renderer is None or settings.checkpoint is None:
        return None
    return {
        "checkpoint": str(settings.checkpoint),
        "sha256": sha256(checkpoint_file(settings.checkpoint)),
        "guidance": list(renderer.config.guidance),
        "window": settings.window or renderer.config.window,
        "overlap": settings.overlap,
        "reproject": averaged_frames_of(settings, frames),
        "weights": settings.weights or getattr(renderer.config, "weights", None),
    }


def _loaded(settings: Settings) -> Renderer:
    assert settings.checkpoint is not None
    require_extra("checkpoint", "network")
    from tron.neural.weights import load_renderer

    if settings.threads is not None:
        set_torch_threads(settings.threads)
    path = checkpoint_file(settings.checkpoint)
    try:
        renderer = load_renderer(path, settings.vae)
    except ModuleNotFoundError:  # diffusers, of networks that are transformers
        require_extra(f"checkpoint {path}", "train")
        raise
    if settings.bounces == 0 and "lit" in renderer.config.guidance:
        what = "the network is given lit, which has no bounced light with bounces=0 (fidelity=paper sets it)"
        raise TronError(what, path, "give bounces=4, or take a checkpoint of pbr and irradiance")
    _check_drawing(settings, renderer, path)
    log.info("Network: checkpoint %s, of %s", settings.checkpoint, ", ".join(renderer.config.guidance))
    return renderer.to(torch_device())


def _check_drawing(settings: Settings, renderer: Renderer, path: Path) -> None:
    with located(path):
        check_frames(settings.window or renderer.config.window, renderer.temporal_factor)
        renderer.check_weights(settings.weights)


cli = command(
    "tron-relight",
    "conf.relight",
    Settings,
    main,
    examples=(
        "tron-relight scene=surfels.ply environment=studio.hdr output_dir=outputs/relit",
        "tron-relight scene=surfels.ply environment=studio.hdr quality=final reflections=16 output_dir=out",
        "tron-relight scene=scan.ply environment=[dawn.hdr,night.hdr] output_dir=out",
        "tron-relight scene=surfels.ply environment=a.hdr trajectory=still rotation=[0,360] output_dir=out",
        "tron-relight scene=surfels.ply environment=a.hdr 'meshes=[{file: cow.glb, at: [0,0,1]}]' "
        "output_dir=out",
        "tron-relight scene=surfels.ply environment=a.hdr background=transparent output_dir=out",
        "tron-relight scene=surfels.ply environment=a.hdr checkpoint=renderer.safetensors output_dir=out",
        "tron-relight scene=surfels.ply environment=a.hdr checkpoint=paper overlap=newest "
        "'weights={pbr: 0.3, irradiance: 0.7}' output_dir=out",
    ),
)

if __name__ == "__main__":
    cli()
