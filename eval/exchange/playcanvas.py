"""PlayCanvas' engine in headless Chromium: pictures of a PLY by a widely used splat viewer.

It draws on the processor (SwiftShader). Its splats are thinner than 3DGS's. It adds 0.3 to covariances that
it takes in half pixels, ``NARROW`` square pixels, and cuts the kernel at sqrt(8) deviations, shifted so that
it ends at zero: ``(exp(-q / 2) - exp(-4)) / (1 - exp(-4))``. Against its pictures of two scans (four views of
384 pixels) a rasteriser of 3DGS has 19 to 27 dB, with ``NARROW`` 33 to 41, with its kernel too 34 to 46.
"""

from __future__ import annotations

import importlib.util
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Thread
from typing import Any
from urllib.parse import urlencode

import numpy as np
from PIL import Image

from tron.cameras import Camera
from tron.errors import TronError

VERSION = "2.23.3"
INSTALL = f"npm install playcanvas@{VERSION}, and give benchmark.playcanvas=FOLDER/node_modules/playcanvas"
NARROW = 0.3 / 4
_PATIENCE = 180_000
"""Milliseconds that a picture has."""
_FRAMES = 30
"""Frames after which splats are sorted; sorting runs beside the first."""
_FLAGS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
_PAGE = """<!doctype html><body style="margin:0"><canvas id="c"></canvas><script type="module">
import * as pc from "./engine.mjs";
const given = new URLSearchParams(location.search), numbers = name => given.get(name).split(",").map(Number);
const canvas = document.getElementById("c"), side = Number(given.get("side"));
const device = await pc.createGraphicsDevice(canvas, {deviceTypes: ["webgl2"], antialias: false});
device.maxPixelRatio = 1;
const options = new pc.AppOptions();
options.graphicsDevice = device;
options.componentSystems = [pc.CameraComponentSystem, pc.GSplatComponentSystem];
options.resourceHandlers = [pc.GSplatHandler];
const app = new pc.AppBase(canvas);
app.init(options);
app.setCanvasFillMode(pc.FILLMODE_NONE);
app.setCanvasResolution(pc.RESOLUTION_FIXED, side, side);
canvas.style.width = canvas.style.height = side + "px";
const asset = new pc.Asset("scan", "gsplat", {url: "scan.ply"});
app.assets.add(asset);
asset.on("error", error => { window.failed = String(error); });
asset.on("load", () => {
  const splats = new pc.Entity(), camera = new pc.Entity();
  splats.addComponent("gsplat", {asset});
  app.root.addChild(splats);
  camera.addComponent("camera", {clearColor: new pc.Color(0, 0, 0, 1), fov: Number(given.get("fov")),
    nearClip: 0.05, farClip: 1000, toneMapping: pc.TONEMAP_LINEAR, gammaCorrection: pc.GAMMA_SRGB});
  camera.setPosition(...numbers("at"));
  camera.lookAt(new pc.Vec3(...numbers("to")), new pc.Vec3(...numbers("up")));
  app.root.addChild(camera);
  let frames = 0;
  app.on("frameend", () => { frames += 1; window.done = frames > FRAMES; });
});
app.assets.load(asset);
app.start();
</script>"""


def lacking(engine: Path | None) -> str | None:
    """Return why the engine cannot draw here; None if it can."""
    if engine is None or not (engine / "build" / "playcanvas.mjs").is_file():
        return f"PlayCanvas' engine is not there: {INSTALL}"
    if importlib.util.find_spec("playwright") is None:
        return "playwright is not installed: pip install playwright"
    return None if shutil.which("chromium") else "Chromium is not there: apt-get install chromium"


def shown(engine: Path, scan: Path, cameras: Sequence[Camera]) -> Iterator[np.ndarray]:
    """Render display values (H, W, 3) over black for cameras with square images about their axes.

    Args:
        engine: the npm package, of which ``build/playcanvas.mjs`` is served.
        scan: a PLY of 3DGS.
        cameras: the views.

    Raises:
        TronError: the engine refuses the file, or shows nothing in time.
    """
    from playwright.sync_api import Error, sync_playwright

    with TemporaryDirectory(prefix="tron-") as name, sync_playwright() as playwright:
        folder = Path(name)
        (folder / "page.html").write_text(_PAGE.replace("FRAMES", str(_FRAMES)))
        (folder / "engine.mjs").symlink_to((engine / "build" / "playcanvas.mjs").absolute())
        (folder / "scan.ply").symlink_to(scan.absolute())
        with _served(folder) as address:
            browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=list(_FLAGS))
            try:
                for camera in cameras:
                    page = browser.new_page(viewport={"width": camera.width, "height": camera.height})
                    page.goto(f"{address}/page.html?{_query(camera)}")
                    page.wait_for_function("window.done || window.failed", timeout=_PATIENCE)
                    failed = page.evaluate("window.failed")
                    if failed:
                        raise TronError(f"PlayCanvas' engine cannot show it: {failed}", scan)
                    picture = Image.open(BytesIO(page.screenshot())).convert("RGB")
                    page.close()
                    yield np.asarray(picture, np.float64) / 255
            except Error as error:
                raise TronError(f"PlayCanvas' engine shows nothing: {error}", scan) from error
            finally:
                browser.close()


def _query(camera: Camera) -> str:
    def three(vector: np.ndarray) -> str:
        return ",".join(map(repr, np.asarray(vector, float).tolist()))

    ahead, places = camera.position + camera.forward, {"side": camera.width, "fov": camera.fov_deg}
    return urlencode(places | {"at": three(camera.position), "to": three(ahead), "up": three(camera.up)})


class _Quiet(SimpleHTTPRequestHandler):
    extensions_map = SimpleHTTPRequestHandler.extensions_map | {".mjs": "text/javascript"}

    def log_message(self, *_: Any) -> None:
        pass


@contextmanager
def _served(folder: Path) -> Iterator[str]:
    """Serve a folder on an address that only this machine reaches."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(folder)))
    thread = Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
