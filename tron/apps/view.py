"""tron-view: a scene in a browser, to be looked at, lit and changed."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from tron.apps.scene_file import GROUND, SeenAs, Up, check_scene_files
from tron.apps.splat_file import SceneFile
from tron.cli.command_line import command
from tron.cli.installation import loading
from tron.cli.progress import track, working
from tron.errors import TronError
from tron.runtime import Threads, Variant, activate
from tron.scans import GroundChoice

if TYPE_CHECKING:
    from tron.view.window import Window

log = logging.getLogger(__name__)

LOCAL = ("127.0.0.1", "localhost", "::1")


class Settings(BaseModel):
    """Everything that tron-view can be told."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    scene: SceneFile = Field(
        description="the scene: a PLY of TRON, 3DGS or 2DGS, or another file of splats; it stays as it is"
    )
    environments: Path = Field(
        description="folder of lat-long environment maps (.hdr, .exr, .png, .jpg), or one of them"
    )
    light: str | None = Field(
        None,
        description="the first map, by its name without suffix; null: the light of the capture, else the "
        "brightest of the first 8",
    )
    models: Path | None = Field(None, description="folder of PLYs that may be inserted; null: none")
    output_dir: Path = Field(Path("outputs/view"), description="folder for saved pictures, scenes and edits")
    host: str = Field(
        "127.0.0.1", description="address to listen on; 0.0.0.0 lets everybody on the network in"
    )
    port: int = Field(8080, ge=1, le=65535, description="port to listen on")
    ground: GroundChoice = Field("auto", description=GROUND)
    projection: SeenAs = "auto"
    materials: Literal["kept", "auto", "as_is"] = Field(
        "kept",
        description="of a scan without any; kept: those that were found before, else guessed from its "
        "colours until a button of the page finds them; auto: found while those are shown; as_is: guessed",
    )
    up: Up = None
    seed: int = Field(0, description="root of all random numbers")
    variant: Variant = "llvm_ad_rgb"
    threads: Threads = None


def main(settings: Settings) -> None:
    """Show a Gaussian scene in a browser: turn the light, walk around, hide, paint, move, insert, save.

    Open the address that it prints. Pictures are rough while something moves, get fine at rest and end with
    the network that checkpoint=auto of tron-relight takes, or Open Image Denoise where it is installed.
    Clicks inside and outside cut an object out of a scan; a divider compares with the scene before the edits,
    its own look or another light. Edits are those of tron-edit: they are undone one by one and saved as its
    YAML. "Film" saves the view, or the path through those that are kept, and says the tron-relight command
    line that films it. Ends with Ctrl-C.
    """
    window = opened(settings)
    if settings.host not in LOCAL:
        log.warning("everybody who reaches %s can look, change and save", settings.host)
    log.info("open %s in a browser; Ctrl-C ends it", window.address)
    try:
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:  # how it ends
        pass
    finally:
        window.close()


def opened(settings: Settings) -> Window:
    """A window that serves until it is closed.

    Raises:
        TronError: a file is missing or no scene, no map, no PLY; the port is taken.
    """
    with loading("tron-view"):  # viser and Mitsuba: not for --help
        from tron.io.lights import LIGHT_SUFFIXES
        from tron.scans.scan import Scan, is_of_capture
        from tron.shading.environments.environment import EnvironmentMap
        from tron.view.finding import MaterialSearch
        from tron.view.opening import files_of, finish_of, first_light, home_of
        from tron.view.window import Window, require_free_port

    output = settings.output_dir
    if output.exists() and not output.is_dir():
        raise TronError("output_dir is a file", output, "give a folder, which need not exist")
    check_scene_files(settings.scene, output / "scene.ply")
    lights = files_of(settings.environments, LIGHT_SUFFIXES, "environment map")
    models = {} if settings.models is None else files_of(settings.models, (".ply",), "PLY")
    own = {name: file for name, file in lights.items() if is_of_capture(file, settings.scene)}
    first = first_light(lights, settings.light, own, settings.environments)
    require_free_port(settings.host, settings.port)
    activate(settings.variant, settings.threads)
    given: dict[str, Any] = {
        "up": settings.up, "projection": settings.projection, "seed": settings.seed, "apart": output,
    }  # fmt: skip
    with working("reading the scene"):
        materials = "as_is" if settings.materials == "as_is" else "kept"
        scan = Scan.open(settings.scene, **given, materials=materials, track=track, key="")
        turned = {name: scan.over(EnvironmentMap.load(file), file) for name, file in own.items()}
    search = None
    if settings.materials != "as_is":
        search = MaterialSearch(settings.scene, given, settings.ground, settings.variant, settings.threads)
    return Window(
        scan.in_file, settings.scene, lights, models, output, settings.host, settings.port,
        home_of(scan.loaded), turned, first, search, settings.materials == "auto",
        about=scan.about(settings.ground), seed=scan.root, variant=settings.variant,
        threads=settings.threads, finish=finish_of(settings.threads),
    )  # fmt: skip


cli = command(
    "tron-view",
    "conf.view",
    Settings,
    main,
    shown=(
        *("scene", "environments", "light", "models", "output_dir", "host", "port", "ground"),
        *("materials", "up"),
    ),
    examples=(
        "tron-view scene=surfels.ply environments=hdris",
        "tron-view scene=scan.ply environments=studio.hdr models=things port=8090",
        "tron-view scene=scan.ply environments=hdris materials=auto up=[0,0,1]",
    ),
    ended="what was saved is kept",
)

if __name__ == "__main__":
    cli()
