"""Surfels of a synthetic scene against the truth: refined by it, or found from pictures as a capture's are.

For the latter the scene's views are path-traced under one of its lights, turned to display values and
reconstructed, flaws included; all of it lies in a folder of the scene until the scene is finished, so that a
run that was killed goes on.
"""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from datagen.clock import stage
from datagen.dataset.records import WORK, Figures, ReconstructedFigures, Refinement, scene_folder
from datagen.dataset.spool import ViewSpool
from datagen.photographs.perfect import captured
from datagen.settings.captures import CaptureSettings
from datagen.settings.command import Settings
from datagen.truth.build import Geometry
from datagen.truth.pathtrace import stream_gbuffers
from datagen.world.scene import SceneSpec
from tron.cameras import Camera
from tron.captures import Capture, View
from tron.captures.folder import read_capture_folder, write_capture
from tron.gaussians.initialize import surfels_from_gbuffers
from tron.gaussians.scene import GaussianScene
from tron.metrics import albedo_scale
from tron.reconstruction import GroundTruth, Joint, reconstruct
from tron.reconstruction.geometry.losses import MATERIALS, Weights
from tron.reconstruction.geometry.surfels import LearntSurfels
from tron.reconstruction.geometry.training import Plan, Stage
from tron.reconstruction.scores import mean_figures, score_views
from tron.reconstruction.settings import (
    DensitySettings,
    RadianceSettings,
    ReconstructionSettings,
)
from tron.runtime import set_torch_threads
from tron.seeds import integer
from tron.tracing import SurfelTracer

log = logging.getLogger(__name__)

OPAQUE = 0.99
"""Opacity above which a pixel shows surfels alone."""
RATES = {
    "means": 0.01,
    "quats": 0.005,
    "log_scales": 0.01,
    "opacity_logits": 0.05,
    **dict.fromkeys(MATERIALS, 0.01),
}
"""Adam's rates, of the positions in surfel spacings: the demo's figures come of these and the weights."""
LAST_RATE = 0.1
"""Share of every rate that is left at the last step."""
WEIGHTS = Weights(normal=0.5, mask=0.5, base_color=1.0, roughness=0.2, metallic=0.2)
SCALED_BY = 8
"""Views, at most, that tell the scale of the base color."""


@stage("reconstruct")
def reconstruct_surfels(
    spec: SceneSpec, geometry: Geometry, settings: Settings
) -> tuple[GaussianScene, ReconstructedFigures]:
    """Surfels reconstructed from pictures of a scene, and how near they are to the truth.

    Where light and materials are fitted together, base color is brought to the truth's scale. They are judged
    by the cameras of the first clip, which are not among the pictures'.

    Raises:
        TronError: the scene's folder cannot be written, or a reconstruction of other settings lies there.
    """
    set_torch_threads(1)  # sums repeat bit by bit
    wanted = settings.surfel_reconstruction
    folder = scene_folder(settings.output_dir, spec.name) / WORK
    capture = _pictures(spec, geometry, settings, folder)
    joint = wanted.prior == "joint"
    prior = Joint(same_exposure=True) if joint else GroundTruth()
    recipe = ReconstructionSettings(
        radiance=RadianceSettings(density=DensitySettings(most=settings.surfels)),
        steps_scaler=wanted.steps_scaler,
        checkpoint_every=wanted.checkpoint_every,
        seed=integer(spec.seed, spec.split, spec.index, "reconstruction", bits=31),
    )
    found = reconstruct(capture, prior, recipe, checkpoint=folder / "checkpoint.safetensors")
    scene, factors = found.scene, None
    if joint:
        scene, factors = at_true_scale(scene, _base_colors(spec, geometry, settings))
    if spec.motion is not None:
        scene = _with_objects(scene, spec, geometry, settings)
    return scene, _judged(scene, factors, spec, geometry, settings)


def light_of_pictures(spec: SceneSpec) -> int:
    """Number of the scene's light that its pictures are taken under."""
    return integer(spec.seed, spec.split, spec.index, "reconstruction", "light") % len(spec.lights)


def _pictures(spec: SceneSpec, geometry: Geometry, settings: Settings, folder: Path) -> Capture:
    """The scene's views as a capture on disk, path-traced unless they are there."""
    where = folder / "pictures"
    if not where.is_dir():
        shutil.rmtree(folder, ignore_errors=True)  # half a capture
        light = spec.lights[light_of_pictures(spec)]
        environment = light.bake(settings.environment_height, settings.environments).baked()
        shots = CaptureSettings(
            views=max(settings.views, 2),
            width=settings.view_width,
            height=settings.view_height,
            path_spp=settings.surfel_reconstruction.path_spp,
            reference_spp=settings.surfel_reconstruction.reference_spp,
        )
        folder.mkdir(parents=True)
        write_capture(where, captured(spec, geometry, environment, shots))
    return read_capture_folder(where)


