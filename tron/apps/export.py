"""tron-export: a scene as a file for other programs."""

from __future__ import annotations

import logging
from functools import partial
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from tron.apps.scene_file import SeenAs, Up, check_output, check_scene_files
from tron.apps.splat_file import SPLATS, SceneFile
from tron.cli.command_line import ANEW, command
from tron.cli.installation import loading
from tron.cli.progress import track, working
from tron.errors import TronError
from tron.runtime import Threads, Variant, activate

log = logging.getLogger(__name__)

MESHES = (".glb", ".usdz")
POINTS = (".ply",)
Kind = Literal["mesh", "splats", "points"]


class Settings(BaseModel):
    """Everything that tron-export can be told."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    scene: SceneFile = Field(description="the scene: a PLY of TRON, 3DGS or 2DGS, or another file of splats")
    output: Path = Field(
        description=f"file to write, or to replace, not the scene's own; its name says the format: "
        f"{', '.join(MESHES)}, a mesh with textures; {', '.join(SPLATS)}, splats; .ply, points too"
    )
    kind: Kind | None = Field(None, description="null: a mesh in .glb and .usdz, splats in all others")
    cameras: Path | None = Field(
        None,
        description="cameras to write instead of the scene, as tron-relight takes them: cameras.json beside "
        "it, relight.json; output is then transforms.json, cameras.json (3DGS'), camera_path.json "
        "(nerfstudio's), images.txt (COLMAP's), or a .glb or .usda with one camera that moves, upright",
    )
    fps: float = Field(24.0, gt=0, le=240, description="frames a second of cameras that move")
    triangles: int = Field(60_000, ge=100, le=5_000_000, description="maximum number of triangles of a mesh")
    texture: int = Field(2048, ge=64, le=8192, description="side of a mesh's textures in pixels")
    projection: SeenAs = "auto"
    up: Up = None
    variant: Variant = "llvm_ad_rgb"
    threads: Threads = None


def main(settings: Settings) -> None:
    """Write a scene in a format of other programs.

    .glb and .usdz are a mesh with textures of base color, roughness, metallic and emission, for Blender,
    engines and web viewers, which light it anew. Its surface is fused from what views around the scene see,
    or the views of cameras.json beside it.

    The other formats are splats in the colours that they were captured with. .ply is 3DGS' own, which every
    viewer of splats and every converter reads; .spz (Niantic), .sog (PlayCanvas) and .splat are 5 to 20 times
    smaller and round what they hold; .splat has no colours that change with the view. .usd, .usda and .usdc
    are USD's particle fields, and so is .usdz with kind=splats; .glb with kind=splats is glTF's
    KHR_gaussian_splatting. Splats are flat, as TRON's surfels are; glTF and USD stand y up, the others in the
    scene's own frame. None of these formats has materials.

    kind=points writes a .ply of points with normals and colours, where the photos' map has them.

    tron-bake writes splats with another light in the colours. The file is written whole, at the end: a
    command that is ended before leaves none, and begins anew.
    """
    if settings.cameras is not None:
        _write_cameras(settings, settings.cameras)
        return
    from tron.gaussians.splat_files import check_suffix  # not for --help or a mistyped key

    check_suffix(settings.output)
    suffix = settings.output.suffix.lower()
    kind = settings.kind or ("mesh" if suffix in MESHES else "splats")
    fitting = {"mesh": MESHES, "splats": SPLATS, "points": POINTS}[kind]
    if suffix not in fitting:
        raise TronError(f"{suffix} holds no {kind}", settings.output, f"{kind}: {', '.join(fitting)}")
    check_scene_files(settings.scene, settings.output)
    {"mesh": _write_mesh, "splats": _write_splats, "points": _write_points}[kind](settings)


def _write_cameras(settings: Settings, file: Path) -> None:
    from tron.io.cameras.registry import UPRIGHT, cameras_of, check_camera_file, write_camera_file
    from tron.io.local_frame import moved_cameras
    from tron.scans.camera_files import in_frame_of
    from tron.scans.scan import Scan
    from tron.trajectories import turn_cameras

    check_camera_file(settings.output)
    check_scene_files(settings.scene, settings.output, file)
    check_output(settings.output, file, "the file of cameras")
    cameras = cameras_of(file, fps=settings.fps)
    with working("reading the scene"):
        scan = Scan.open(settings.scene, up=settings.up, materials="as_is")
    cameras = in_frame_of(scan.offset, cameras, file)
    stands, wanted = (path.suffix.lower() in UPRIGHT for path in (file, settings.output))
    if stands != wanted:
        cameras = turn_cameras(cameras, scan.turn if wanted else scan.turn.T)
    if not wanted:
        cameras = moved_cameras(cameras, scan.offset)
    write_camera_file(settings.output, cameras, settings.fps)
    log.info("%d cameras: %s", len(cameras), settings.output)


def _write_splats(settings: Settings) -> None:
    from tron.gaussians.edit import KERNEL_WIDTHS
    from tron.gaussians.scene import GaussianScene
    from tron.gaussians.splat_files import write_splats

    with working("reading the scene"):
        scene = GaussianScene.load(settings.scene)
    if scene.kernel_degree != 2:
        log.info(
            "splats of other programs fade more slowly: they are made %.2f times as wide, and edges soften",
            KERNEL_WIDTHS,
        )  # fmt: skip
    with working("writing"):
        write_splats(settings.output, scene)
    _log_written(settings, f"{len(scene)} splats")


def _write_points(settings: Settings) -> None:
    from tron.gaussians.scene import GaussianScene
    from tron.gaussians.splat_files import write_points

    with working("reading the scene"):
        scene = GaussianScene.load(settings.scene)
    _log_written(settings, f"{write_points(settings.output, scene)} points")


def _write_mesh(settings: Settings) -> None:
    try:
        # Mitsuba: not for --help; the extra `models`: not for splats
        with loading("tron-export"):
            from tron.meshing.surface import surface_of, views_of
            from tron.meshing.textures import textured
            from tron.models.write import write_glb, write_usdz
            from tron.scans.scan import Scan
            from tron.tracing.tracer import SurfelTracer
    except ModuleNotFoundError as error:
        what = f"{error.name} is not installed, which makes meshes"
        raise TronError(what, mend="pip install 'tron-relight[relight,models]'") from error
    activate(settings.variant, settings.threads)
    scan = Scan.open(settings.scene, up=settings.up, projection=settings.projection, materials="as_is")
    tracer, views = SurfelTracer(scan.scene), views_of(scan.scene, scan.filmed)
    surface = surface_of(tracer, views, triangles=settings.triangles, track=partial(track, label="surface"))
    part = textured(tracer, surface, settings.texture, track)
    with working("writing"):
        (write_glb if settings.output.suffix.lower() == ".glb" else write_usdz)(settings.output, part)
    _log_written(settings, f"{len(part.faces)} triangles")


def _log_written(settings: Settings, what: str) -> None:
    before, after = (path.stat().st_size for path in (settings.scene, settings.output))
    log.info("%s, %.3g MB of %.3g: %s", what, after / 1e6, before / 1e6, settings.output)


cli = command(
    "tron-export",
    "conf.export",
    Settings,
    main,
    shown=("scene", "output", "kind", "cameras", "fps", "triangles", "texture", "projection", "up"),
    examples=(
        "tron-export scene=scene/scene.ply output=scene.glb",
        "tron-export scene=surfels.ply output=surfels.spz",
        "tron-export scene=surfels.ply output=splats.glb kind=splats",
        "tron-export scene=scan.compressed.ply output=scan.spz",
        "tron-export scene=scene/scene.ply cameras=scene/cameras.json output=shot.glb",
    ),
    ended=ANEW,
)

if __name__ == "__main__":
    cli()
