"""tron-view: a scene in a browser, to be looked at, lit and changed."""

from __future__ import annotations

import logging
import time
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from tron.apps.machine import Threads, Variant
from tron.apps.scene_file import Up, check_scene_files, load_scene
from tron.cameras import Camera
from tron.cli.command_line import command
from tron.cli.progress import working
from tron.errors import TronError
from tron.gaussians.scene import GaussianScene
from tron.runtime import activate

log = logging.getLogger(__name__)

LIGHTS = (".hdr", ".exr", ".png", ".jpg", ".jpeg")
LOCAL = ("127.0.0.1", "localhost", "::1")


class Settings(BaseModel):
    """Everything that tron-view can be told."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    scene: Path = Field(
        description="PLY of the scene: TRON's, or a plain 3DGS or 2DGS file; it stays as it is"
    )
    environments: Path = Field(
        description="folder of lat-long environment maps (.hdr, .exr, .png, .jpg), or one of them"
    )
    models: Path | None = Field(None, description="folder of PLYs that may be inserted; null: none")
    output_dir: Path = Field(
        Path("outputs/view"), description="folder that pictures, scenes and edits are saved in"
    )
    host: str = Field(
        "127.0.0.1", description="address to listen on; 0.0.0.0 lets in everybody who reaches it"
    )
    port: int = Field(8080, ge=1, le=65535, description="port to listen on")
    up: Up = None
    seed: int = Field(0, description="root of all random numbers")
    variant: Variant = "llvm_ad_rgb"
    threads: Threads = None


def main(settings: Settings) -> None:
    """Show a Gaussian scene in a browser: turn the light, walk around, hide, paint, move, insert, save.

    Open the address that it prints. Pictures are rough while something moves and get fine at rest. Edits are
    those of tron-edit: they are undone one by one and saved as its YAML. "Film" saves the view and says the
    tron-relight command line that films it. Ends with Ctrl-C.
    """
    # viser and Mitsuba: not for --help
    from tron.shading.environments.environment import EnvironmentMap
    from tron.view.window import Window, require_free_port

    output = settings.output_dir
    if output.exists() and not output.is_dir():
        raise TronError("output_dir is a file", output, "give a folder, which need not exist")
    check_scene_files(settings.scene, output / "scene.ply")
    lights = _files(settings.environments, LIGHTS, "environment map")
    models = {} if settings.models is None else _files(settings.models, (".ply",), "PLY")
    EnvironmentMap.load(next(iter(lights.values())))  # others are read, or refused, when they are chosen
    require_free_port(settings.host, settings.port)
    logging.getLogger("websockets").setLevel(logging.WARNING)  # it says who comes and goes
    activate(settings.variant, settings.threads)
    with working("reading the scene"):
        scene = load_scene(settings.scene, settings.up, "as_is")
        home = _home(scene)
    window = Window(
        scene, settings.scene, lights, models, output, settings.host, settings.port, home,
        seed=settings.seed, variant=settings.variant, threads=settings.threads,
    )  # fmt: skip
    if settings.host not in LOCAL:
        log.warning("everybody who reaches %s can look, change and save", settings.host)
    log.info("open http://%s:%d in a browser; Ctrl-C ends it", settings.host, settings.port)
    try:
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:  # how it ends
        pass
    finally:
        window.close()


def _home(scene: GaussianScene) -> Camera:
    """The first view."""
    view = {"azimuth_deg": -60.0, "elevation_deg": 20.0, "distance": 1.1}
    return Camera.around(scene.upright(), **view, width=960, height=800)


def _files(where: Path, suffixes: tuple[str, ...], kind: str) -> dict[str, Path]:
    """Files of some kinds in a folder by their names without suffix, in order; or the one file."""
    if where.is_file():
        return {where.stem: where}
    if not where.is_dir():
        raise TronError("there is no such folder", where)
    found = sorted(path for path in where.iterdir() if path.suffix.lower() in suffixes and path.is_file())
    if not found:
        raise TronError(f"the folder holds no {kind}", where, f"give one with {', '.join(suffixes)}")
    twice = len({path.stem for path in found}) < len(found)
    return {path.name if twice else path.stem: path for path in found}


cli = command(
    "tron-view",
    "conf.view",
    Settings,
    main,
    examples=(
        "tron-view scene=surfels.ply environments=hdris",
        "tron-view scene=scan.ply environments=studio.hdr models=things port=8090",
    ),
)

if __name__ == "__main__":
    cli()
