"""Make surfels of a synthetic scene and, light by light, its clips of training pairs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mitsuba as mi
import numpy as np

from datagen.clock import stage
from datagen.dataset.records import RECORD_NAME, Record, Refinement, Work, clear_work, scene_folder
from datagen.dataset.spool import Frame, Spool, ViewSpool, stored_guidance, view_bytes, write_clips
from datagen.dataset.variety import Histograms, frame_histograms, surface_members, total
from datagen.files.sources import Sources
from datagen.settings.command import OF_FRAMES, SPLITS, Settings
from datagen.settings.split import Source as SurfelSource
from datagen.settings.split import SplitSettings
from datagen.sources.reconstructed import reconstruct_surfels
from datagen.sources.refinement import WINDOW, refine_surfels
from datagen.sources.source import CHECKPOINT_BYTES, SceneCost, Source, spooled_bytes
from datagen.sources.windows import MARGIN, Window, draw_windows
from datagen.truth.build import FIRST_ID, Geometry, draw_and_build
from datagen.truth.pathtrace import (
    LANES,
    DirectIrradiance,
    direct_irradiance,
    gbuffers,
    metered,
    render_frames,
    render_lights,
    stacked_lights,
    stream_gbuffers,
)
from datagen.world.lights import classify, contrast_share
from datagen.world.motion import Pose
from datagen.world.scene import SceneSpec, scene_name
from tron.cameras import Camera
from tron.errors import TronError
from tron.gaussians.edit import moved
from tron.gaussians.initialize import GBufferView, sample_bytes, surfels_from_gbuffers
from tron.gaussians.scene import GaussianScene
from tron.reconstruction.settings import MaterialSettings, RadianceSettings
from tron.relighting import EnvironmentMap, Illumination, Relighter, views_under
from tron.run_folder import CHOOSE_ANOTHER, RunFolder
from tron.runtime import activate
from tron.seeds import integer
from tron.shards.moving import KEY as MOTION
from tron.shards.moving import Moving
from tron.shards.schema import ClipMeta, color_spaces
from tron.storage import write_atomic

OF_SURFELS = ("base_color", "normal", "depth", "roughness", "metallic")
"""Members of the surfels that reference members are the truth of."""
METER_WIDTH, METER_SPP = 48, 16
"""Width and paths a pixel of the whole picture that windows of a room are exposed by."""
REFERENCE_REFLECTIONS = 16
"""Rays a pixel of the member lit_reflections."""

# Processor seconds of one core of a Xeon with kernels compiled, measured stage by stage on twelve scenes of
# five recipes (2026-11-25; 96 x 96 to 192 x 192 pixels, 20,000 to 60,000 surfels): the sum was 0.67 to 1.46
# of what eleven took and 0.47 of a room. The fit was measured on 2026-11-26: 20,000 to 100,000 surfels.
BUILD = 1.5  # meshes, textures, scenes of Mitsuba
VIEW = 2.0e-6  # a pixel of the views that surfels are made from
FIT, FIT_PIXEL, FIT_SURFEL = 0.005, 6.5e-7, 2.5e-7  # a step of the fit, its window's pixels, its surfels
STEP, STEP_PIXEL, STEP_SURFEL = 0.006, 5e-7, 1e-6  # likewise a step of a reconstruction, on whole views
PATH = 1.0e-6  # a path of one light
SHARED_PATH = 0.53  # share of it where four lights or more have their paths in common
LIGHT = 0.9  # a light made ready, its bounces baked
RAY = 2.6e-7  # a shadow ray of guidance, with the rest of its frame
FINER, REFERENCE_RAY = 4e-5, 7.6e-8  # a pixel of the finer frames of reference buffers, a ray of them
WRITTEN = 4.5e-8  # a byte before compression

# Bytes on disk.
COMPRESSED = 0.45  # over those that half floats would take: 0.3 to 0.4, of large frames 0.6
PICTURE_BYTES = 32  # a pixel of a scene's own pictures: 8-bit colours and half-float maps, hardly compressed

# Bytes of memory.
PROCESS = 0.55e9  # libraries and kernels
LANE = 430  # a path in flight
FRAME_BYTES = 256  # a pixel's buffers under one light
VIEW_BYTES = 49  # a pixel of a true G-buffer; LANES / 2 pixels are rendered at a time, and copied


class SyntheticSource(Source):
    """Source of scenes drawn from seeds and path-traced, one clip per light."""

    def plan(self, settings: Settings) -> list[Work]:
        """Return the scenes of each split; each scene has its own shard numbers."""
        items = []
        for split in settings.used_splits():
            recipe = settings.split(split)
            shards = -(-len(recipe.lights) // settings.clips_per_shard)
            items += [Work(split, i, scene_name(split, i), i * shards) for i in range(recipe.scenes)]
        if not items:
            raise TronError("the dataset would have no scenes", "give a split scenes, e.g. train.scenes=16")
        return items

    def planned(self, settings: Settings) -> dict[str, Any]:
        """Return split -> number of its scenes."""
        return {split: settings.split(split).scenes for split in SPLITS}

    def require_same(
        self, run: RunFolder, before: dict[str, Any], scenes: Mapping[str, Any], settings: Settings
    ) -> None:
        """Allow more scenes and new splits; refuse any other change."""
        before, now = dict(before), settings.recipe()
        for split in SPLITS:
            if not scenes.get(split):  # there is nothing of it yet, so it may be anything from now on
                before.pop(split, None)
                now.pop(split, None)
        for split in set(before) & set(SPLITS) - set(now):
            del before[split]  # fewer scenes than there are: that is told below
        run.require(now, before)
        for split in SPLITS:
            if scenes.get(split, 0) > settings.split(split).scenes:
                raise TronError(
                    f"output_dir holds {scenes[split]} scenes of {split}, more than {split}.scenes asks for",
                    settings.output_dir,
                    CHOOSE_ANOTHER,
                )

    def make(self, item: Work, settings: Settings, sources: Sources) -> Record:
        """See :func:`make_scene`."""
        return make_scene(item, settings, sources)

    def clips(self, item: Work, settings: Settings) -> int:
        """Return the number of clips, one per light."""
        return len(settings.split(item.split).lights)

    def frames(self, item: Work, settings: Settings) -> int:
        """Return the number of frames of these clips."""
        return self.clips(item, settings) * settings.split(item.split).frames

    def surfels(self, item: Work, settings: Settings) -> int:
        """Return the number in the settings, or the number that suits the frames."""
        return settings.surfel_budget(item.split, item.index).surfels

    def cost(self, item: Work, settings: Settings) -> SceneCost:
        """Return the cost by the table above."""
        recipe, made = settings.split(item.split), settings.surfel_budget(item.split, item.index)
        pixels, frames = recipe.width * recipe.height, self.frames(item, settings)
        views = made.views * made.view_pixels
        shares = settings.surfels_from
        rebuilt = shares.reconstruction / (shares.gbuffers + shares.reconstruction)
        both_stages = RadianceSettings().steps + MaterialSettings().steps
        whole_steps = round(both_stages * settings.surfel_reconstruction.steps_scaler)
        path = PATH * (SHARED_PATH if len(recipe.lights) >= 4 else 1)
        reference = FINER + REFERENCE_RAY * recipe.reference_spp if recipe.reference_buffers else 0
        whole = self.kept_bytes(settings, [item])
        frame = pixels * (path * recipe.path_spp + RAY * _rays(settings, item) + reference)
        photographed = rebuilt * views * settings.surfel_reconstruction.path_spp * PATH
        step = STEP + STEP_PIXEL * made.view_pixels + STEP_SURFEL * made.surfels
        window = min(made.view_width, WINDOW) * min(made.view_height, WINDOW)
        fit = (FIT + FIT_PIXEL * window + FIT_SURFEL * made.surfels) * made.refine_steps
        surfels = VIEW * views + (1 - rebuilt) * fit + rebuilt * step * whole_steps + photographed
        seconds = BUILD + surfels + LIGHT * len(recipe.lights) + frames * frame + WRITTEN * whole
        gathered = sample_bytes(made.surfels, views) + 2 * LANES * VIEW_BYTES
        lanes = min(LANES, pixels * recipe.path_spp)
        # One frame's buffers under every light, and a clip's encoded files until they are in the shard.
        held = len(recipe.lights) * pixels * FRAME_BYTES + whole / max(self.clips(item, settings), 1)
        return SceneCost(seconds, COMPRESSED * whole, PROCESS + max(gathered, LANE * lanes + held))

    def scratch_bytes(self, item: Work, settings: Settings) -> int:
        """Return the bytes of views for the fit, or of pictures and a checkpoint; then of frames of clips."""
        recipe, made = settings.split(item.split), settings.surfel_budget(item.split, item.index)
        views = made.views + (-(-made.views // 2) if recipe.moving_objects else 0)
        clip = recipe.frames * recipe.width * recipe.height * spooled_bytes(settings, item.split)
        judges = view_bytes(recipe.frames, recipe.width, recipe.height)
        refined = view_bytes(views, made.view_width, made.view_height) + judges
        pictures = made.views * made.view_pixels * PICTURE_BYTES
        spooled = clip * (len(recipe.lights) if recipe.lights_share_path else 1)
        shares, rebuilt = settings.surfels_from, 0
        if shares.reconstruction:  # it lies there until the clips are written
            rebuilt = pictures + made.surfels * CHECKPOINT_BYTES
        fitted = refined if made.refine_steps and shares.gbuffers else 0
        return max(fitted, rebuilt + max(judges if rebuilt else 0, spooled))


def _rays(settings: Settings, item: Work) -> float:
    """Return shadow rays per pixel of guidance, including margins of windows, mean over a scene's clips."""
    recipe = settings.split(item.split)
    of_clips = [
        settings.estimation(item.split, item.index, light).rays for light in range(len(recipe.lights))
    ]
    rays = sum(of_clips) / max(len(of_clips), 1)
    margin = 2 * MARGIN if any(width > recipe.width for width in recipe.window_of) else 0
    return rays * (1 + margin / recipe.width) * (1 + margin / recipe.height)


