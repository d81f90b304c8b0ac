"""One light's clip on disk: linear buffers that are traced once, pictures made of them, and videos."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tron import seeds
from tron.apps.frame_folder import FrameFolder
from tron.apps.relit import RelitPicture, surfels_alone
from tron.cameras import Camera
from tron.cli.progress import track
from tron.estimation import Estimation
from tron.flow import surface_motion
from tron.gaussians.scene import GaussianScene
from tron.images import write_image
from tron.neural.reprojection import averaged_frames
from tron.neural.windows import Overlap
from tron.shards.schema import GUIDANCE, displayed, surface_members

if TYPE_CHECKING:
    from tron.apps.lit_scene import Bounced, LitScene
    from tron.neural.protocols import Renderer
    from tron.shading.bounce import BouncedLight
    from tron.shading.environment import EnvironmentMap
    from tron.shading.lighting import Lighting
    from tron.tracing import SurfelTracer

log = logging.getLogger(__name__)

DEPTH = "depth"
"""Buffer that the motion of surfaces is known by."""


@dataclass
class Clip:
    """Frames under one light.

    Attributes:
        environment: the light, not turned.
        rotations: its turn in each frame, degrees.
        exposure: factor before AgX.
        picture: how the relit picture is made.
        folder: the frames; claimed before anything is written.
        guidance: buffers that the neural renderer is conditioned on, and that are shown.
        keeps_linear: whether the relit picture is written as EXR too.
        seconds: of each frame that was traced in this run.
    """

    environment: EnvironmentMap
    rotations: Sequence[float]
    exposure: float
    picture: RelitPicture
    folder: FrameFolder
    guidance: Sequence[str] = GUIDANCE
    keeps_linear: bool = False
    seconds: list[float] = field(default_factory=list)
    _turned: tuple[float, Lighting, Bounced] | None = None

    @cached_property
    def _lighting(self) -> Lighting:
        """The environment, prepared when the first frame is traced."""
        from tron.shading.guidance import Lighting

        return Lighting(self.environment)

    def light(self, scene: LitScene, index: int) -> tuple[Lighting, Bounced]:
        """The environment as frame ``index`` has it, and what of it bounces, baked where it has turned."""
        rotation = self.rotations[index]
        if self._turned is None or self._turned[0] != rotation:
            lighting = self._lighting.turned_to(rotation)
            self._turned = rotation, lighting, scene.bake(lighting)
        return self._turned[1:]

    def write_pictures(self, index: int) -> None:
        """Write the pictures of a frame whose buffers are there, those that need no network."""
        for name in self.guidance:
            self.folder.write_picture(index, name, self._shown(index, name))
        if not self.picture.neural:
            self.folder.path(index, "neural", "png").unlink(missing_ok=True)  # of an earlier run
            self.folder.write_picture(index, "relit", self.picture.display(self.folder, index, self.exposure))
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
        along their motion (`tron.apps.relight_network.averaged_frames_of` says how many).
        """
        from tron.neural.renderer import render_frames

        frames = len(self.rotations)
        drawn = render_frames(renderer, self._displayed, frames, window, overlap, weights)
        if cameras is not None and reproject > 1:
            motion = surface_motion(cameras, self._depth)
            drawn = averaged_frames(drawn, frames, reproject, motion, overlap)
        for index, neural in enumerate(track(drawn, "neural", frames)):
            self.folder.write_picture(index, "neural", neural)
            relit = self.picture.display(self.folder, index, self.exposure, neural)
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


def trace(
    scene: GaussianScene,
    cameras: Sequence[Camera],
    clips: Sequence[Clip],
    *,
    estimation: Estimation,
    seed: int,
) -> None:
    """Trace the frames that are missing, and write the pictures of all.

    Args:
        scene: the surfels.
        cameras: one a frame.
        clips: one a light.
        estimation: of the light.
        seed: root of its random numbers; a frame's do not depend on the environment.
    """
    from tron.apps.lit_scene import LitScene

    lit = LitScene(scene, cameras[0], estimation, seeds.integer(seed, "relight", "bounces"))
    for clip in clips:
        if lacking := clip.folder.lacking(len(cameras)):
            log.info("frames that have no %s yet are traced again", ", ".join(lacking))
    if not all(clip.folder.finished(index) for clip in clips for index in range(len(cameras))):
        lit.prepare()
    for index, camera in enumerate(track(cameras, "guidance")):
        surfaces = cache(partial(_surface_maps, lit, camera))  # alike under all lights
        for clip in clips:
            if not clip.folder.finished(index):
                started = time.perf_counter()
                lighting, bounced = clip.light(lit, index)
                ray_seed = seeds.integer(seed, "relight", index)
                buffers = _shade(
                    lit.tracer(camera),
                    camera,
                    lighting,
                    bounced(camera),
                    clip.folder.buffers,
                    surfaces,
                    estimation,
                    ray_seed,
                )
                clip.seconds.append(time.perf_counter() - started)
                clip.folder.write(index, buffers)
            clip.write_pictures(index)


def _surface_maps(scene: LitScene, camera: Camera) -> dict[str, np.ndarray]:
    from tron.shading.surface_maps import surface_maps

    return surface_maps(scene.tracer(camera), camera)


def _shade(
    tracer: SurfelTracer,
    camera: Camera,
    lighting: Lighting,
    bounce: BouncedLight | None,
    names: Sequence[str],
    surfaces: Callable[[], dict[str, np.ndarray]],
    estimation: Estimation,
    seed: int,
) -> dict[str, np.ndarray]:
    """The buffers ``names`` of one frame; ``surfaces`` gives those that no light shines on."""
    from tron.shading.background import background_share
    from tron.shading.guidance import arriving_light, shade, trace_view
    from tron.shading.supersampling import averaged

    view = trace_view(tracer, camera, estimation, bounce)
    arriving = arriving_light(tracer, view, lighting, estimation, seed, bounce)
    guidance = shade(view, arriving, lighting, estimation=estimation)
    # The share is no linear function of opacity: a pixel has the mean of those of its sub-pixels.
    transmittance = 1 - view.images({"opacity": view.opacity})["opacity"]
    share = averaged(background_share(transmittance), estimation.supersample)
    made = guidance.gbuffer | vars(guidance) | {"share": share.astype(np.float32)}
    if not set(names).isdisjoint(surface_members()):
        made |= surfaces()
    if "foreground" in names:
        over_black = shade(view, arriving, lighting, (0, 0, 0), estimation).lit
        made["foreground"] = surfels_alone(over_black, made["share"])
    return {name: made[name] for name in names}
