"""An edited scene under a chosen light, updated to a wish with the least work.

Rough pictures are for dragging. All others equal those of a fresh stage with the same wish, independent of
earlier wishes: moved surfels get a new hierarchy, because traversal depends on it, and the scene before all
edits decides whether light sees a proxy.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import drjit as dr
import numpy as np

from tron.cameras import Camera
from tron.color import linear_to_srgb, srgb_to_linear, to_display
from tron.editing import Clicks, Edit, Selection, Session
from tron.errors import TronError, located
from tron.estimation import FINEST, PREVIEW
from tron.framing import upright
from tron.gaussians.edit import removed
from tron.gaussians.scene import GaussianScene
from tron.relighting import Relighter
from tron.relighting.relighter import Illumination
from tron.seeds import integer
from tron.shading.environments.environment import EnvironmentMap
from tron.shading.lighting import Lighting
from tron.trajectories import turn_cameras
from tron.view.finishing import Finish

Buffer = Literal["lit", "irradiance", "indirect", "base color", "normal", "roughness", "metallic", "capture"]
BUFFERS: tuple[Buffer, ...] = get_args(Buffer)
EXPOSED = ("lit", "irradiance", "indirect")
"""Buffers of light: linear, shown by exposure and AgX. The others are shown as they are.

``capture`` is the look that the scene has in its file, its own radiance, whatever the light: display values,
which stops make brighter.
"""
Left = Literal["nothing", "before", "capture", "light"]
"""Content left of the divider: the scene before all edits, its own captured look, or another light."""
Quality = Literal["final", "preview"]
"""Quality of pictures at rest: all passes, or only the light baked at surfels."""
PASS = FINEST.of_sub_pixel()
"""Estimation of each pass; all together are ``quality=final`` of tron-relight, but that a scan's splats are
filtered by whole pixels here, and by the sub-pixels of tron-relight."""
SUB_PIXELS = ((-0.25, -0.25), (0.25, 0.25), (0.25, -0.25), (-0.25, 0.25))
"""Place of each pass within the pixel, from its centre."""
BAND_PIXELS = 24_000
"""Of a piece of a pass: 0.1 seconds on one core with 16 rays among 50,000 surfels."""
THUMBNAIL = 80, 280
"""Height and width of a light's picture, pixels."""
METERED = 128
"""Pixels of the frame that a light's exposure is metered in."""
MARK = np.array((40, 190, 255), np.float32)
"""Colour of what clicks select, and how much of it is laid over the picture."""
MARKED = 0.55


@dataclass(frozen=True)
class Wish:
    """The wished state of the view, except the camera; immutable.

    Attributes:
        light: name of a light.
        turn: of it about up, degrees, counter-clockwise seen from above.
        stops: brighter than metered.
        buffer: what is shown.
        edits: done to the scene in their order.
        hidden: objects that are not there, after all edits.
        left: of the divider, where it is something else.
        left_light: name of the light that is seen there, not turned.
        divider: where it stands, 0 to 1 of the width.
        marked: clicks whose surfels are marked, of the scene after all edits.
        quality: of pictures at rest.
    """

    light: str
    turn: float = 0.0
    stops: float = 0.0
    buffer: Buffer = "lit"
    edits: tuple[Edit, ...] = ()
    hidden: frozenset[int] = frozenset()
    left: Left = "nothing"
    left_light: str = ""
    divider: float = 0.5
    marked: Clicks | None = None
    quality: Quality = "final"


@dataclass(frozen=True)
class Part:
    """One side of the divider, or the whole picture: its content and its camera."""

    left: bool
    before: bool
    buffer: Buffer
    light: str
    camera: Camera


@dataclass(frozen=True)
class Hit:
    """What a pixel shows: an object, a point in the frame of the scene's file, and surfels by number."""

    object: int
    point: np.ndarray
    surfels: tuple[int, ...]