@stage("surfels")
def make_surfels(
    spec: SceneSpec, geometry: Geometry, settings: Settings
) -> tuple[GaussianScene, Refinement | None]:
    """Make surfels from the visible surfaces of a scene's views, fit them, and return the gain too.

    They are judged by the cameras of the first clip, which are not among those.
    """
    made = settings.surfel_budget(spec.split, spec.index)
    seen = _seen(spec, geometry, spec.views(made.views, made.view_width, made.view_height))
    if not made.refine_steps:
        return surfels_from_gbuffers(seen, count=made.surfels, detail=True), None
    recipe = settings.split(spec.split)
    folder = scene_folder(settings.output_dir, spec.name)
    seed = integer(spec.seed, spec.split, spec.index, "refinement")
    with ViewSpool(folder) as shown, ViewSpool(folder) as judges:
        surfels = surfels_from_gbuffers(shown.passing(seen), count=made.surfels, detail=True)
        # Judged at the size that they are made for, which windows show a part of.
        side = made.view_width if recipe.window_of else recipe.width
        cameras = spec.clip(0, recipe.frames, side, round(side * recipe.height / recipe.width))
        for _ in judges.passing(stream_gbuffers(geometry, cameras)):
            pass
        views, held_out = shown.views(), judges.views()
        return refine_surfels(surfels, views, held_out, made.refine_steps, seed)


