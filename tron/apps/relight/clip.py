"""One light's clip on disk: linear buffers that are traced once, pictures made of them, and videos."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import tron
from tron import seeds
from tron.apps.frame_folder import FrameFolder
from tron.apps.relight.settings import Settings
from tron.apps.relit import RelitPicture, surfels_alone
from tron.cameras import Camera
from tron.cli.progress import track, working
from tron.color import LOOKS, from_agx
from tron.editing.motion import LightNow, Motion
from tron.editing.moving import MovingScene
from tron.errors import TronError
from tron.flow import surface_motion
from tron.io.images import write_image
from tron.neural.clips import Overlap, averaged_frames
from tron.runtime import describe_machine
from tron.scans import Scan
from tron.scans.camera_files import stated
from tron.shards.schema import GUIDANCE, displayed, surface_members
from tron.storage import write_atomic
from tron.trajectories import turn_cameras

if TYPE_CHECKING:
    from tron.neural.protocols import Renderer
    from tron.relighting import Illumination, Relighter
    from tron.shading.environments.environment import EnvironmentMap
    from tron.shading.guidance import Guidance
    from tron.shading.lighting import Lighting

log = logging.getLogger(__name__)

DEPTH = "depth"
"""Buffer that the motion of surfaces is known by."""
TOLD = ("kernel_degree", "spacing", "materials_guessed", "oriented", "projection")
"""What relight.json says of a scene, beside the number of its surfels."""
METERED = (
    "exposure %.4g, metered in the first frame; exposure=%.4g keeps it, twice as much is a stop brighter"
)


@dataclass
class Clip:
    """Frames under one light.

    Attributes:
        environment: the light, not turned.
        rotations: its turn in each frame, degrees.
        lights: what else it is in each frame; None: itself.
        others: maps that it may fade into, by their files.
        exposure: factor before AgX of buffers and of what networks draw: the light's.
        picture: how the relit picture is made.
        folder: the frames; claimed before anything is written.
        guidance: buffers that the neural renderer is conditioned on, and that are shown.
        keeps_linear: whether the relit picture is written as EXR too.
        chosen: the relit picture's factor before AgX; None: as the first frame is metered.
        seconds: of each frame that was traced in this run.
    """

    environment: EnvironmentMap
    rotations: Sequence[float]
    exposure: float
    picture: RelitPicture
    folder: FrameFolder
    guidance: Sequence[str] = GUIDANCE
    keeps_linear: bool = False
    chosen: float | None = None
    seconds: list[float] = field(default_factory=list)
    lights: Sequence[LightNow] | None = None
    others: Mapping[Path, EnvironmentMap] = field(default_factory=dict)
    _prepared: tuple[tuple[Any, ...], Lighting] | None = None
    _baked: Illumination | None = None

    @classmethod
    def of(
        cls, light: Settings, environment: EnvironmentMap, frames: int, guidance: Sequence[str],
        averaged: bool,
    ) -> Clip:  # fmt: skip
        """The clip that settings of one light ask for; ``averaged``: along motion, by a network."""
        picture = RelitPicture(light.background, light.source, light.look, light.denoiser)
        needed = (*guidance, *picture.buffers, *light.buffers, *([DEPTH] if averaged else []))
        buffers = tuple(dict.fromkeys(name for name in needed if name != "relit"))
        return cls(
            environment, light.rotations(frames), environment.exposure(), picture,
            FrameFolder(light.output_dir / "frames", buffers), guidance, "relit" in light.buffers,
            chosen=None if light.exposure == "auto" else light.exposure,
        )  # fmt: skip

    def follow(self, motion: Motion, fps: float, maps: Mapping[Path, EnvironmentMap]) -> None:
        """Let the light change as a motion has it; ``maps``: all that it names, by their files."""
        self.others = maps
        self.lights = [motion.light_at(index / fps) for index in range(len(self.rotations))]
        self.exposure = self.first_exposure()
        self.rotations = [a + b.rotation for a, b in zip(self.rotations, self.lights)]

    def light(self, relighter: Relighter, index: int, now: Mapping[str, Any]) -> Illumination:
        """The environment as frame ``index`` has it, over what :meth:`Relighter.bring` is given ``now``."""
        lighting = self._lighting(index)
        with working("light that bounces, baked") if self._baked is None else nullcontext():
            self._baked = relighter.bring(
                light=lighting, rotation=self.rotations[index], before=self._baked, **now
            )
        return self._baked

    def _lighting(self, index: int) -> Lighting:
        """The environment of frame ``index``, not turned, prepared where it is another than before."""
        from tron.shading.lighting import Lighting

        now = None if self.lights is None else self.lights[index]
        key = () if now is None else (now.factor, now.maps)
        if self._prepared is None or self._prepared[0] != key:
            environment = self.environment if now is None else self._mixed(now)
            self._prepared = key, Lighting(environment)
        return self._prepared[1]

    def first_exposure(self) -> float:
        """That of the light of the first frame; of a black one, what it was."""
        if self.lights is None:
            return self.exposure
        try:
            return self._mixed(self.lights[0]).exposure()
        except TronError:
            return self.exposure

    def _mixed(self, now: LightNow) -> EnvironmentMap:
        maps = [(self.others[path] if path else self.environment, share) for path, share in now.maps]
        height = max(each.image.shape[0] for each, _ in maps)
        image = sum(np.float32(share * now.factor) * each.resized(height).image for each, share in maps)
        return replace(self.environment, image=image)

    @cached_property
    def shown_exposure(self) -> float:
        """Factor before AgX of the relit picture; where it is metered, :meth:`meter` has been called."""
        return self.chosen or json.loads(self._reading.read_bytes())[self.picture.look]

    @property
    def _reading(self) -> Path:
        return self.folder.folder / "exposure.json"

    @property
    def metered(self) -> bool:
        """Whether the exposure of the relit picture is known, from this run or an earlier one."""
        return self.chosen is not None or self._reading.is_file()

    def meter(self, frame: Guidance) -> None:
        """Set the exposure by the first frame."""
        write_atomic(self._reading, json.dumps({look: frame.exposure(look) for look in LOOKS}) + "\n")

    def write_pictures(self, index: int) -> None:
        """Write the pictures of a frame whose buffers are there, those that need no network."""
        for name in self.guidance:
            self.folder.write_picture(index, name, self._shown(index, name))
        if not self.picture.neural:
            self.folder.path(index, "neural", "png").unlink(missing_ok=True)  # of an earlier run
            relit = self.picture.display(self.folder, index, self.shown_exposure)
            self.folder.write_picture(index, "relit", relit)
        if self.keeps_linear:
            write_image(self.folder.path(index, "relit", "exr"), self.picture.linear(self.folder, index))
        else:  # that of an earlier run may stand before another background
            self.folder.path(index, "relit", "exr").unlink(missing_ok=True)

    def draw(
        self,
        renderer: Renderer,
        window: int | None = None,
        overlap: Overlap = "anchor",
        weights: Mapping[str, float] | None = None,
        cameras: Sequence[Camera] | None = None,
        reproject: int = 1,
    ) -> None:
        """Write the neural renderer's pictures, as `render_frames` gives them.

        With cameras, one a frame, and the buffer DEPTH in the folder, ``reproject`` frames each are averaged
        along their motion (`tron.apps.relight.network.averaged_frames_of` says how many).
        """
        from tron.neural.renderer import render_frames

        frames = len(self.rotations)
        drawn = render_frames(renderer, self._displayed, frames, window, overlap, weights)
        if cameras is not None and reproject > 1:
            motion = surface_motion(cameras, self._depth)
            drawn = averaged_frames(drawn, frames, reproject, motion, overlap)
        for index, neural in enumerate(track(drawn, "neural", frames)):
            self.folder.write_picture(index, "neural", neural)
            radiance = from_agx(neural) / np.float32(self.exposure)
            relit = self.picture.display(self.folder, index, self.shown_exposure, radiance)
            self.folder.write_picture(index, "relit", relit)

    def _displayed(self, index: int) -> dict[str, np.ndarray]:
        return {name: self._shown(index, name) for name in self.guidance}

    def _shown(self, index: int, name: str) -> np.ndarray:
        return displayed(name, self.folder.read(index, name), self.exposure)

    def _depth(self, index: int) -> np.ndarray:
        return self.folder.read(index, DEPTH)[..., 0].copy()  # a view would keep all three channels

    def assemble(self, output_dir: Path, fps: float) -> None:
        """Write videos and the contact sheet from the pictures of all frames."""
        frames, drawn = len(self.rotations), ["neural"] if self.picture.neural else []
        for name, pictures in {
            "relit": ["relit"],
            "guidance": [*self.guidance, *drawn],
            "neural": drawn,
        }.items():
            if pictures:
                self.folder.write_video(output_dir / f"{name}.mp4", frames, pictures, fps)
            else:
                (output_dir / f"{name}.mp4").unlink(missing_ok=True)  # of an earlier run
        self.folder.write_sheet(output_dir / "contact_sheet.png", frames, ["relit", *self.guidance, *drawn])

    def report(
        self, light: Settings, scan: Scan, cameras: list[Camera], seconds: Mapping[str, float],
        network: Mapping[str, Any] | None,
    ) -> None:  # fmt: skip
        """Write relight.json of the clip, with the seconds of the run's parts and the network's record."""
        scene, file = scan.scene, light.output_dir / "relight.json"
        said = {
            "version": tron.__version__,
            "settings": light.model_dump(mode="json"),
            "relit": self.picture.source,
            "scene": {"surfels": len(scene)} | {name: getattr(scene, name) for name in TOLD},
            "exposure": self.shown_exposure,
            "guidance_exposure": self.exposure,
            "frames": len(cameras),
            "frames_rendered": len(self.seconds),
            "first_frame_seconds": self.seconds[0] if self.seconds else None,
            "frame_seconds_median": float(np.median(self.seconds)) if self.seconds else None,
            "seconds": seconds,
            "machine": describe_machine(),
            "rotations": list(self.rotations),
            "cameras": [camera.to_dict() for camera in turn_cameras(cameras, scan.turn.T)],
            "network": network,
            **stated(scan.offset),
        }
        write_atomic(file, json.dumps(said, indent=1) + "\n")
        made = len(cameras), len(self.seconds), file.with_name("relit.mp4")
        log.info("frames: %d, rendered now: %d; look at %s", *made)


def trace(
    relighter: Relighter,
    cameras: Sequence[Camera],
    clips: Sequence[Clip],
    seed: int,
    moving: MovingScene | None = None,
    fps: float = 24.0,
) -> None:
    """Trace the frames that are missing, and write the pictures of all.

    Args:
        relighter: the scene.
        cameras: one a frame.
        clips: one a light.
        seed: root of the random numbers; a frame's do not depend on the environment.
        moving: the scene's motion, if it has one.
        fps: frames a second.
    """
    for clip in clips:
        if lacking := clip.folder.lacking(len(cameras)):
            log.info("frames that have no %s yet are traced again", ", ".join(lacking))
    if not all(clip.folder.finished(index) for clip in clips for index in range(len(cameras))):
        relighter.prepare()
    scenes = _Scenes(relighter, moving)
    for index, camera in enumerate(track(cameras, "guidance")):
        surfaces = None  # alike under all lights
        for clip in clips:
            if not clip.folder.finished(index) or not clip.metered:
                started = time.perf_counter()
                ray_seed = seeds.integer(seed, "relight", index)
                light = scenes.under(clip, index, index / fps)
                surfaces = surfaces or cache(
                    partial(light.relighter.surface_maps, camera, relighter.estimation)
                )
                frame, buffers = _shade(light, camera, ray_seed, clip, surfaces)
                clip.seconds.append(time.perf_counter() - started)
                if not clip.metered:
                    clip.meter(frame)
                    log.info(METERED, clip.shown_exposure, clip.shown_exposure)
                clip.folder.write(index, buffers)
            clip.write_pictures(index)


class _Scenes:
    """The scene of each frame, under the lights of its clips; ``moving`` if it does."""

    def __init__(self, first: Relighter, moving: MovingScene | None) -> None:
        self._first, self._moving, self._last, self._poses = first, moving, first, b""
        self._now: dict[str, Any] = {"scene": first.scene}

    def under(self, clip: Clip, index: int, seconds: float) -> Illumination:
        if self._moving is not None and (poses := self._moving.poses_at(seconds)) != self._poses:
            scene, proxy, meshes = self._moving.at(seconds), self._first.proxy, self._first.meshes
            if proxy is not None:
                proxy = replace(proxy, surfels=self._moving.follow(proxy.surfels, seconds))
            if self._moving.meshes and meshes is not None:
                meshes = meshes.moved(self._moving.meshes_at(seconds, len(meshes)))
            self._poses, self._now = poses, {"scene": scene, "proxy": proxy, "meshes": meshes}
            if scene is self._moving.scene and not self._moving.meshes:
                self._last, self._now = self._first, {"scene": self._first.scene}
        light = clip.light(self._last, index, self._now)
        self._last = light.relighter
        return light


def _shade(
    light: Illumination,
    camera: Camera,
    seed: int,
    clip: Clip,
    surfaces: Callable[[], list[dict[str, np.ndarray]]],
) -> tuple[Guidance, dict[str, np.ndarray]]:
    """One frame and its buffers in the clip; ``surfaces`` gives those that no light shines on."""
    from tron.shading.composition import background_share
    from tron.shading.guidance import averaged

    names = clip.folder.buffers
    frame = light.trace(camera, seed)
    if clip.picture.denoiser is not None:
        frame = frame.denoised(clip.picture.denoiser, surfaces()[0])
    guidance = frame.shade()
    # The share is no linear function of opacity: a pixel has the mean of those of its sub-pixels.
    transmittance = 1 - frame.view.images({"opacity": frame.view.opacity})["opacity"]
    share = averaged(background_share(transmittance), light.estimation.supersample)
    made = guidance.gbuffer | vars(guidance) | {"share": share.astype(np.float32)}
    if not set(names).isdisjoint(surface_members()):
        made |= surfaces()[0]
    if "foreground" in names:
        made["foreground"] = surfels_alone(frame.shade((0, 0, 0)).lit, made["share"])
    return guidance, {name: made[name] for name in names}