@dataclass(frozen=True)
class _Visible:
    """A scene without its hidden objects: (M,) bool which surfels are left, them, and them with +z up."""

    scene: GaussianScene
    hidden: frozenset[int]
    which: np.ndarray
    left: GaussianScene
    upright: GaussianScene


def bands(camera: Camera) -> list[Camera]:
    """A camera's picture in pieces from above, between which work on it can be given up."""
    rows = max(1, BAND_PIXELS // camera.width)
    return [
        camera.window(0, y, camera.width, min(rows, camera.height - y)) for y in range(0, camera.height, rows)
    ]


class Stage:
    """A scene, its edits and its lights; of one thread.

    Args:
        scene: valid, in the frame of its file; cameras see it turned so that up is +z.
        lights: the lights by name, or the files that hold them, read when they are first asked for.
        home: camera that exposure is metered in.
        seed: root of all random numbers.
        watch: called between pieces of long work that may be given up; it raises then.
        busy: called with what long work is about, and the share of it that is done.
        about: more arguments of the :class:`tron.relighting.Relighter` of the scene as it was opened, such as
            its ground, its cameras and where its proxy is kept.
    """

    def __init__(
        self,
        scene: GaussianScene,
        lights: Mapping[str, EnvironmentMap | Path],
        home: Camera,
        seed: int = 0,
        watch: Callable[[], None] = lambda: None,
        busy: Callable[[str, float], None] = lambda *_: None,
        about: Mapping[str, Any] | None = None,
    ) -> None:
        self.session, self.turn = Session(scene), upright(scene.up)
        self._lights, self._seed, self._watch, self._busy = lights, seed, watch, busy
        self._home = home.resized(METERED, max(1, round(METERED * home.height / home.width)))
        self._original = scene
        self._yields = False  # whether what is under way may be given up
        rays, film = self._watched("tracing light"), self._watched("filming the scan for light")
        self._base = Relighter(scene.upright(), PREVIEW, seed, track=rays, filming=film, **(about or {}))
        self._prepared: dict[str, tuple[Lighting, float]] = {}
        self._shown: _Visible | None = None
        self._selected: tuple[GaussianScene, Clicks, np.ndarray] | None = None
        self._relighter = self._base
        self._right: Illumination | None = None
        self._left: Illumination | None = None

    def bring(self, wish: Wish, rough: bool) -> None:
        """Update the stage to a wish.

        Args:
            wish: what is to be seen.
            rough: as it is looked at for a moment.

        Raises:
            TronError: an edit cannot be done, nothing is left to see, or a light cannot be read.
        """
        lighting, _ = self._lighting(wish.light)
        other = self._lighting(wish.left_light)[0] if wish.left == "light" else lighting
        self._yields = not rough and self._right is not None
        how: dict[str, Any] = {"quick": rough, "anew": not rough}
        scene, base = self._scene(wish), self._base
        start = base if scene is base.scene else self._relighter
        self._right = start.bring(scene, lighting, wish.turn, before=self._right, **how)
        self._relighter = here = self._right.relighter
        if wish.left == "light":
            self._left = here.bring(here.scene, other, 0.0, before=self._left, **how)
        elif wish.left == "before":
            self._left = base.bring(base.scene, lighting, wish.turn, before=self._left, **how)
        if wish.marked is not None:
            self.selected(wish.marked)

    def parts(self, wish: Wish, camera: Camera) -> list[Part]:
        """The parts of a picture, from left to right."""
        whole = Part(False, False, wish.buffer, wish.light, camera)
        column = 0 if wish.left == "nothing" else round(np.clip(wish.divider, 0, 1) * camera.width)
        if not column:
            return [whole]
        before = wish.left != "light"
        buffer = "capture" if wish.left == "capture" else wish.buffer
        light = wish.light if before else wish.left_light
        left = Part(True, before, buffer, light, camera.window(0, 0, column, camera.height))
        if column == camera.width:
            return [left]
        return [left, replace(whole, camera=camera.window(column, 0, camera.width - column, camera.height))]

    def linear(
        self, part: Part, camera: Camera, number: int = -1, band: int = 0,
        *, rough: bool = False, more: Sequence[str] = (),
    ) -> dict[str, np.ndarray]:  # fmt: skip
        """The part's buffer by its name, (H, W, 3) linear radiance, or values in [0, 1]; and more of light.

        Args:
            part: what is shown.
            camera: that of the part, or of a piece of it.
            number: of the pass; -1: the light that reached the surfels, found without a shadow ray.
            band: number of the piece, for its random numbers.
            rough: whether metals mirror no surfel, which takes a ray.
            more: other buffers of light.
        """
        light = self._left if part.left else self._right
        if number >= 0:
            dx, dy = SUB_PIXELS[number]
            camera = replace(camera, cx=camera.cx + dx, cy=camera.cy + dy)
        if part.buffer not in EXPOSED:
            return {part.buffer: self._surface(part, camera)}
        assert light is not None
        if number >= 0:
            light = light.framed(rays=PASS.rays, filtered=PASS.filtered, reflections=PASS.reflections)
        elif rough:
            light = light.framed(filtered=False)
        frame = light.trace(camera, integer(self._seed, "view", number + 1, band))
        return frame.images((part.buffer, *more))

    def finished(self, part: Part, means: Mapping[str, np.ndarray], finish: Finish) -> np.ndarray:
        """(H, W, 3) linear radiance: the mean of all passes over a part, denoised."""
        relighter = self._base if part.before else self._relighter
        maps = []
        for window in bands(part.camera):
            self._watch()
            maps.append(relighter.surface_maps(window, FINEST)[0])
            if finish.normals:
                maps[-1] = maps[-1] | {"normal": relighter.gbuffer(window).numpy()["normal"]}
        whole = {name: np.concatenate([each[name] for each in maps]) for name in maps[0]}
        exposure = self._lighting(part.light)[0].environment.exposure()
        return finish({**means, **whole}, exposure, self._watch)

    def display(self, wish: Wish, part: Part, image: np.ndarray) -> np.ndarray:
        """(H, W, 3) uint8 of :meth:`linear`; what clicks select is marked."""
        if part.buffer in EXPOSED:
            factor = self.exposure(part.light, wish.stops)
            image = np.asarray(to_display(image, np.float32(factor), look="photograph"))
        elif part.buffer == "capture" and wish.stops:  # it has an exposure, that of its photos
            image = np.asarray(linear_to_srgb(srgb_to_linear(image) * np.float32(2.0**wish.stops)))
        shown = (255 * np.clip(image, 0, 1) + 0.5).astype(np.uint8)
        if wish.marked is None or part.left:
            return shown
        which, visible = self.selected(wish.marked), self._visible(wish.hidden)
        (camera,) = turn_cameras([part.camera], self.turn.T)
        share = MARKED * self.session.views.shares(visible.left, which[visible.which], camera)[..., None]
        return ((1 - share) * shown + share * MARK + 0.5).astype(np.uint8)

    def exposure(self, light: str, stops: float) -> float:
        """Factor on linear values before AgX: metered once a light, at home, before it turns."""
        return self._lighting(light)[1] * 2.0**stops

    def selected(self, clicks: Clicks) -> np.ndarray:
        """(M,) bool: surfels of the scene after all edits; none while clicks are of one kind alone.

        Raises:
            TronError: a surfel is not there, or was clicked both inside and outside.
        """
        scene = self.session.scene
        if not (clicks.inside and clicks.outside):
            return np.zeros(len(scene), bool)
        if self._selected is None or self._selected[0] is not scene or self._selected[1] != clicks:
            self._selected = scene, clicks, Selection(clicks=clicks).of(scene, self.session.views)
        return self._selected[2]

    def shown_at(self, camera: Camera, x: int, y: int) -> Hit | None:
        """What a pixel of a camera's picture shows; None if nothing.

        Args:
            camera: where up is +z. x, y: the pixel, from the upper left corner.
        """
        visible = self._visible(frozenset() if self._shown is None else self._shown.hidden)
        scene, (camera,) = visible.left, turn_cameras([camera], self.turn.T)
        surfels, point = self.session.views.shown(scene, camera, x, y)
        if not len(surfels):
            return None
        ids, counts = np.unique(scene.object_id[surfels], return_counts=True)
        numbers = np.flatnonzero(visible.which)[surfels]
        return Hit(int(ids[counts.argmax()]), point, tuple(numbers.tolist()))

    def objects(self) -> dict[int, int]:
        """Numbers of surfels of the objects after all edits, hidden ones too."""
        ids, counts = np.unique(self.session.scene.object_id, return_counts=True)
        return dict(zip(ids.tolist(), counts.tolist()))

    def thumbnail(self, name: str) -> np.ndarray:
        """:data:`THUMBNAIL` uint8 of a light's map before it turns: the middle of its height.

        Raises:
            TronError: the light cannot be read.
        """
        environment, (height, width) = self._lighting(name)[0].environment, THUMBNAIL
        first = (width // 2 - height) // 2
        image = environment.resized(width // 2, width).image[first : first + height]
        shown = to_display(image, environment.exposure(), look="photograph")
        return (255 * np.asarray(shown) + 0.5).astype(np.uint8)

    def _lighting(self, name: str) -> tuple[Lighting, float]:
        if name not in self._prepared:
            light = self._lights[name]
            environment = light if isinstance(light, EnvironmentMap) else EnvironmentMap.load(light)
            with located(None if isinstance(light, EnvironmentMap) else light):
                environment.exposure()  # of a black map there is none
            lighting = Lighting(environment)
            self._yields = False
            frame = self._base.under(lighting, self._seed, quick=True).render(self._home, self._seed)
            self._prepared[name] = lighting, frame.exposure("photograph")
        return self._prepared[name]

    def _scene(self, wish: Wish) -> GaussianScene:
        """The scene after the wish's edits, without what is hidden, +z up."""
        done = self.session.edits.edits
        pairs = enumerate(zip(done, wish.edits))
        common = next((n for n, (a, b) in pairs if a != b), min(len(done), len(wish.edits)))
        for _ in done[common:]:
            self.session.undo()
        for edit in wish.edits[common:]:
            self.session.do(edit)
        return self._visible(wish.hidden).upright

    def without(self, hidden: frozenset[int]) -> GaussianScene:
        """The scene after all edits, without some objects, in the frame of its file."""
        scene = self.session.scene
        which = np.isin(scene.object_id, list(hidden))
        return removed(scene, which) if which.any() else scene

    def _visible(self, hidden: frozenset[int]) -> _Visible:
        scene, shown = self.session.scene, self._shown
        if shown is None or shown.scene is not scene or shown.hidden != hidden:
            which = ~np.isin(scene.object_id, list(hidden))
            if not which.any():
                raise TronError("everything is hidden", mend="show an object again")
            left = scene if which.all() else removed(scene, ~which)
            upright = self._base.scene if left is self._original else left.upright()
            self._shown = shown = _Visible(scene, hidden, which, left, upright)
        return shown

    def _surface(self, part: Part, camera: Camera) -> np.ndarray:
        buffer, relighter = part.buffer, self._base if part.before else self._relighter
        seen = relighter.gbuffer(camera).numpy()
        if buffer == "capture":
            return seen["rgb"]
        there = seen["opacity"][..., None]
        if buffer == "normal":
            return there * (0.5 + 0.5 * seen["normal"])
        if buffer == "base color":
            return there * np.asarray(linear_to_srgb(seen["base_color"]))
        return np.broadcast_to(there * seen[buffer][..., None], (*seen["opacity"].shape, 3))

    def _watched(self, about: str) -> Callable[[range], Iterable[int]]:
        def watched(work: range) -> Iterable[int]:
            for number, each in enumerate(work):
                dr.sync_thread()  # launches are asynchronous: else all of them are under way already
                self._busy(about, number / len(work))
                if self._yields:
                    self._watch()
                yield each

        return watched