def _seen(spec: SceneSpec, geometry: Geometry, cameras: Sequence[Camera]) -> Iterator[GBufferView]:
    """Yield true G-buffers of the views for surfels, a few in memory at a time.

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
    """Move the moving object to its place at a time; return its id."""
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
    """Render one clip per light, in the order of the specification.

    Each frame holds the schema's members, linear: guidance from the surfels, rgb path-traced from the meshes,
    both under the same baked map; with reference buffers also what Mitsuba says of the pixel centres. Lights
    that share a path share each frame's G-buffers and its paths. A clip's frames are read while it is the
    last that was given.
    """
    with stage("guidance"):
        seed = integer(spec.seed, spec.split, spec.index, "bounce")
        source = settings.surfels_from.of(spec.seed, spec.split, spec.index)
        rebuilt = source == "reconstruction" and spec.motion is None
        made = settings.surfel_budget(spec.split, spec.index)
        relighter = Relighter(
            surfels, settings.estimation(spec.split), seed,
            # What G-buffers make is one layer; where things move, a proxy would be made anew each frame.
            proxy=settings.surfel_reconstruction.proxy if rebuilt else "never",
            cameras=spec.views(made.views, made.view_width, made.view_height),
        ).prepare()  # fmt: skip
    folder = scene_folder(settings.output_dir, spec.name)
    for group in spec.groups():
        with Spool(folder, len(group)) as spool:
            for k, meta in enumerate(_film(spec, geometry, relighter, group, settings, spool)):
                yield meta, spool.clip(k)


@dataclass
class _Lit:
    """One light of a group, made ready.

    Attributes:
        number: its place in the scene's list, which names its seeds.
        lit: the surfels under it.
        seeds: what they are for -> one a frame.
        exposure: of its clip.
    """

    number: int
    environment: EnvironmentMap
    lit: Illumination
    seeds: dict[str, list[int]]
    exposure: float


@dataclass
class _Moment:
    """A scene at one time of its clips: places and light.

    Attributes:
        scenes: under no light, for frames that all lights share; or one a light.
        stacked: the lights of frames that are path-traced under all of them at once.
    """

    relighter: Relighter
    lights: list[_Lit]
    scenes: list[mi.Scene]
    stacked: mi.Integrator | None


def _moment(
    spec: SceneSpec,
    geometry: Geometry,
    relighter: Relighter,
    maps: Mapping[int, EnvironmentMap],
    settings: Settings,
    time: float,
) -> _Moment:
    """Return the scene at a time from 0 to 1 under lights of these numbers; it moves the geometry."""
    recipe, scene = settings.split(spec.split), relighter.scene
    if spec.motion is not None:
        which = scene.object_id == _move(spec, geometry, time)
        if time and which.any():
            scene = moved(scene, which, *_pose(spec, time))
    lights: list[_Lit] = []
    for number, map_ in maps.items():
        relighter = lights[-1].lit.relighter if lights else relighter
        lights.append(_prepare(spec, relighter, scene, number, map_, settings, time))
    relighter = lights[-1].lit.relighter
    together = spec.cameras.shared
    if together and not recipe.reference_buffers:
        scenes = [geometry.lit()]
    else:
        scenes = [geometry.lit(light.environment) for light in lights]
    stacked = stacked_lights([light.environment for light in lights], spec.path_bounces) if together else None
    return _Moment(relighter, lights, scenes, stacked)


@stage("guidance")
def _film(
    spec: SceneSpec,
    geometry: Geometry,
    relighter: Relighter,
    group: Sequence[int],
    settings: Settings,
    spool: Spool,
) -> list[ClipMeta]:
    """Render the clips of lights that are filmed from the same places, frame by frame."""
    recipe = settings.split(spec.split)
    windows = draw_windows(spec, geometry, recipe, group[0])
    cameras = [window.camera for window in windows]
    still = spec.motion is None and not any(spec.turns_deg)
    maps = {
        number: spec.lights[number].bake(settings.environment_height, settings.environments)
        for number in group
    }
    now = _moment(spec, geometry, relighter, maps, settings, 0.0)
    first = now.lights
    poses, shown = [], []
    for i, (window, camera) in enumerate(zip(windows, cameras)):
        time = i / max(len(cameras) - 1, 1)
        if i and not still:
            now = _moment(spec, geometry, relighter, maps, settings, time)
        (truth,) = gbuffers(geometry, [camera])
        if spec.motion is not None:
            poses.append(_pose(spec, time).matrix())
            shown.append(truth.valid & (truth.object_id == _moving_id(spec)))
        seed = first[0].seeds["path"][i]
        rgb = _path_traced(now, camera, recipe.path_spp, seed, spec.path_bounces)
        if spec.metered and i == 0:
            _meter(now, window, rgb, truth, geometry, seed, spec.path_bounces)
        wide = window.with_margin().camera
        views = views_under([light.lit for light in now.lights], wide)
        surfaces = now.relighter.surface_maps(camera, *(light.lit.estimation for light in now.lights))
        finer = [light.lit.framed(supersample=2) for light in now.lights if recipe.reference_buffers]
        fine = views_under(finer, camera) if finer else []
        for k, light in enumerate(now.lights):
            guidance = light.lit.render(wide, light.seeds["guidance"][i], view=views[k])
            frame = window.cut(stored_guidance(guidance)) | surfaces[k]
            frame |= {"rgb": rgb[k], "foreground": truth.valid.astype(np.float32)}
            if recipe.reference_buffers:
                seed = light.seeds["reference"][i]
                direct = direct_irradiance(geometry, now.scenes[k], camera, recipe.reference_spp, seed)
                own = window.cut({name: guidance.gbuffer[name] for name in OF_SURFELS})
                frame |= _reference(camera, truth, direct, light.environment) | own
                seed, mirrors = light.seeds["guidance"][i], finer[k].estimation.bounces > 0
                mirrored = finer[k].framed(reflections=REFERENCE_REFLECTIONS * mirrors)
                frame["lit_supersampled"] = finer[k].render(camera, seed, view=fine[k]).lit
                frame["lit_reflections"] = mirrored.render(camera, seed, view=fine[k]).lit
            spool.add(k, frame)
    if spec.motion is not None:
        _move(spec, geometry, 0.0)
    source = settings.surfels_from.of(spec.seed, spec.split, spec.index)
    motion = Moving(np.stack(poses), np.stack(shown)).text() if poses else ""
    return [_meta(spec, light, cameras, recipe, source, motion) for light in first]


def _path_traced(now: _Moment, camera: Camera, spp: int, seed: int, bounces: int) -> np.ndarray:
    """Path-trace linear radiance under each light of a moment, (lights, H, W, 3)."""
    if now.stacked is None:
        return render_frames(now.scenes[0], [camera], spp, [seed], bounces)
    return render_lights(now.scenes[0], now.stacked, camera, spp, seed)


def _meter(
    now: _Moment,
    window: Window,
    rgb: np.ndarray,
    truth: GBufferView,
    geometry: Geometry,
    seed: int,
    bounces: int,
) -> None:
    """Expose each light's clip for its whole first picture, not for a window of it."""
    valid, picture = truth.valid, window.picture
    if (picture.width, picture.height) != (window.width, window.height):
        small = picture.resized(METER_WIDTH, max(1, round(METER_WIDTH * picture.height / picture.width)))
        rgb = _path_traced(now, small, METER_SPP, seed, bounces)
        valid = gbuffers(geometry, [small])[0].valid
    for light, seen in zip(now.lights, rgb):
        light.exposure = metered(seen, valid, light.exposure)


