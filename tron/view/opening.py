"""Opening a window, also in notebooks: lights and models, the first light, the finish of pictures."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import Future
from pathlib import Path
from tempfile import mkdtemp
from threading import Thread
from typing import TYPE_CHECKING

import mitsuba as mi

from tron import denoising
from tron.cameras import Camera
from tron.cli.installation import missing_libraries, require_extra
from tron.errors import TronError
from tron.gaussians.scene import GaussianScene
from tron.io.lights import LIGHT_SUFFIXES
from tron.neural.network_gains import NETWORK, best_first
from tron.neural.shipped import DEFAULT, checkpoint_file, installed
from tron.relighting import Relighter
from tron.runtime import activate, set_torch_threads, torch_device
from tron.shading.environments.environment import EnvironmentMap
from tron.view.finishing import Denoised, Drawn, Finish

if TYPE_CHECKING:
    from tron.neural.protocols import Renderer
    from tron.view.window import Window

log = logging.getLogger(__name__)

TRIED = 8
"""Maps that are read to find the brightest of them: 4,096 x 2,048 texels take half a second each."""
HOST, PORT, FOLDER = "127.0.0.1", 8080, Path("outputs/view")


def home_of(scene: GaussianScene) -> Camera:
    """The first view."""
    view = {"azimuth_deg": -60.0, "elevation_deg": 20.0, "distance": 1.1}
    return Camera.around(scene.upright(), **view, width=960, height=800)


def files_of(where: Path, suffixes: tuple[str, ...], kind: str) -> dict[str, Path]:
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


def first_light(lights: Mapping[str, Path], wanted: str | None, own: Collection[str], where: Path) -> str:
    """The name of the map to begin with; the others are read, or refused, when they are chosen.

    Args:
        lights: files by name.
        wanted: the name that was given; None: the first of ``own``, else the brightest of the first few.
        own: names of the maps that are the scene's own light.
        where: what was given as the maps, for the error.

    Raises:
        TronError: it cannot be read, or there is none of that name.
    """
    tried = list(lights)[:TRIED] if wanted is None and not own else [wanted or next(iter(own))]
    if tried[0] not in lights:
        raise TronError(f"light: no map is called {tried[0]}", where, f"give one of {', '.join(lights)}")
    bright: dict[str, float] = {}
    for name in tried:
        try:
            bright[name] = 1 / EnvironmentMap.load(lights[name]).exposure()
        except TronError as error:
            if len(tried) == 1 or (name == tried[-1] and not bright):
                raise
            log.warning("%s", error)
    return max(bright, key=bright.__getitem__)


def finish_of(threads: int | None) -> Callable[[int, int], Finish | None]:
    """The finish for pictures at rest of a width and height.

    As checkpoint=auto of tron-relight has it, by the network or a denoiser, whichever surely gains more.
    Where none does a denoiser, if installed, still takes the passes' noise out.
    """
    drawn = None
    if not missing_libraries("network") and DEFAULT in installed():
        loaded: Future[Renderer] = Future()
        Thread(target=_load, args=(loaded, threads), daemon=True).start()
        drawn = Drawn(loaded)
    denoisers = {name: Denoised(name) for name in denoising.installed()}

    def finish(width: int, height: int) -> Finish | None:
        gains = best_first([*([NETWORK] if drawn else []), *denoisers], "final", width, height)
        if next(iter(gains), None) == NETWORK and gains[NETWORK] > 0:
            return drawn
        return next((denoisers[way] for way in (*gains, *denoisers) if way in denoisers), None)

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
    relighter: Relighter,
    lights: str | Path | EnvironmentMap | Mapping[str, EnvironmentMap],
    height: int = 640,
    *,
    light: str | None = None,
    models: str | Path | None = None,
    output_dir: str | Path = FOLDER,
    host: str = HOST,
    port: int | None = None,
    threads: int | None = None,
) -> Shown:
    """Watch and change a relighter's scene in a notebook's cell: the window of tron-view, which shows itself.

    It is a copy: what is changed there stays there, until it is saved. It estimates light as tron-view
    does, and decides by itself whether light sees a proxy.

    Args:
        relighter: whose scene and seed are taken.
        lights: to choose from: maps by name, one map, or a folder of files.
        height: of the cell's frame, pixels.
        light: the map to begin with, by its name; None: the brightest of the first few.
        models: folder of PLYs that may be inserted.
        output_dir: folder that is saved in. What is no file yet is kept in a folder ``shown-...`` in it, for
            the command lines that film it.
        host: address to listen on.
        port: to listen on; None: the first free one.
        threads: of the renderer; None: all.

    Raises:
        TronError: viser is not installed, the port is taken, there is no map, or there are meshes, which the
            window cannot show.
    """
    if relighter.meshes is not None:
        raise TronError("the viewer shows no meshes", mend="insert them as surfels (tron.editing.Insert)")
    require_extra("the viewer", "view")
    from tron.view.window import Window, free_port

    variant = mi.variant() or ""  # the relighter has set one
    activate(variant, threads)
    scene, folder = relighter.scene, Path(output_dir)
    port = free_port(host, PORT) if port is None else port  # a cell run twice leaves its first window open
    file, where = _kept(scene, lights, folder)
    maps = files_of(where, LIGHT_SUFFIXES, "environment map")
    inserted = {} if models is None else files_of(Path(models), (".ply",), "PLY")
    return Shown(
        Window(
            scene, file, maps, inserted, folder, host, port, home_of(scene),
            light=first_light(maps, light, (), where), seed=relighter.seed, variant=variant,
            threads=threads, finish=finish_of(threads), about={"ground": relighter.ground},
        ),
        height,
    )  # fmt: skip


def _kept(
    scene: GaussianScene, lights: str | Path | EnvironmentMap | Mapping[str, EnvironmentMap], folder: Path
) -> tuple[Path, Path]:
    """Files of a scene and of its lights, written into a new folder in ``folder``."""
    if isinstance(lights, EnvironmentMap):
        lights = {"light": lights}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        folder = Path(mkdtemp(prefix="shown-", dir=folder))
    except OSError as error:
        raise TronError(f"cannot be written: {error.strerror or error}", folder) from error
    scene.save(folder / "scene.ply")
    if not isinstance(lights, Mapping):
        return folder / "scene.ply", Path(lights)
    for name, light in lights.items():
        if Path(name).name != name:
            raise TronError("the name of a light is that of its file", name, "leave out / and ..")
        light.save(folder / f"{name}.exr")
    return folder / "scene.ply", folder


class Shown:
    """A window in a notebook; it shows itself, and serves until :meth:`close` or the end of the notebook."""

    def __init__(self, window: Window, height: int) -> None:
        self.window, self._height = window, height

    def close(self) -> None:
        """End it."""
        self.window.close()

    def _repr_html_(self) -> str:
        return f'<iframe src="{self.window.address}" width="100%" height="{self._height}"></iframe>'
