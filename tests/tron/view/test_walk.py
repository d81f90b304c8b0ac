"""A new user's walk through the window of a scan, in a real browser: what the panel says is what is so."""

import shlex
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from examples.stage import BALL
from tron.apps.relight.settings import Settings as Relight
from tron.cameras import Camera
from tron.cli.recipes import check, compose_recipe
from tron.editing import EditList, Move, Selection
from tron.gaussians.fields import FIELDS
from tron.gaussians.scene import GaussianScene
from tron.io.images import read_image
from tron.relighting import relighter
from tron.seeds import generator
from tron.shading.bounces.bounce import BounceTransport
from tron.view.window import Window

pytestmark = pytest.mark.long

PATIENCE = 240
LAYERS = 3


@pytest.fixture
def scan(scene) -> GaussianScene:
    """The scene as 3DGS has it: splats over some spacings, whose normals have no sign."""
    rng, count = generator(0, "tests", "walk"), LAYERS * len(scene)
    every = np.tile(np.arange(len(scene)), LAYERS)
    values = {name: getattr(scene, name)[every] for name in FIELDS}
    deep = np.repeat(np.linspace(0.0, -2 * scene.spacing, LAYERS), len(scene))
    deep += rng.normal(0, 0.5 * scene.spacing, count)
    values["means"] = values["means"] + deep[:, None] * scene.normals()[every]
    return replace(scene, **values, oriented=False)


@pytest.fixture
def made(monkeypatch) -> Counter[str]:
    """How often a proxy was made, and rays of light were traced among its surfels."""
    counts: Counter[str] = Counter()

    def counted(owner: Any, name: str) -> None:
        before = getattr(owner, name)

        def called(*args: Any, **more: Any) -> Any:
            counts[name] += 1
            return before(*args, **more)

        monkeypatch.setattr(owner, name, called)

    monkeypatch.setattr("tron.relighting.proxy.VIEWS", 12)
    counted(relighter, "make_proxy")
    for name in ("trace", "direct_of_faces", "reaching"):  # trace is a classmethod: bound already
        counted(BounceTransport, name)
    return counts


@pytest.fixture
def window(scan, lights, variant, tmp_path, free_port, made):
    files = {name: tmp_path / f"{name}.exr" for name in lights}
    for name, light in lights.items():
        light.save(files[name])
    scan.save(tmp_path / "scan.ply")
    home = Camera.around(scan.upright(), azimuth_deg=30, width=96, height=80)
    opened = Window(
        scan, tmp_path / "scan.ply", files, {}, tmp_path / "saved", "127.0.0.1", free_port(), home,
        light="west", variant=variant, threads=1,
    )  # fmt: skip
    yield opened
    opened.close()


class Panel:
    """What a page's panel says."""

    def __init__(self, window: Window, page: Any) -> None:
        self.window, self.page = window, page
        panel = window.objects
        self.handles = {"roughness": panel._roughness, "metallic": panel._metallic, "turn": window._turn}

    def value(self, name: str) -> float:
        slider = f"document.getElementById('{self.handles[name]._impl.uuid}').parentElement"
        return float(self.page.evaluate(f"{slider}.querySelector('input:not([type=hidden])').value"))

    def has(self, name: str) -> bool:
        return self.page.locator(f"id={self.handles[name]._impl.uuid}").count() > 0

    def state(self) -> str:
        """The line under the bar."""
        (words,) = [
            said for said in self.page.locator("p").all_inner_texts()
            if said.split(" · ")[0] in ("done", "moving", "refining", "working", "reading the scene")
            or said.startswith(("filming", "tracing", "working"))
        ]  # fmt: skip
        return words

    def settled(self) -> str:
        """The line once nothing is left to do; never before the picture is of the wish of the moment."""
        ends = time.monotonic() + PATIENCE
        while time.monotonic() < ends:
            wish, state = self.window.studio.wished, self.state()
            pictures = [p for p in self.window._last.values() if p.refined == 1 and p.wish == wish]
            if state.startswith("done"):
                assert pictures, "it says done while the last picture is of another wish"
                return state
            time.sleep(0.2)
        raise AssertionError(f"never done: {self.state()}")

    def press(self, name: str) -> None:
        self.page.get_by_role("button", name=name, exact=True).click()

    def told(self, holds: Callable[[str], bool]) -> str:
        """What the panel says of what was saved, once that is so."""
        eventually(lambda: holds(self.page.locator("pre").inner_text()))
        return self.page.locator("pre").inner_text()


def eventually(holds: Callable[[], Any]) -> None:
    ends = time.monotonic() + PATIENCE
    while not holds():
        assert time.monotonic() < ends
        time.sleep(0.1)