def _prepare(
    spec: SceneSpec,
    relighter: Relighter,
    scene: GaussianScene,
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
    seed = integer(spec.seed, spec.split, spec.index, "light", number, "bounce")
    lit = relighter.bring(scene, environment, seed=seed)
    frames = settings.estimation(spec.split, spec.index, number)
    lit = lit.framed(**{name: getattr(frames, name) for name in OF_FRAMES})
    own = ("light", number, "frame")
    where = {"path": ("frame",) if shared else own, "guidance": own, "reference": own}
    seeds = {what: _seeds(spec, recipe.frames, what, *path) for what, path in where.items()}
    return _Lit(number, environment, lit, seeds, environment.exposure())


def _meta(
    spec: SceneSpec,
    lit: _Lit,
    cameras: Sequence[Camera],
    recipe: SplitSettings,
    surfels_from: SurfelSource,
    motion: str,
) -> ClipMeta:
    surfels = len(lit.lit.relighter.scene)
    light = spec.lights[lit.number]
    estimation = lit.lit.estimation
    spp = {"path": recipe.path_spp, "guidance": estimation.rays}
    if estimation.reflections:
        spp["reflections"] = estimation.reflections
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
            "filtered": estimation.filtered,
            "sub_pixels": estimation.supersample,
            "surfels": surfels,
            "proxy": lit.lit.relighter.proxy is not None,
            MOTION: motion,
            "light_spec": light.model_dump_json(),  # text: families differ in their keys, and tables cannot
        },
    )


