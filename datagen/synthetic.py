"""Surfels of a synthetic scene and, light by light, its clips of training pairs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import mitsuba as mi
import numpy as np

from datagen.build import FIRST_ID, Geometry
from datagen.clock import stage
from datagen.exposure import metered
from datagen.lights import classify, contrast_share
from datagen.motion import Pose
from datagen.pathtrace import (
    DirectIrradiance,
    direct_irradiance,
    gbuffers,
    render_frames,
    render_lights,
    stacked_lights,
    stream_gbuffers,
)
from datagen.plan import Refinement, scene_folder
from datagen.refinement import refine_surfels
from datagen.scene import SceneSpec
from datagen.settings import Settings
from datagen.split_settings import SplitSettings
from datagen.spool import Frame, Spool, stored_guidance
from datagen.surfel_settings import Source
from datagen.view_spool import ViewSpool
from tron.cameras import Camera
from tron.estimation import Estimation
from tron.gaussians.edit import moved
from tron.gaussians.initialize import GBufferView, surfels_from_gbuffers
from tron.gaussians.scene import GaussianScene
from tron.runtime import torch_device
from tron.seeds import integer
from tron.shading.bounce import BouncedLight, BounceTransport
from tron.shading.environment import EnvironmentMap
from tron.shading.guidance import Guidance, Lighting, render_guidance, trace_views
from tron.shading.surface_maps import surface_maps
from tron.shards.moving import KEY as MOTION
from tron.shards.moving import Moving
from tron.shards.schema import ClipMeta, color_spaces
from tron.tracing import SurfelTracer

REFERENCE_REFLECTIONS = 16
"""Rays a pixel of the member lit_reflections."""


@stage("surfels")
def make_surfels(
    spec: SceneSpec, geometry: Geometry, settings: Settings
) -> tuple[GaussianScene, Refinement | None]:
    """Surfels through what its capture's views see of a scene, then fitted to it, and what that gained.

    They are judged by the cameras of the first clip, which are not among those.
    """
    seen = _seen(spec, geometry, spec.views(settings.views, settings.view_width, settings.view_height))
    if not settings.refine_steps:
        return surfels_from_gbuffers(seen, count=settings.surfels), None
    recipe = settings.split(spec.split)
    folder = scene_folder(settings.output_dir, spec.name)
    device = torch_device(settings.variant)
    seed = integer(spec.seed, spec.split, spec.index, "refinement")
    with ViewSpool(folder) as shown, ViewSpool(folder) as judges:
        surfels = surfels_from_gbuffers(shown.passing(seen), count=settings.surfels)
        cameras = spec.clip(0, recipe.frames, recipe.width, recipe.height)
        for _ in judges.passing(stream_gbuffers(geometry, cameras)):
            pass
        views, held_out = shown.views(), judges.views()
        return refine_surfels(surfels, views, held_out, settings.refine_steps, seed, device)


def _seen(spec: SceneSpec, geometry: Geometry, cameras: Sequence[Camera]) -> Iterator[GBufferView]:
    """True G-buffers of the views that surfels are made from, a few in memory at a time.

    Where an object moves, every other view comes once more with the object away and left out: what it rests
    on has no hole.
    """
    yield from stream_gbuffers(geometry, cameras)
    if spec.motion is not None:
        number = _move(spec, geometry, 1.0)
        for view in stream_gbuffers(geometry, cameras[::2]):
            yield replace(view, valid=view.valid & (view.object_id != number))
        _move(spec, geometry, 0.0)


def _move(spec: SceneSpec, geometry: Geometry, time: float) -> int:
    """Put the object that moves where it is at a time; its id."""
    number = _moving_id(spec)
    geometry.move(number, _pose(spec, time))
    return number


def _moving_id(spec: SceneSpec) -> int:
    assert spec.motion is not None
    return FIRST_ID + len(spec.surroundings) + spec.motion.object


def _pose(spec: SceneSpec, time: float) -> Pose:
    assert spec.motion is not None
    return spec.motion.pose(spec.objects[spec.motion.object], time)


def make_clips(
    spec: SceneSpec, geometry: Geometry, surfels: GaussianScene, settings: Settings
) -> Iterator[tuple[ClipMeta, Sequence[Frame]]]:
    """Render one clip a light, in the order of the specification.

    Each frame holds the schema's members, linear: guidance from the surfels, rgb path-traced from the meshes,
    both under the same baked map; with reference buffers also what Mitsuba says of the pixel centres. Lights
    that share a path share each frame's G-buffers and its paths. A clip's frames are read while it is the
    last that was given.
    """
    estimation = settings.estimation(spec.split)
    with stage("guidance"):
        tracer = SurfelTracer(surfels)
        transport = _transport(spec, tracer, estimation)
    folder = scene_folder(settings.output_dir, spec.name)
    for group in spec.groups():
        with Spool(folder, len(group)) as spool:
            for k, meta in enumerate(_film(spec, geometry, tracer, transport, group, settings, spool)):
                yield meta, spool.clip(k)


@dataclass
class _Lit:
    """One light of a group, made ready.

    Attributes:
        number: its place in the scene's list, which names its seeds.
        seeds: what they are for -> one a frame.
        exposure: of its clip.
    """

    number: int
    environment: EnvironmentMap
    lighting: Lighting
    bounce: BouncedLight | None
    seeds: dict[str, list[int]]
    exposure: float


def _transport(spec: SceneSpec, tracer: SurfelTracer, estimation: Estimation) -> BounceTransport | None:
    if not estimation.bounces:
        return None
    seed = integer(spec.seed, spec.split, spec.index, "bounce")
    return BounceTransport.trace(tracer.sided(estimation.two_sided), seed=seed)


@dataclass
class _Moment:
    """A scene at one time of its clips: where things are and how they are lit.

    Attributes:
        scenes: under no light, for frames that all lights share; or one a light.
        stacked: the lights of frames that are path-traced under all of them at once.
    """

    tracer: SurfelTracer
    lights: list[_Lit]
    scenes: list[mi.Scene]
    stacked: mi.Integrator | None


def _moment(
    spec: SceneSpec,
    geometry: Geometry,
    tracer: SurfelTracer,
    transport: BounceTransport | None,
    maps: Mapping[int, EnvironmentMap],
    settings: Settings,
    time: float,
) -> _Moment:
    """The scene at a time from 0 to 1 under the lights of these numbers; moves the geometry."""
    recipe = settings.split(spec.split)
    if spec.motion is not None:
        which = tracer.scene.object_id == _move(spec, geometry, time)
        if time and which.any():
            tracer = tracer.moved(moved(tracer.scene, which, *_pose(spec, time)))
            transport = _transport(spec, tracer, settings.estimation(spec.split))
    lights = [_prepare(spec, transport, number, map_, settings, time) for number, map_ in maps.items()]
    together = spec.cameras.shared
    if together and not recipe.reference_buffers:
        scenes = [geometry.lit()]
    else:
        scenes = [geometry.lit(light.environment) for light in lights]
    stacked = stacked_lights([light.environment for light in lights]) if together else None
    return _Moment(tracer, lights, scenes, stacked)


@stage("guidance")
def _film(
    spec: SceneSpec,
    geometry: Geometry,
    tracer: SurfelTracer,
    transport: BounceTransport | None,
    group: Sequence[int],
    settings: Settings,
    spool: Spool,
) -> list[ClipMeta]:
    """Render the clips of lights that are filmed from the same places, frame by frame.

    ``transport`` carries the light that bounces; None: none does.
    """
    recipe, estimation = settings.split(spec.split), settings.estimation(spec.split)
    cameras = spec.clip(group[0], recipe.frames, recipe.width, recipe.height)
    still = spec.motion is None and not any(spec.turns_deg)
    maps = {
        number: spec.lights[number].bake(settings.environment_height, settings.environments)
        for number in group
    }
    now = _moment(spec, geometry, tracer, transport, maps, settings, 0.0)
    first = now.lights
    finer = estimation.model_copy(update={"supersample": 2})
    mirrored = finer.model_copy(update={"reflections": REFERENCE_REFLECTIONS})
    poses, shown = [], []
    for i, camera in enumerate(cameras):
        time = i / max(len(cameras) - 1, 1)
        if i and not still:
            now = _moment(spec, geometry, tracer, transport, maps, settings, time)
        bounces = [light.bounce for light in now.lights]
        (truth,) = gbuffers(geometry, [camera])
        if spec.motion is not None:
            poses.append(_pose(spec, time).matrix())
            shown.append(truth.valid & (truth.object_id == _moving_id(spec)))
        spp, seed = recipe.path_spp, first[0].seeds["path"][i]
        if now.stacked is None:
            rgb = render_frames(now.scenes[0], [camera], spp, [seed])
        else:
            rgb = render_lights(now.scenes[0], now.stacked, camera, spp, seed)
        views = trace_views(now.tracer, camera, estimation, bounces)
        surfaces = surface_maps(now.tracer, camera)
        fine = trace_views(now.tracer, camera, finer, bounces) if recipe.reference_buffers else []
        for k, light in enumerate(now.lights):
            if spec.metered and i == 0:
                first[k].exposure = metered(rgb[k], truth.valid, light.exposure)
            seed = light.seeds["guidance"][i]
            view = partial(
                render_guidance, now.tracer, camera, light.lighting, seed=seed, bounce=light.bounce
            )
            guidance = view(estimation, gbuffer=views[k])
            frame = stored_guidance(guidance) | surfaces
            frame |= {"rgb": rgb[k], "foreground": truth.valid.astype(np.float32)}
            if recipe.reference_buffers:
                seed = light.seeds["reference"][i]
                direct = direct_irradiance(geometry, now.scenes[k], camera, recipe.reference_spp, seed)
                frame |= _reference(camera, truth, guidance, direct, light.environment)
                frame["lit_supersampled"] = view(finer, gbuffer=fine[k]).lit
                frame["lit_reflections"] = view(mirrored, gbuffer=fine[k]).lit
            spool.add(k, frame)
    if spec.motion is not None:
        _move(spec, geometry, 0.0)
    source = settings.surfels_from.of(spec.seed, spec.split, spec.index)
    motion = Moving(np.stack(poses), np.stack(shown)).text() if poses else ""
    return [_meta(spec, light, cameras, recipe, source, motion) for light in first]


def _prepare(
    spec: SceneSpec,
    transport: BounceTransport | None,
    number: int,
    environment: EnvironmentMap,
    settings: Settings,
    time: float,
) -> _Lit:
    recipe, shared = settings.split(spec.split), spec.cameras.shared
    if spec.turns_deg:
        environment = environment.rotated(spec.turns_deg[number] * time)
    if shared:  # lights that are traced together have texels at the same places
        environment = environment.baked().resized(settings.environment_height)
    lighting, bounce = Lighting(environment), None
    if transport is not None:
        seed = integer(spec.seed, spec.split, spec.index, "light", number, "bounce")
        bounce = transport.bake(lighting, settings.estimation(spec.split), seed=seed)
    own = ("light", number, "frame")
    where = {"path": ("frame",) if shared else own, "guidance": own, "reference": own}
    seeds = {what: _seeds(spec, recipe.frames, what, *path) for what, path in where.items()}
    return _Lit(number, environment, lighting, bounce, seeds, environment.exposure())


def _meta(
    spec: SceneSpec,
    lit: _Lit,
    cameras: Sequence[Camera],
    recipe: SplitSettings,
    surfels_from: Source,
    motion: str,
) -> ClipMeta:
    light = spec.lights[lit.number]
    spp = {"path": recipe.path_spp, "guidance": recipe.guidance_spp}
    if recipe.reference_buffers:
        spp["reference"] = recipe.reference_spp
    return ClipMeta(
        key=f"{spec.name}-l{lit.number}",
        scene=spec.name,
        light=f"{spec.name}-{light.family}{lit.number}",
        light_family=light.family,
        split=spec.split,
        frames=len(cameras),
        width=recipe.width,
        height=recipe.height,
        cameras=[camera.to_dict() for camera in cameras],
        exposure=lit.exposure,
        color_space=color_spaces(recipe.reference_buffers),
        seeds={"root": spec.seed, **{f"{what}0": values[0] for what, values in lit.seeds.items()}},
        spp=spp,
        extra={
            "style": spec.style,
            "surfels_from": surfels_from,
            "contrast": classify(lit.environment),
            "contrast_share": contrast_share(lit.environment),
            "turn_deg": spec.turns_deg[lit.number] if spec.turns_deg else 0.0,
            "moving_object": spec.motion is not None,
            MOTION: motion,
            "light_spec": light.model_dump_json(),  # text: families differ in their keys, and tables cannot
        },
    )


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
