"""The mesh peer, `tron-eval method=mesh_peer`: a mesh fitted to photos, without Gaussians.

Each scene's surfels are learnt by TRON from its photos, without materials; :mod:`eval.methods.mesh_fit` makes
a mesh from them. Reported seconds include the surfels.
"""

from __future__ import annotations

import logging
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import Field

from eval.methods.making import Making
from eval.methods.mesh_fit import DENOISER, MeshSettings, fit_mesh, lit_frames, surface_maps
from eval.protocol.method import Method, MethodWriter, write_method
from eval.protocol.suite import SuiteScene
from tron.captures import Capture
from tron.captures.folder import read_capture_folder
from tron.captures.view import MAPS
from tron.cli.installation import require_own_packages
from tron.cli.progress import track
from tron.denoising import require
from tron.gaussians.scene import GaussianScene
from tron.reconstruction import Prior, reconstruct
from tron.reconstruction.priors.prior import Materials, Surfels
from tron.reconstruction.settings import ReconstructionSettings
from tron.runtime import activate, describe_machine, set_torch_threads
from tron.seeds import integer

log = logging.getLogger("tron.eval")


def only_photos(capture: Capture) -> Capture:
    """Return the capture without the true maps that a suite may have beside its photos."""
    bare = dict.fromkeys(MAPS.keys() - {"image", "mask", "valid"})
    return replace(capture, views=tuple(replace(view, **bare) for view in capture.views))


class NoMaterials(Prior):
    """Prior without materials: surfels from photos only."""

    def check(self, capture: Capture) -> None:
        """Accept any capture: photos are enough."""

    def find_materials(self, surfels: Surfels) -> Materials:
        """Find no materials: the surfels stay as learnt."""
        return Materials(surfels.scene)


class MeshPeer(Making):
    """Settings: the mesh, and the reconstruction that gives its depths."""

    mesh: MeshSettings = Field(default=MeshSettings(), description="settings of the mesh and its fit")
    surfels: ReconstructionSettings = Field(
        default=ReconstructionSettings(),
        description="settings of tron-reconstruct for the surfels, whose depths are fused",
    )

    def make(self, output_dir: Path) -> list[Path]:
        """Make surfels, mesh, fit and frames scene by scene; finished scenes are skipped."""
        suite = self.read_suite()
        require_own_packages("tron.reconstruction")
        require(DENOISER, "method=mesh_peer")
        settings = self.surfels
        activate()
        set_torch_threads(1)  # as tron-reconstruct has it: two would wait for each other beside Dr.Jit's
        method = Method(
            name="mesh_peer", title="textured mesh, fitted and path-traced by Mitsuba", suite=suite.id,
            color_space="linear", background="environment", scale="scene", saw=["photos", "masks"],
            citation="depths by TRON's surfels; materials and light by Mitsuba's prb",
            machine=str(describe_machine().get("cpu", "")),
        )  # fmt: skip
        folder, fits, frames = output_dir / method.name, list[float](), list[float]()
        with write_method(folder, method) as writer:
            for scene in suite.scenes.values():
                if not writer.has(scene.name, "normals"):
                    fit, frame = self._show(scene, settings, writer)
                    fits.append(fit)
                    frames.append(frame)
                    log.info("%s: mesh peer, fit %.0f s, a frame %.1f s", scene.name, fit, frame)
            if fits:
                writer.seconds(float(np.mean(fits)), float(np.median(frames)))
        return [folder]

    def _show(
        self, scene: SuiteScene, settings: ReconstructionSettings, writer: MethodWriter
    ) -> tuple[float, float]:
        """Write a scene; return seconds of its fit, surfels included, and of a frame."""
        capture, begun = only_photos(read_capture_folder(scene.train)), time.perf_counter()
        surfels: GaussianScene = reconstruct(capture, NoMaterials(), settings, track=track).scene
        seed = integer(self.seed, "mesh peer", scene.name)
        fitted = fit_mesh(capture, surfels, self.mesh, seed, track)
        fit, begun = time.perf_counter() - begun, time.perf_counter()
        for light in scene.lights:
            if not writer.has(scene.name, light):
                seeds = [integer(seed, light, number) for number in range(len(scene.cameras))]
                traced = lit_frames(
                    fitted.mesh, scene.cameras, scene.light(light), self.mesh.frame_spp, seeds
                )
                writer.frames(scene.name, light, np.stack([*traced]))
        spent = (time.perf_counter() - begun) / (len(scene.lights) * len(scene.cameras))
        color, normals = (np.stack(each) for each in zip(*surface_maps(fitted.mesh, scene.cameras)))
        writer.albedo(scene.name, color)
        writer.normals(scene.name, normals)
        return fit, spent