def _seeds(spec: SceneSpec, frames: int, what: str, *path: str | int) -> list[int]:
    return [integer(spec.seed, spec.split, spec.index, *path, i, what) for i in range(frames)]


def _reference(
    camera: Camera,
    truth: GBufferView,
    direct: DirectIrradiance,
    environment: EnvironmentMap,
) -> Frame:
    """Return reference members of a frame; behind the scene irradiance is the environment, as in guidance."""
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
    return {f"{name}_ref": np.where(seen, image, behind) for name, image in light.items()} | {
        f"{name}_ref": np.where(seen, np.atleast_3d(image), 0.0) for name, image in surface.items()
    }


def make_scene(item: Work, settings: Settings, sources: Sources) -> Record:
    """Make one scene: specification, surfels, shards, contact sheets and at last its record.

    Runs in a worker. Everything is written under final names atomically; a second run writes the same bytes.
    """
    activate(settings.variant, threads=1)
    output = settings.output_dir
    spec, geometry = draw_and_build(item, settings, sources, settings.split(item.split).lights)
    folder = scene_folder(output, item.name)
    write_atomic(folder / "spec.json", spec.to_json())
    refinement = reconstruction = None
    if settings.surfels_from.of(settings.seed, item.split, item.index) == "reconstruction":
        surfels, reconstruction = reconstruct_surfels(spec, geometry, settings)
    else:
        surfels, refinement = make_surfels(spec, geometry, settings)
    surfels.save(folder / "surfels.ply")

    clips = make_clips(spec, geometry, surfels, settings)
    files = write_clips(output, item, clips, settings.clips_per_shard)
    record = Record(
        name=item.name,
        shards=files.shards,
        quarantined=files.quarantined,
        refinement=refinement,
        clips=files.rows(),
        variety=_variety(geometry, files.made),
        reconstruction=reconstruction,
    )
    clear_work(folder)
    write_atomic(folder / RECORD_NAME, record.model_dump_json(indent=1) + "\n")
    return record


def _variety(geometry: Geometry, made: Sequence[tuple[ClipMeta, Frame]]) -> Histograms:
    """Count histograms of the clips' first frames, which stand for the others."""
    cameras = [Camera.from_dict(meta.cameras[0]) for meta, _ in made]
    return total(
        frame_histograms(frame | surface_members(truth), camera, meta.extra.get("contrast_share"))
        for (meta, frame), camera, truth in zip(made, cameras, gbuffers(geometry, cameras))
    )