def test_the_panel_says_what_is_so_from_opening_to_saving(window, browse, pull, made, tmp_path):
    page = browse(window.address, 980, 820)
    panel = Panel(window, page)
    assert page.get_by_role("combobox", name="Map").input_value() == "west"
    canvas = page.locator("canvas").first.bounding_box()
    whole = f"{canvas['width']:.0f} × {canvas['height']:.0f}"
    assert whole in panel.settled()
    assert made["make_proxy"] == 1

    # The light; then the camera, after which pictures are as large as before.
    pull(page, page.locator("[role=slider]").first.bounding_box(), 40)
    eventually(lambda: panel.value("turn") == window.studio.wished.turn > 0)
    panel.settled()
    page.mouse.move(300, 300)
    page.mouse.down()
    for step in range(40):
        page.mouse.move(300 + 3 * step, 300)
        time.sleep(0.05)
    page.mouse.up()
    time.sleep(1)
    assert whole in panel.settled()

    # Nothing is chosen: there are no controls of an object; chosen, it is marked, and they say what it is.
    assert not panel.has("roughness")
    assert not panel.has("metallic")
    assert page.get_by_role("button", name="Remove object").count() == 0
    before = page.screenshot(clip={"x": 0, "y": 0, "width": 600, "height": 800})
    label = next(name for name, number in window.objects.numbers.items() if number == BALL)
    page.get_by_role("combobox", name="Object").click()
    page.get_by_role("option", name=label, exact=True).click()
    time.sleep(2)
    assert page.screenshot(clip={"x": 0, "y": 0, "width": 600, "height": 800}) != before, "a box marks it"
    assert panel.has("roughness")
    ball = window.studio.ask(lambda stage: stage.session.scene.object_id == BALL).result()
    scene = window.studio.ask(lambda stage: stage.session.scene).result()
    started = {name: float(getattr(scene, name)[ball].mean()) for name in ("roughness", "metallic")}
    for name, value in started.items():
        assert panel.value(name) == pytest.approx(value, abs=0.006)

    # Two sliders are two edits, and make neither a proxy nor a ray of light.
    counts = Counter(made)
    sliders = page.locator("[role=slider]")
    pull(page, sliders.nth(3).bounding_box(), 30)
    eventually(lambda: len(window.studio.wished.edits) == 1)
    panel.settled()
    roughness = panel.value("roughness")
    pull(page, sliders.nth(4).bounding_box(), 50)
    eventually(lambda: len(window.studio.wished.edits) == 2)
    panel.settled()
    metallic = panel.value("metallic")
    edits = window.studio.wished.edits
    assert [(each.roughness, each.metallic) for each in edits] == [(roughness, None), (None, metallic)]
    assert made == counts

    # Undo takes one of them back, in the panel too.
    panel.press("Undo")
    eventually(lambda: panel.value("metallic") == pytest.approx(started["metallic"], abs=0.006))
    assert panel.value("roughness") == roughness
    assert window.studio.wished.edits == edits[:1]
    panel.press("Redo")
    eventually(lambda: panel.value("metallic") == metallic)
    assert window.studio.wished.edits == edits
    panel.settled()

    # Saved while an edit is worked on: it waits, says so, and is what the panel shows; the bar is not done.
    page.get_by_text("Save", exact=True).first.click()
    window.history.do(Move(select=Selection(object=BALL), by=(0.0, 0.0, 0.3)))
    began = window.studio.wished
    panel.press("Scene")
    assert "waits" in panel.told(lambda said: "scene" in said)
    assert not panel.state().startswith("done")
    second = browse(window.address, 700, 700)
    time.sleep(2)
    import cv2

    shown = cv2.imdecode(np.frombuffer(second.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    assert shown is not None
    assert shown[200:500, 50:300].max() > 60, "another window is not black meanwhile"
    saved = panel.told(lambda said: "edits-001.yaml" in said).splitlines()
    assert saved == [str(tmp_path / "saved" / name) for name in ("scene-001.ply", "edits-001.yaml")]
    written = GaussianScene.load(tmp_path / "saved" / "scene-001.ply")
    assert EditList.read(tmp_path / "saved" / "edits-001.yaml").edits == began.edits
    np.testing.assert_allclose(written.roughness[ball], roughness, atol=1e-6)
    np.testing.assert_allclose(written.metallic[ball], metallic, atol=1e-6)
    assert written.means[ball].mean(0)[2] == pytest.approx(scene.means[ball].mean(0)[2] + 0.3, abs=1e-4)
    panel.press("Film")
    line = panel.told(lambda said: said.startswith("tron-relight"))
    film = check(compose_recipe("conf.relight", Relight, shlex.split(line)[1:]), Relight)
    assert film.scene.is_absolute()
    assert film.cameras is not None
    assert film.cameras.is_file()
    box = page.locator("pre").bounding_box()
    assert box["x"] + box["width"] <= 980, "all of the line is in the panel"
    panel.settled()
    panel.press("Picture")
    panel.told(lambda said: said.endswith("picture-001.png"))
    number = min(window._last)
    np.testing.assert_allclose(
        read_image(tmp_path / "saved" / "picture-001.png"), window._last[number].image / 255, atol=1e-6
    )

    # A page that is loaded again says the same.
    page.reload()
    page.wait_for_selector("text=Exposure", timeout=60_000)
    panel.settled()
    assert panel.value("roughness") == roughness
    assert panel.value("metallic") == metallic
    assert page.complaints == second.complaints == []

    # On a phone the panel is folded, and opens.
    phone = browse(window.address, 390, 844)
    time.sleep(2)
    assert not phone.get_by_text("Exposure", exact=True).is_visible()
    phone.get_by_text("TRON", exact=True).first.click()
    phone.wait_for_selector("text=Exposure", state="visible", timeout=10_000)
    assert phone.complaints == []
