"""Surfels of a synthetic scene and, light by light, its clips of training pairs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np

from datagen.build import Geometry
from datagen.clock import stage
from datagen.lights import classify
from datagen.pathtrace import DirectIrradiance, direct_irradiance, gbuffers, render_frames
from datagen.plan import Refinement
from datagen.refinement import refine_surfels
from datagen.scene import SceneSpec
from datagen.settings import Settings
from tron.cameras import Camera
from tron.gaussians.initialize import GBufferView, surfels_from_gbuffers
from tron.gaussians.scene import GaussianScene
from tron.runtime import torch_device
from tron.seeds import integer
from tron.shading.bounce import BounceTransport
from tron.shading.environment import EnvironmentMap
from tron.shading.guidance import Guidance, Lighting, render_guidance
from tron.shards.schema import MEMBERS, ClipMeta, clip_members
from tron.tracing import SurfelTracer

Frame = dict[str, np.ndarray]
REFERENCE_REFLECTIONS = 16
"""Rays a pixel of the member lit_reflections."""


@stage("surfels")
def make_surfels(
    spec: SceneSpec, geometry: Geometry, settings: Settings
) -> tuple[GaussianScene, Refinement | None]:
    """Surfels through what the its capture's views see of a scene, then fitted to it, and what that gained.

    They are judged by the cameras of the first clip, which are not among those.
    """
    cameras = spec.views(settings.views, settings.view_width, settings.view_height)
    seen = gbuffers(geometry, cameras)
    surfels = surfels_from_gbuffers(seen, count=settings.surfels)
    if not settings.refine_steps:
        return surfels, None
    recipe = settings.split(spec.split)
    held_out = gbuffers(geometry, spec.clip(0, recipe.frames, recipe.width, recipe.height))
    device = torch_device(settings.variant)
    seed = integer(spec.seed, spec.split, spec.index, "refinement")
    return refine_surfels(surfels, seen, held_out, settings.refine_steps, seed, device)


def make_clips(
    spec: SceneSpec, geometry: Geometry, surfels: GaussianScene, settings: Settings
) -> Iterator[tuple[ClipMeta, list[Frame]]]:
    """Render one clip a light, in the order of the specification.

    Each frame holds the schema's members, linear: guidance from the surfels, rgb path-traced from the meshes,
    both under the same baked map; with reference buffers also what Mitsuba says of the pixel centres.
    """
    estimation = settings.estimation(spec.split)
    with stage("guidance"):
        tracer, transport = SurfelTracer(surfels), None
        if estimation.bounces:
            seed = integer(spec.seed, spec.split, spec.index, "bounce")
            transport = BounceTransport.trace(tracer.sided(estimation.two_sided), seed=seed)
    for number in range(len(spec.lights)):
        yield make_clip(spec, geometry, tracer, transport, number, settings)


@stage("guidance")
def make_clip(
    spec: SceneSpec,
    geometry: Geometry,
    tracer: SurfelTracer,
    transport: BounceTransport | None,
    number: int,
    settings: Settings,
) -> tuple[ClipMeta, list[Frame]]:
    """Render the clip of one light; ``number`` is its place in the scene's list and names its seeds.

    ``transport`` carries the light that bounces; None: none does.
    """
    recipe, light = settings.split(spec.split), spec.lights[number]
    estimation = settings.estimation(spec.split)
    environment = light.bake(settings.environment_height, settings.environments)
    cameras = spec.clip(number, recipe.frames, recipe.width, recipe.height)
    scene = geometry.lit(environment)
    path = ("light", number, "frame")
    seeds = {what: _seeds(spec, len(cameras), what, *path) for what in ("path", "guidance", "reference")}

    rgb = render_frames(scene, cameras, recipe.path_spp, seeds["path"])
    lighting = Lighting(environment)
    bounce = None
    if transport is not None:
        seed = integer(spec.seed, spec.split, spec.index, "light", number, "bounce")
        bounce = transport.bake(lighting, estimation, seed=seed)
    frames: list[Frame] = []
    for i, (camera, truth) in enumerate(zip(cameras, gbuffers(geometry, cameras))):
        view = partial(render_guidance, tracer, camera, lighting, seed=seeds["guidance"][i], bounce=bounce)
        guidance = view(estimation)
        frame = {name: guidance[name] for name in guidance.BUFFERS if name in MEMBERS}
        frame |= {"rgb": rgb[i], "foreground": truth.valid.astype(np.float32)}
        if recipe.reference_buffers:
            direct = direct_irradiance(geometry, scene, camera, recipe.reference_spp, seeds["reference"][i])
            frame |= _reference(camera, truth, guidance, direct, environment)
            finer = estimation.model_copy(update={"supersample": 2})
            mirrored = finer.model_copy(update={"reflections": REFERENCE_REFLECTIONS})
            frame |= {"lit_supersampled": view(finer).lit, "lit_reflections": view(mirrored).lit}
        frames.append(frame)
    spp = {"path": recipe.path_spp, "guidance": recipe.guidance_spp}
    if recipe.reference_buffers:
        spp["reference"] = recipe.reference_spp
    meta = ClipMeta(
        key=f"{spec.name}-l{number}",
        scene=spec.name,
        light=f"{spec.name}-{light.family}{number}",
        light_family=light.family,
        split=spec.split,
        frames=len(frames),
        width=recipe.width,
        height=recipe.height,
        cameras=[camera.to_dict() for camera in cameras],
        exposure=environment.exposure(),
        color_space={
            name: space
            for name in clip_members(recipe.reference_buffers)
            if (space := MEMBERS[name].color_space) is not None
        },
        seeds={"root": spec.seed, **{f"{what}0": values[0] for what, values in seeds.items()}},
        spp=spp,
        extra={
            "style": spec.style,
            "contrast": classify(environment),
            "contrast_share": round(environment.contrast(), 4),
            "light_spec": light.model_dump_json(),  # text: families differ in their keys, and tables cannot
        },
    )
    return meta, frames


def first_bad_value(frames: Sequence[Frame]) -> str | None:
    """First place where a clip is not finite, in words, or None: such a clip must not reach a shard."""
    for i, frame in enumerate(frames):
        for member, image in frame.items():
            bad = int((~np.isfinite(image)).sum())
            if bad:
                return f"frame {i}: {member} has {bad} values that are not finite"
    return None


def _seeds(spec: SceneSpec, frames: int, what: str, *path: str | int) -> list[int]:
    return [integer(spec.seed, spec.split, spec.index, *path, i, what) for i in range(frames)]


def _reference(
    camera: Camera,
    truth: GBufferView,
    guidance: Guidance,
    direct: DirectIrradiance,
    environment: EnvironmentMap,
) -> Frame:
    """Reference members of one frame; behind the scene irradiance shows the environment, as guidance does."""
    seen = truth.valid[..., None]
    behind = environment.lookup(camera.rays())
    light = {"irradiance": direct.shadowed, "unshadowed": direct.unshadowed}
    surface = {
        "base_color": truth.base_color,
        "normal": truth.normal,
        "depth": np.linalg.norm(truth.position - camera.position, axis=-1),
        "roughness": truth.roughness,
        "metallic": truth.metallic,
    }
    return (
        {f"{name}_ref": np.where(seen, image, behind) for name, image in light.items()}
        | {f"{name}_ref": np.where(seen, np.atleast_3d(image), 0.0) for name, image in surface.items()}
        | {name: guidance.gbuffer[name] for name in surface}
    )