def _base_colors(
    spec: SceneSpec, geometry: Geometry, settings: Settings
) -> Iterator[tuple[Camera, np.ndarray, np.ndarray]]:
    """Camera, true base color and mask of some of the views."""
    cameras = spec.views(max(settings.views, 2), settings.view_width, settings.view_height)
    for seen in stream_gbuffers(geometry, cameras[:: -(-len(cameras) // SCALED_BY)]):
        yield seen.camera, seen.base_color, seen.valid


def _with_objects(
    surfels: GaussianScene, spec: SceneSpec, geometry: Geometry, settings: Settings
) -> GaussianScene:
    """The surfels with the ids of the objects that they lie on, which no picture tells."""
    cameras = spec.views(settings.views, settings.view_width, settings.view_height)
    truth = surfels_from_gbuffers(stream_gbuffers(geometry, cameras), count=settings.surfels)
    _, nearest = KDTree(truth.means).query(surfels.means)
    return replace(surfels, object_id=truth.object_id[np.asarray(nearest)])


def _judged(
    surfels: GaussianScene,
    factors: np.ndarray | None,
    spec: SceneSpec,
    geometry: Geometry,
    settings: Settings,
) -> ReconstructedFigures:
    recipe = settings.split(spec.split)
    cameras = spec.clip(0, recipe.frames, recipe.width, recipe.height)
    with ViewSpool(scene_folder(settings.output_dir, spec.name)) as judges:
        for _ in judges.passing(stream_gbuffers(geometry, cameras)):
            pass
        figures = figures_of(SurfelTracer(surfels), judges.views())
    log.info(
        "%d surfels reconstructed: base color %.1f dB, normals %.2f degrees",
        len(surfels), figures.base_color_psnr, figures.normal_mae_deg,
    )  # fmt: skip
    scale = None if factors is None else (float(factors[0]), float(factors[1]), float(factors[2]))
    return ReconstructedFigures(**figures.model_dump(), albedo_scale=scale)


@stage("refine")
def refine_surfels(
    surfels: GaussianScene,
    seen: Sequence[View],
    held_out: Sequence[View],
    steps: int,
    seed: int,
) -> tuple[GaussianScene, Refinement]:
    """Fit surfels to what ``seen`` shows of them, and judge them by ``held_out``; one view is read at a time.

    Args:
        surfels: as made from ``seen``. steps: of the optimisation. seed: of the order of views.
    """
    # The loss is small beside the tracing, and sums repeat bit by bit with one thread alone.
    set_torch_threads(1)
    started = time.perf_counter()
    refined = _fitted(surfels, seen, steps, seed)
    seconds = time.perf_counter() - started
    before, after = (figures_of(SurfelTracer(scene), held_out) for scene in (surfels, refined))
    found = Refinement(steps=steps, before=before, after=after)
    log.info(
        "surfels refined in %.1f s: base color %.1f -> %.1f dB, normals %.2f -> %.2f degrees",
        seconds, found.before.base_color_psnr, found.after.base_color_psnr,
        found.before.normal_mae_deg, found.after.normal_mae_deg,
    )  # fmt: skip
    return refined, found


def figures_of(tracer: SurfelTracer, views: Sequence[View]) -> Figures:
    """Surfels against the true G-buffers of views, one read at a time."""
    means = mean_figures(score_views(tracer, views))
    errors = [
        np.abs(tracer.gbuffer(view.camera).numpy()["opacity"] - view.read("mask")).mean() for view in views
    ]
    return Figures(
        base_color_psnr=round(means["base_color_psnr"], 4),
        normal_mae_deg=round(means["normal_mae_deg"], 4),
        silhouette_error=round(float(np.mean(errors)), 6),
    )


def _fitted(scene: GaussianScene, views: Sequence[View], steps: int, seed: int) -> GaussianScene:
    """The scene after some steps of the reconstruction's own optimiser, on all that the views know at once.

    Surfels made straight from G-buffers blur what is smaller than they are and overhang silhouettes by a
    pixel. Every parameter answers to the views, which have normal, base_color, roughness, metallic and mask.
    None is added: object ids, spacing and order of the surfels are kept.
    """
    if not steps:
        return scene
    rates = {**RATES, "means": RATES["means"] * scene.spacing}
    plan = Plan(
        name="refinement",
        steps=steps,
        weights=WEIGHTS,
        rates=rates,
        final_rates={name: LAST_RATE * rate for name, rate in rates.items()},
    )
    surfels = LearntSurfels.of_scene(scene, plan.rates)
    Stage(plan, views, surfels, scene.kernel_degree, seed).run()
    found = surfels.scene(scene.kernel_degree, scene.up)
    found.object_id, found.spacing = scene.object_id, scene.spacing
    return found.validate()


def at_true_scale(
    surfels: GaussianScene, truth: Iterable[tuple[Camera, np.ndarray, np.ndarray]]
) -> tuple[GaussianScene, np.ndarray]:
    """The surfels with their base color scaled to the truth, and the factors (3,).

    A joint fit of light and materials leaves one factor a channel open: twice the reflectance under half the
    light is the same photo. Under another light it is not. Data that relighting is learnt from or judged by
    takes the factor from the truth, as evaluations of inverse rendering do (NeRFactor, TensoIR).

    The factors are the median ratios over the pixels of all views where both show a surface; they are 1 where
    there is no such pixel. Base color stays in [0, 1]. The log says the factors.

    Args:
        surfels: of a reconstruction.
        truth: views: camera, true base color (H, W, 3) linear, mask (H, W) of the pixels that have one.
    """
    tracer = SurfelTracer(surfels)
    found, wanted = [], []
    for camera, base_color, mask in truth:
        buffers = tracer.gbuffer(camera).numpy()
        both = (mask > 0) & (buffers["opacity"] > OPAQUE)
        found.append(buffers["base_color"][both])
        wanted.append(base_color[both])
    if not sum(map(len, found)):
        log.warning("no view shows the surfels where the truth has a surface: base color is left as it is")
        return surfels, np.ones(3)
    factors = albedo_scale(np.concatenate(found), np.concatenate(wanted), method="median_ratio")
    log.info("base color scaled by %.2f, %.2f, %.2f", *factors)
    scaled = np.clip(surfels.base_color * factors.astype(np.float32), 0, 1)
    return replace(surfels, base_color=scaled), factors
