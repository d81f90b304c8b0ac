"""Surfels of a synthetic scene, reconstructed from pictures as for a capture.

The scene's views are path-traced under one of its lights, turned to display values and
reconstructed, flaws included; all of it lies in a folder of the scene until the scene is finished, so that a
run that was killed goes on.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from datagen.clock import stage
from datagen.dataset.records import WORK, ReconstructedFigures, scene_folder
from datagen.dataset.spool import ViewSpool
from datagen.photographs.perfect import captured
from datagen.settings.captures import CaptureSettings
from datagen.settings.command import Settings
from datagen.sources.refinement import figures_of
from datagen.truth.build import Geometry
from datagen.truth.pathtrace import stream_gbuffers
from datagen.world.scene import SceneSpec
from tron.cameras import Camera
from tron.captures import Capture
from tron.captures.folder import read_capture_folder, write_capture
from tron.gaussians.initialize import surfels_from_gbuffers
from tron.gaussians.scene import GaussianScene
from tron.metrics import albedo_scale
from tron.reconstruction import GroundTruth, Joint, reconstruct
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
SCALED_BY = 8
"""Views, at most, that tell the scale of the base color."""


@stage("reconstruct")
def reconstruct_surfels(
    spec: SceneSpec, geometry: Geometry, settings: Settings
) -> tuple[GaussianScene, ReconstructedFigures]:
    """Reconstruct surfels from pictures of a scene, and measure their errors.

    Where light and materials are fitted together, base color is brought to the truth's scale. They are judged
    by the cameras of the first clip, which are not among the pictures'.

    Raises:
        TronError: the scene's folder cannot be written, or a reconstruction of other settings lies there.
    """
    set_torch_threads(1)  # sums repeat bit by bit
    wanted = settings.surfel_reconstruction
    folder = scene_folder(settings.output_dir, spec.name) / WORK
    capture = _pictures(spec, geometry, settings, folder)
    joint, most = wanted.prior == "joint", settings.surfel_budget(spec.split, spec.index).surfels
    prior = Joint(same_exposure=True) if joint else GroundTruth()
    recipe = ReconstructionSettings(
        radiance=RadianceSettings(density=DensitySettings(most=most)),
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
    """Return the number of the light of the scene's pictures."""
    return integer(spec.seed, spec.split, spec.index, "reconstruction", "light") % len(spec.lights)


def _pictures(spec: SceneSpec, geometry: Geometry, settings: Settings, folder: Path) -> Capture:
    """Return the scene's views as a capture on disk, path-traced unless they exist."""
    where = folder / "pictures"
    if not where.is_dir():
        shutil.rmtree(folder, ignore_errors=True)  # half a capture
        light = spec.lights[light_of_pictures(spec)]
        environment = light.bake(settings.environment_height, settings.environments).baked()
        made = settings.surfel_budget(spec.split, spec.index)
        shots = CaptureSettings(
            views=max(made.views, 2),
            width=made.view_width,
            height=made.view_height,
            path_spp=settings.surfel_reconstruction.path_spp,
            reference_spp=settings.surfel_reconstruction.reference_spp,
        )
        folder.mkdir(parents=True)
        write_capture(where, captured(spec, geometry, environment, shots))
    return read_capture_folder(where)


def _base_colors(
    spec: SceneSpec, geometry: Geometry, settings: Settings
) -> Iterator[tuple[Camera, np.ndarray, np.ndarray]]:
    """Yield camera, true base color and mask of some views."""
    made = settings.surfel_budget(spec.split, spec.index)
    cameras = spec.views(max(made.views, 2), made.view_width, made.view_height)
    for seen in stream_gbuffers(geometry, cameras[:: -(-len(cameras) // SCALED_BY)]):
        yield seen.camera, seen.base_color, seen.valid


def _with_objects(
    surfels: GaussianScene, spec: SceneSpec, geometry: Geometry, settings: Settings
) -> GaussianScene:
    """Return the surfels with the true ids of their objects, which pictures do not show."""
    made = settings.surfel_budget(spec.split, spec.index)
    cameras = spec.views(made.views, made.view_width, made.view_height)
    truth = surfels_from_gbuffers(stream_gbuffers(geometry, cameras), count=made.surfels)
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


def at_true_scale(
    surfels: GaussianScene, truth: Iterable[tuple[Camera, np.ndarray, np.ndarray]]
) -> tuple[GaussianScene, np.ndarray]:
    """Scale the surfels' base color to the truth; return surfels and factors (3,).

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
