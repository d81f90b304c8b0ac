"""Surfels of a synthetic scene as a capture's are found: from pictures of it, flaws included.

The scene's views are path-traced under one of its lights, turned to display values and reconstructed; all of
it lies in a folder of the scene until the scene is finished, so that a run that was killed goes on.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from datagen.albedo_scale import at_true_scale
from datagen.build import Geometry
from datagen.capture_export import captured
from datagen.capture_settings import CaptureSettings
from datagen.clock import stage
from datagen.pathtrace import stream_gbuffers
from datagen.plan import ReconstructedFigures, scene_folder
from datagen.refinement import figures_of
from datagen.scene import SceneSpec
from datagen.settings import Settings
from datagen.view_spool import ViewSpool
from tron.cameras import Camera
from tron.captures import Capture
from tron.captures.folder import read_capture_folder, write_capture
from tron.gaussians.initialize import surfels_from_gbuffers
from tron.gaussians.scene import GaussianScene
from tron.priors import GroundTruth, Prior
from tron.reconstruction import Joint, reconstruct
from tron.reconstruction.settings import (
    DensitySettings,
    MaterialSettings,
    RadianceSettings,
    ReconstructionSettings,
)
from tron.runtime import set_torch_threads, torch_device
from tron.seeds import integer
from tron.tracing import SurfelTracer

log = logging.getLogger(__name__)

FOLDER = "reconstruction"
"""Folder of a scene that holds its pictures and the checkpoint while it is made."""
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
    folder = scene_folder(settings.output_dir, spec.name) / FOLDER
    capture = _pictures(spec, geometry, settings, folder)
    prior: Prior | Joint = GroundTruth()
    if wanted.prior == "joint":
        prior = Joint(tone_curve="agx", same_exposure=True)
    recipe = ReconstructionSettings(
        radiance=RadianceSettings(density=DensitySettings(most=settings.surfels)),
        steps_scaler=wanted.steps_scaler,
        checkpoint_every=wanted.checkpoint_every,
        seed=integer(spec.seed, spec.split, spec.index, "reconstruction", bits=31),
    )
    device = torch_device(settings.variant)
    found = reconstruct(capture, prior, recipe, checkpoint=folder / "checkpoint.safetensors", device=device)
    scene, factors = found.scene, None
    if isinstance(prior, Joint):
        scene, factors = at_true_scale(scene, _base_colors(spec, geometry, settings))
    if spec.motion is not None:
        scene = _with_objects(scene, spec, geometry, settings)
    return scene, _judged(scene, factors, spec, geometry, settings)


def reconstruction_steps(settings: Settings) -> int:
    """Optimisation steps of a scene's reconstruction, both stages."""
    steps = RadianceSettings().steps + MaterialSettings().steps
    return round(steps * settings.surfel_reconstruction.steps_scaler)


def forget_reconstruction(scene: Path) -> None:
    """Remove what a scene's reconstruction was made from; the last thing before its record."""
    shutil.rmtree(scene / FOLDER, ignore_errors=True)


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
