"""tron-relight: a Gaussian scene under a new light, along a camera path.

Three passes over the frames, each from the files of the one before it, so that a run that was cut short goes
on where it stopped: guidance (linear EXR, and PNG to look at), the neural renderer where there is one, and
videos.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

import tron
from tron import seeds
from tron.apps.command_line import command
from tron.apps.frame_folder import FrameFolder
from tron.apps.framing import TrajectoryName, plan_cameras, read_cameras, turn_cameras, upright
from tron.apps.progress import track
from tron.cameras import Camera
from tron.color import to_display
from tron.errors import TronError
from tron.gaussians.scene import GaussianScene
from tron.runtime import activate, describe_machine, set_torch_threads
from tron.storage import locked, require_free_space, sha256, write_atomic

if TYPE_CHECKING:
    from tron.shading.environment import EnvironmentMap
    from tron.shading.guidance import Guidance, Lighting
    from tron.tracing import SurfelTracer

log = logging.getLogger(__name__)

BufferName = Literal[
    "pbr",
    "irradiance",
    "unshadowed",
    "shadowed",
    "mask",
    "base_color",
    "normal",
    "depth",
    "position",
    "roughness",
    "metallic",
    "rgb",
]
GUIDANCE = ("pbr", "irradiance")
# Shadow rays a pixel, and whether they are denoised: guidance.md measured both.
QUALITY = {"preview": (2, True), "final": (64, False)}
# Frames that the neural renderer gets at once; bounds memory, not its view into the past.
CLIP_FRAMES = 16

Side = Annotated[int, Field(ge=8, le=8192)]


class Settings(BaseModel):
    """Everything that tron-relight can be told."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    scene: Path = Field(description="PLY of the scene: TRON's, or a plain 3DGS or 2DGS file")
    environment: Path = Field(description="lat-long environment map, .hdr or .exr")
    output_dir: Path = Field(description="folder for frames, videos and relight.json")
    rotation: float = Field(
        0.0, description="turn of the environment about up, degrees, counter-clockwise seen from above"
    )
    trajectory: TrajectoryName = Field("orbit", description="camera path around the scene")
    cameras: Path | None = Field(
        None, description="JSON with a list of cameras (as in relight.json) to use instead of a trajectory"
    )
    quality: Literal["preview", "final"] = Field(
        "preview", description="preview: 2 shadow rays a pixel, denoised; final: 64"
    )
    frames: int = Field(60, ge=1, le=10_000, description="number of frames (those of `cameras` win)")
    width: Side = Field(512, description="pixels")
    height: Side = Field(512, description="pixels")
    fov: float = Field(40.0, gt=1, lt=150, description="horizontal field of view, degrees")
    distance: float = Field(1.0, gt=0, le=100, description="factor on the automatic distance to the subject")
    fps: float = Field(24.0, gt=0, le=240, description="frames a second of the videos")
    exposure: Literal["auto"] | Annotated[float, Field(gt=0)] = Field(
        "auto", description="factor before the tone curve; auto: from the light on an upward plane"
    )
    up: tuple[float, float, float] | None = Field(
        None, description="up direction of the scene; null: the file's own, or +z (COLMAP captures: [0,-1,0])"
    )
    checkpoint: Path | None = Field(None, description="renderer.safetensors, for neural pictures as well")
    vae: Path | None = Field(None, description="WAN 2.1 VAE, for checkpoints that were trained with it")
    buffers: tuple[BufferName, ...] = Field(
        ("pbr", "irradiance", "unshadowed", "shadowed", "mask"), description="buffers written as EXR"
    )
    overwrite: bool = Field(False, description="replace frames that were made with other settings")
    seed: int = Field(0, description="root of all random numbers")
    variant: Literal["llvm_ad_rgb", "cuda_ad_rgb"] = Field(
        "llvm_ad_rgb", description="Mitsuba variant: processor or NVIDIA GPU"
    )
    threads: int | None = Field(None, ge=1, description="threads of renderer and network; null: all")


