"""tron-bake: a scene under a light as a file of splats, which every splat viewer draws."""

from __future__ import annotations

import logging
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from tron.apps.scene_file import SURROUNDINGS, FoundMaterials, SeenAs, Up, check_scene_files
from tron.apps.splat_file import SPLATS, SceneFile
from tron.cli.command_line import command
from tron.cli.installation import loading
from tron.cli.progress import track, working
from tron.color import Look
from tron.runtime import Threads, Variant, activate
from tron.scans import Treatment

log = logging.getLogger(__name__)

SIDE = 256
"""Pixels of the frame that exposure is metered in."""
MIRRORING = 0.5
"""Roughness below which lobes are narrower than harmonics of degree 3 can show."""


class Settings(BaseModel):
    """Everything that tron-bake can be told."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    scene: SceneFile = Field(description="the scene: a PLY of TRON, 3DGS or 2DGS, or another file of splats")
    environment: Path = Field(
        description="environment map, .hdr or .exr (.png and .jpg are clipped), or what else "
        "tron-environment reads"
    )
    output: Path = Field(
        description=f"file to write, or to replace, not the scene's own: {', '.join(SPLATS)}"
    )
    rotation: float = Field(
        0.0, description="rotation of the environment about up, degrees, counter-clockwise seen from above"
    )
    exposure: Literal["auto"] | Annotated[float, Field(gt=0)] = Field(
        "auto",
        description="factor before the tone curve; auto: metered as by tron-relight, which the log says",
    )
    look: Look = Field("photograph", description="tone: AgX with the contrast that photographs have, or none")
    surroundings: Treatment = Field("drop", description=SURROUNDINGS)
    proxy: Literal["auto", "always", "never"] = Field(
        "auto", description="whether light is computed on a proxy of the scan, as in tron-relight"
    )
    projection: SeenAs = "auto"
    materials: FoundMaterials = "auto"
    up: Up = None
    seed: int = Field(0, description="root of all random numbers")
    variant: Variant = "llvm_ad_rgb"
    threads: Threads = None


def main(settings: Settings) -> None:
    """Light a Gaussian scene and write what it looks like as splats, for any splat viewer.

    Shadows, bounced light and rough reflections are in the file's spherical harmonics (degree 3), as display
    values: viewers show them as they are. Reflections sharper than harmonics are blurred. The file has 3DGS'
    kernel and properties, in the scene's own frame; materials stay in the scene.
    """
    with loading("tron-bake"):  # not for --help or a mistyped key
        import numpy as np

        from tron.gaussians.splat_files import check_count, check_suffix, write_splats
        from tron.relighting.baking import baked
        from tron.scans.scan import Scan
        from tron.shading.environments.environment import EnvironmentMap

    check_suffix(settings.output)
    check_scene_files(settings.scene, settings.output)
    with working("reading the light and the scene"):
        environment = EnvironmentMap.load(settings.environment)
        activate(settings.variant, settings.threads)
        scan = Scan.open(
            settings.scene, up=settings.up, projection=settings.projection, materials=settings.materials,
            surroundings=settings.surroundings, seed=settings.seed, apart=settings.output.parent, track=track,
        )  # fmt: skip
    check_count(settings.output, len(scan.loaded))
    environment = scan.over(environment, settings.environment)
    # Splats hold no ground, and light that falls on the subject is metered.
    relighter = scan.relighter(proxy=settings.proxy, ground=None)
    light = relighter.under(environment.rotated(settings.rotation))
    exposure = settings.exposure
    if exposure == "auto":
        fov_deg = scan.filmed[0].fov_deg if scan.filmed else 40.0
        (camera,) = scan.film("still", 1, SIDE, SIDE, fov_deg)  # the first of tron-relight's orbit
        exposure = light.render(camera, settings.seed).exposure(settings.look)
        log.info(
            "exposure %.4g, metered; exposure=%.4g keeps it, twice as much is a stop brighter",
            exposure, exposure,
        )  # fmt: skip
    lit = baked(light, exposure, settings.look, partial(track, label="baking"))
    if not np.allclose(scan.turn, np.eye(3)):
        lit = lit.rotated(scan.turn.T)
    write_splats(settings.output, lit)
    smooth = float((scan.scene.roughness < MIRRORING).mean())
    if smooth > 0:
        log.info(
            "%.0f %% of the surfels have a roughness below %.1f: their reflections are blurred, since "
            "harmonics of degree 3 hold nothing sharper", 100 * smooth, MIRRORING,
        )  # fmt: skip
    log.info("%d splats, for any 3DGS viewer: %s", len(lit), settings.output)


cli = command(
    "tron-bake",
    "conf.bake",
    Settings,
    main,
    shown=(
        *("scene", "environment", "output", "rotation", "exposure", "look", "surroundings"),
        *("proxy", "up", "materials"),
    ),
    examples=(
        "tron-bake scene=surfels.ply environment=studio.hdr output=relit.ply",
        "tron-bake scene=scan.ply environment=sunset.hdr rotation=90 up=[0,0,1] output=evening.ply",
        "tron-bake scene=scan.ply environment=studio.hdr surroundings=keep look=none output=plain.spz",
    ),
    ended="no file was written; materials and a proxy that were found for a scan are kept",
)

if __name__ == "__main__":
    cli()
