"""tron-view: a scene in a browser, to be looked at, lit and changed."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from importlib.util import find_spec
from pathlib import Path
from tempfile import mkdtemp
from threading import Thread
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from tron.apps.capture_light import is_of_capture, over_scene
from tron.apps.machine import Threads, Variant
from tron.apps.relight.network_gains import Way, best_first
from tron.apps.scene_file import SeenAs, Up, check_scene_files, load_scene
from tron.apps.splat_file import SceneFile
from tron.cameras import Camera
from tron.cli.command_line import command
from tron.cli.installation import missing_libraries, require_extra
from tron.cli.progress import working
from tron.errors import TronError
from tron.framing import upright
from tron.gaussians.scene import GaussianScene
from tron.neural.shipped import DEFAULT, checkpoint_file, installed
from tron.runtime import activate, set_torch_threads, torch_device

if TYPE_CHECKING:
    from tron.neural.protocols import Renderer
    from tron.shading.environments.environment import EnvironmentMap
    from tron.view.finishing import Finish
    from tron.view.window import Window

log = logging.getLogger(__name__)

TRIED = 8
"""Maps that are read to find the brightest of them: 4,096 x 2,048 texels take half a second each."""
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
        description="the map to begin with, by its name without suffix; null: the light of the capture, else "
        f"the brightest of the first {TRIED}",
    )
    models: Path | None = Field(None, description="folder of PLYs that may be inserted; null: none")
    output_dir: Path = Field(
        Path("outputs/view"), description="folder that pictures, scenes and edits are saved in"
    )
    host: str = Field(
        "127.0.0.1", description="address to listen on; 0.0.0.0 lets in everybody who reaches it"
    )
    port: int = Field(8080, ge=1, le=65535, description="port to listen on")
    projection: SeenAs = "auto"
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
    # viser and Mitsuba: not for --help
    from tron.shading.environments.environment import EnvironmentMap
    from tron.shading.environments.light_files import LIGHT_SUFFIXES
    from tron.view.window import Window, require_free_port

    output = settings.output_dir
    if output.exists() and not output.is_dir():
        raise TronError("output_dir is a file", output, "give a folder, which need not exist")
    check_scene_files(settings.scene, output / "scene.ply")
    lights = _files(settings.environments, LIGHT_SUFFIXES, "environment map")
    models = {} if settings.models is None else _files(settings.models, (".ply",), "PLY")
    first = _first_light(settings, lights)
    require_free_port(settings.host, settings.port)
    logging.getLogger("websockets").setLevel(logging.WARNING)  # it says who comes and goes
    activate(settings.variant, settings.threads)
    with working("reading the scene"):
        scene = load_scene(settings.scene, settings.up, "as_is", settings.projection)
        home, turn = _home(scene), upright(scene.up)
        own = {name: file for name, file in lights.items() if is_of_capture(file, settings.scene)}
        turned = {k: over_scene(EnvironmentMap.load(f), f, settings.scene, turn) for k, f in own.items()}
    finish = _finish(settings.threads)
    return Window(
        scene, settings.scene, lights, models, output, settings.host, settings.port, home, turned,
        first, seed=settings.seed, variant=settings.variant, threads=settings.threads, finish=finish,
    )  # fmt: skip


def _first_light(settings: Settings, lights: Mapping[str, Path]) -> str:
    """The name of the map to begin with; the others are read, or refused, when they are chosen.

    Raises:
        TronError: it cannot be read, or there is none of that name.
    """
    from tron.shading.environments.environment import EnvironmentMap

    own = [name for name, file in lights.items() if is_of_capture(file, settings.scene)]
    tried = list(lights)[:TRIED] if settings.light is None and not own else [settings.light or own[0]]
    if tried[0] not in lights:
        raise TronError(
            f"light: no map is called {tried[0]}", settings.environments, f"give one of {', '.join(lights)}"
        )
    bright: dict[str, float] = {}
    for name in tried:
        try:
            bright[name] = 1 / EnvironmentMap.load(lights[name]).exposure()
        except TronError as error:
            if len(tried) == 1 or (name == tried[-1] and not bright):
                raise
            log.warning("%s", error)
    return max(bright, key=bright.__getitem__)


def _finish(threads: int | None) -> Callable[[int, int], Finish | None]:
    """What pictures at rest of a width and height are finished by.

    As checkpoint=auto of tron-relight has it, by the network or Open Image Denoise, whichever surely gains
    more. Where neither does Open Image Denoise, if installed, still takes the passes' noise out.
    """
    from tron.view.finishing import Denoised, Drawn

    drawn = denoised = None
    if not missing_libraries("network") and DEFAULT in installed():
        loaded: Future[Renderer] = Future()
        Thread(target=_load, args=(loaded, threads), daemon=True).start()
        drawn = Drawn(loaded)
    if find_spec("pyoidn") is not None:
        denoised = Denoised()
    there: list[Way] = [*(["network"] if drawn else []), *(["oidn"] if denoised else [])]

    def finish(width: int, height: int) -> Finish | None:
        best, gain = next(iter(best_first(there, "final", width, height).items()), (None, 0.0))
        return drawn if best == "network" and gain > 0 else denoised

    return finish


def _load(soon: Future[Renderer], threads: int | None) -> None:
    """The shipped network, while the scene is looked at: torch takes seconds."""
    try:
        from tron.neural.weights import load_renderer

        if threads is not None:
            set_torch_threads(threads)
        soon.set_result(load_renderer(checkpoint_file(DEFAULT)).to(torch_device()))
    except Exception as error:
        soon.set_exception(error)


def show(
    scene: str | Path | GaussianScene,
    environments: str | Path | EnvironmentMap | Mapping[str, EnvironmentMap],
    height: int = 640,
    **settings: Any,
) -> Shown:
    """Watch and change a scene in a notebook's cell.

    Args:
        scene: PLY; or surfels, valid.
        environments: folder of environment maps, or one of them; or maps, by name.
        height: of the frame in the page, pixels.
        settings: of tron-view by name, such as ``models`` or ``port``; without a port, the
            first free one. What is no file yet is kept in a folder ``shown-...`` in ``output_dir``, where the
            command lines that film it find it.

    Raises:
        TronError: viser is not installed, a setting is wrong, or as :func:`opened`.
    """
    require_extra("the viewer", "view")
    where = {"scene": Path("scene.ply"), "environments": Path()}
    try:
        chosen = Settings.model_validate(where | settings)
    except ValidationError as error:
        first = error.errors()[0]
        raise TronError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}", "show") from error
    chosen = chosen.model_copy(update=_kept(scene, environments, chosen.output_dir))
    if "port" not in settings:  # a cell that is run twice leaves its first window open
        from tron.view.window import free_port

        chosen = chosen.model_copy(update={"port": free_port(chosen.host, chosen.port)})
    return Shown(opened(chosen), height)


def _kept(
    scene: str | Path | GaussianScene,
    environments: str | Path | EnvironmentMap | Mapping[str, EnvironmentMap],
    folder: Path,
) -> dict[str, Path]:
    """Files of a scene and of its lights, written where they are none."""
    from tron.shading.environments.environment import EnvironmentMap

    if isinstance(environments, EnvironmentMap):
        environments = {"light": environments}
    of_files = not isinstance(scene, GaussianScene), isinstance(environments, str | Path)
    if not all(of_files):
        try:
            folder.mkdir(parents=True, exist_ok=True)
            folder = Path(mkdtemp(prefix="shown-", dir=folder))
        except OSError as error:
            raise TronError(f"cannot be written: {error.strerror or error}", folder) from error
    if isinstance(scene, GaussianScene):
        scene.save(folder / "scene.ply")
        scene = folder / "scene.ply"
    if isinstance(environments, Mapping):
        for name, light in environments.items():
            if Path(name).name != name:
                raise TronError("the name of a light is that of its file", name, "leave out / and ..")
            light.save(folder / f"{name}.exr")
        environments = folder
    return {"scene": Path(scene), "environments": Path(environments)}


class Shown:
    """A window in a notebook; it shows itself, and serves until :meth:`close` or the end of the notebook."""

    def __init__(self, window: Window, height: int) -> None:
        self.window, self._height = window, height

    def close(self) -> None:
        """End it."""
        self.window.close()

    def _repr_html_(self) -> str:
        return f'<iframe src="{self.window.address}" width="100%" height="{self._height}"></iframe>'


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
    ended="what was saved is kept",
)

if __name__ == "__main__":
    cli()