def main(settings: Settings) -> None:
    """Light a Gaussian scene with an environment map and film it along a camera path.

    Writes frames/NNNN.{pbr,irradiance,...}.exr (linear) and .png (AgX), guidance.mp4, contact_sheet.png and
    relight.json; with a checkpoint also NNNN.neural.png and neural.mp4. A run that was interrupted goes on
    where it stopped when it is started again.
    """
    clock = _Clock()
    scene = _load_scene(settings)
    environment = _load_environment(settings)
    exposure = environment.exposure() if settings.exposure == "auto" else settings.exposure
    renderer = _load_renderer(settings)
    turn = upright(scene.up)  # to +z, which is up in environment maps
    scene = scene if np.allclose(turn, np.eye(3)) else scene.rotated(turn)
    cameras = _cameras(scene, turn, settings)
    activate(settings.variant, settings.threads)
    buffers = tuple(dict.fromkeys((*GUIDANCE, *settings.buffers)))
    clock.lap("loading")

    pixels = len(cameras) * settings.width * settings.height
    require_free_space(settings.output_dir, pixels * 6 * (len(buffers) + 2))
    with locked(settings.output_dir):
        folder = FrameFolder(settings.output_dir / "frames", buffers)
        folder.claim(_made_with(settings, cameras), settings.overwrite)
        seconds = _render(scene, environment, cameras, exposure, folder, settings)
        clock.lap("guidance")
        if renderer is not None:
            _neural_pass(renderer, folder, len(cameras), exposure)
            clock.lap("neural")
        pictures = [*GUIDANCE] + (["neural"] if renderer is not None else [])
        _assemble(folder, settings, len(cameras), pictures)
        clock.lap("videos")
        report = {
            "version": tron.__version__,
            "settings": settings.model_dump(mode="json"),
            "scene": _describe_scene(scene),
            "exposure": exposure,
            "frames": len(cameras),
            "frames_rendered": len(seconds),
            "first_frame_seconds": seconds[0] if seconds else None,
            "frame_seconds_median": float(np.median(seconds)) if seconds else None,
            "seconds": clock.laps,
            "machine": describe_machine(),
            "cameras": [camera.to_dict() for camera in turn_cameras(cameras, turn.T)],
        }
        write_atomic(settings.output_dir / "relight.json", json.dumps(report, indent=1) + "\n")
    log.info("%d frames, %d of them rendered now: %s", len(cameras), len(seconds), settings.output_dir)


class _Clock:
    """Seconds of each part of a run."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = round(now - self._last, 3)
        self._last = now


def _load_scene(settings: Settings) -> GaussianScene:
    scene = GaussianScene.load(settings.scene)
    if scene.materials_guessed:
        log.warning(
            "%s has no materials: they are guessed from its colours, which keep the light it was captured in",
            settings.scene,
        )
    if settings.up is not None:
        length = float(np.linalg.norm(settings.up))
        if not (np.isfinite(length) and length > 0):
            raise TronError("wrong value for 'up'", str(settings.up), "give a direction, such as [0,0,1]")
        scene.up = np.array(settings.up) / length
    return scene


def _load_environment(settings: Settings) -> EnvironmentMap:
    from tron.shading.environment import EnvironmentMap

    return EnvironmentMap.load(settings.environment, settings.rotation)


def _load_renderer(settings: Settings) -> Any:
    """The network, before any frame is traced, so that a wrong file is found at once; None without one."""
    if settings.checkpoint is None:
        return None
    if not settings.checkpoint.is_file():  # said before torch is loaded, which takes seconds
        raise TronError("file not found", settings.checkpoint)
    from tron.neural.weights import load_renderer

    if settings.threads is not None:
        set_torch_threads(settings.threads)
    renderer = load_renderer(settings.checkpoint, settings.vae)
    if settings.variant.startswith("cuda"):
        renderer = renderer.to("cuda")
    return renderer


def _cameras(scene: GaussianScene, turn: np.ndarray, settings: Settings) -> list[Camera]:
    """The cameras in the turned world of the scene; those of a file are given in the world before."""
    if settings.cameras is not None:
        return turn_cameras(read_cameras(settings.cameras, settings.width, settings.height), turn)
    return plan_cameras(
        scene,
        settings.trajectory,
        settings.frames,
        width=settings.width,
        height=settings.height,
        fov_deg=settings.fov,
        distance=settings.distance,
    )


def _made_with(settings: Settings, cameras: Sequence[Camera]) -> dict[str, Any]:
    """What the pixels of the linear frames depend on, as JSON values."""
    keys = {
        "rotation",
        "trajectory",
        "quality",
        "width",
        "height",
        "fov",
        "distance",
        "up",
        "seed",
        "variant",
    }
    return {
        "scene_sha256": sha256(settings.scene),
        "environment_sha256": sha256(settings.environment),
        "cameras_sha256": None if settings.cameras is None else sha256(settings.cameras),
        "frames": len(cameras),
        **settings.model_dump(mode="json", include=keys),
        "version": tron.__version__,
    }


def _render(
    scene: GaussianScene,
    environment: EnvironmentMap,
    cameras: Sequence[Camera],
    exposure: float,
    folder: FrameFolder,
    settings: Settings,
) -> list[float]:
    """Trace the frames that are missing, develop all of them; returns the seconds of each traced one."""
    from tron.shading.guidance import Lighting, render_guidance

    spp, denoise = QUALITY[settings.quality]
    missing = [index for index in range(len(cameras)) if not folder.finished(index)]
    lighting: Lighting | None = Lighting(environment) if missing else None
    tracer_for = _tracers(scene)
    seconds: list[float] = []
    for index, camera in enumerate(track(cameras, "guidance")):
        if index in missing:
            assert lighting is not None
            started = time.perf_counter()
            seed = seeds.integer(settings.seed, "relight", index)
            tracer = tracer_for(camera)
            guidance = render_guidance(tracer, camera, lighting, spp=spp, seed=seed, denoise=denoise)
            seconds.append(time.perf_counter() - started)
            folder.write(index, {name: _buffer(guidance, name) for name in folder.buffers})
        for name in GUIDANCE:
            folder.write_picture(index, name, to_display(folder.read(index, name), exposure))
    return seconds


def _tracers(scene: GaussianScene) -> Callable[[Camera], SurfelTracer]:
    """The tracer for a camera: one for all, unless normals mean nothing and must be turned to each camera."""
    from tron.tracing import SurfelTracer

    if scene.oriented:
        tracer = SurfelTracer(scene)
        return lambda _: tracer
    return lambda camera: SurfelTracer(scene.facing(camera.position))


def _buffer(guidance: Guidance, name: str) -> np.ndarray:
    return getattr(guidance, name) if hasattr(guidance, name) else guidance.gbuffer[name]


def _neural_pass(renderer: Any, folder: FrameFolder, frames: int, exposure: float) -> None:
    """Pictures of the neural renderer for every frame, as one window sliding over the clip gives them."""
    from tron.neural.renderer import render_clip

    # A window that starts this many frames before a part makes the part's own frames independent of the cut.
    before = getattr(getattr(renderer, "config", None), "window", 1) - 1
    step = max(CLIP_FRAMES, before + 1)
    for start in track(range(0, frames, step), "neural"):
        first, end = max(start - before, 0), min(start + step, frames)
        pbr, irradiance = (np.stack([folder.read(i, name) for i in range(first, end)]) for name in GUIDANCE)
        display = render_clip(renderer, pbr, irradiance, exposure)
        for index in range(start, end):
            folder.write_picture(index, "neural", display[index - first])


def _assemble(folder: FrameFolder, settings: Settings, frames: int, pictures: Sequence[str]) -> None:
    folder.write_video(settings.output_dir / "guidance.mp4", frames, pictures, settings.fps)
    if "neural" in pictures:
        folder.write_video(settings.output_dir / "neural.mp4", frames, ["neural"], settings.fps)
    folder.write_sheet(settings.output_dir / "contact_sheet.png", frames, pictures)


def _describe_scene(scene: GaussianScene) -> dict[str, Any]:
    return {
        "surfels": len(scene),
        "kernel_degree": scene.kernel_degree,
        "spacing": scene.spacing,
        "materials_guessed": scene.materials_guessed,
        "oriented": scene.oriented,
    }


cli = command(
    "tron-relight",
    "conf.relight",
    Settings,
    main,
    examples=(
        "tron-relight scene=surfels.ply environment=studio.hdr output_dir=outputs/relit",
        "tron-relight scene=surfels.ply environment=dawn.hdr rotation=90 quality=final output_dir=out",
        "tron-relight scene=capture.ply up=[0,-1,0] environment=night.exr output_dir=out",
        "tron-relight scene=surfels.ply environment=dawn.hdr checkpoint=renderer.safetensors output_dir=out",
    ),
)

if __name__ == "__main__":
    cli()
