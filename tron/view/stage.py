"""A scene as edits leave it, under one of some lights; brought to a wish with the least work.

What is rough is looked at while a hand is on it. What is not is that of a fresh stage which was given the
same wish alone, whatever came before it: surfels that have moved get a new hierarchy, since rays go by it,
and whether light sees a proxy is decided by the scene before all edits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import drjit as dr
import numpy as np

from tron.cameras import Camera
from tron.color import linear_to_srgb, to_display
from tron.editing import Edit, Session
from tron.errors import TronError, located
from tron.estimation import PREVIEW
from tron.framing import upright
from tron.gaussians.edit import removed
from tron.gaussians.scene import GaussianScene
from tron.relighting import Relighter
from tron.relighting.relighter import Illumination
from tron.seeds import integer
from tron.shading.environments.environment import EnvironmentMap
from tron.shading.lighting import Lighting
from tron.trajectories import turn_cameras

Buffer = Literal["lit", "irradiance", "indirect", "base color", "normal", "roughness", "metallic"]
BUFFERS: tuple[Buffer, ...] = get_args(Buffer)
EXPOSED = ("lit", "irradiance", "indirect")
"""Buffers of light: linear, shown by exposure and AgX. The others are shown as they are."""
RAYS = 16
"""Shadow rays of a pixel in each pass; with one that finds what glossy surfaces mirror."""
SUB_PIXELS = ((-0.25, -0.25), (0.25, 0.25), (0.25, -0.25), (-0.25, 0.25))
"""Place of each pass within the pixel, from its centre."""
THUMBNAIL = 80, 280
"""Height and width of a light's picture, pixels."""
METERED = 128
"""Pixels of the frame that a light's exposure is metered in."""


@dataclass(frozen=True)
class Wish:
    """What is to be seen, but for the camera; replaced whole.

    Attributes:
        light: name of a light.
        turn: of it about up, degrees, counter-clockwise seen from above.
        stops: brighter than metered.
        buffer: what is shown.
        edits: done to the scene in their order.
        hidden: objects that are not there, after all edits.
        before: whether the scene is seen as it was before them.
    """

    light: str
    turn: float = 0.0
    stops: float = 0.0
    buffer: Buffer = "lit"
    edits: tuple[Edit, ...] = ()
    hidden: frozenset[int] = frozenset()
    before: bool = False


class Stage:
    """A scene, its edits and its lights; of one thread.

    Args:
        scene: valid, in the frame of its file; cameras see it turned so that up is +z.
        lights: the lights by name, or the files that hold them, read when they are first asked for.
        home: camera that exposure is metered in.
        seed: root of all random numbers.
        watch: called between pieces of long work that may be given up; it raises then.
    """

    def __init__(
        self,
        scene: GaussianScene,
        lights: Mapping[str, EnvironmentMap | Path],
        home: Camera,
        seed: int = 0,
        watch: Callable[[], None] = lambda: None,
    ) -> None:
        self.session, self.turn = Session(scene), upright(scene.up)
        self._lights, self._seed, self._watch = lights, seed, watch
        self._home = home.resized(METERED, max(1, round(METERED * home.height / home.width)))
        self._original = scene
        self._yields = False  # whether what is under way may be given up
        self._base = Relighter(scene.upright(), PREVIEW, seed, track=self._watched)
        self._prepared: dict[str, tuple[Lighting, float]] = {}
        self._shown: tuple[GaussianScene, frozenset[int], GaussianScene] | None = None
        self._relighter, self._fresh = self._base, True
        self._light: tuple[str, float] | None = None
        self._illumination: Illumination | None = None
        self._settled = False

    def bring(self, wish: Wish, rough: bool) -> None:
        """Do what is left to do for a wish.

        Args:
            wish: what is to be seen.
            rough: as it is looked at for a moment.

        Raises:
            TronError: an edit cannot be done, nothing is left to see, or a light cannot be read.
        """
        lighting, _ = self._lighting(wish.light)
        self._yields = not rough and self._illumination is not None
        self._relight(self._scene(wish), rough)
        now, light = self._illumination, (wish.light, wish.turn % 360)
        if now is not None and self._light == light and (rough or self._settled):
            if now.relighter is self._relighter:
                return
            if self._relighter.stands_as(now.relighter.scene):
                self._illumination = self._relighter.still_under(now)
                return
        self._illumination = self._relighter.under(lighting.turned_to(wish.turn), self._seed, quick=rough)
        self._light, self._settled = light, not rough

    def linear(
        self, buffer: Buffer, camera: Camera, number: int = -1, band: int = 0, *, rough: bool = False
    ) -> np.ndarray:
        """(H, W, 3) linear radiance, or values in [0, 1], as a camera sees them.

        Args:
            buffer: what is shown.
            camera: in the frame where up is +z.
            number: of the pass; -1: the light that reached the surfels, found without a shadow ray.
            rough: whether metals mirror no surfel, which takes a ray.
            band: number of the part of the picture that the camera sees, for its random numbers.
        """
        light = self._illumination
        assert light is not None
        if number >= 0:
            dx, dy = SUB_PIXELS[number]
            camera = replace(camera, cx=camera.cx + dx, cy=camera.cy + dy)
            light = light.framed(rays=RAYS, filtered=False, reflections=1)
        elif rough:
            light = light.framed(filtered=False)
        if buffer not in EXPOSED:
            return self._surface(buffer, camera)
        return light.trace(camera, integer(self._seed, "view", number + 1, band)).image(buffer)

    def display(self, wish: Wish, image: np.ndarray) -> np.ndarray:
        """(H, W, 3) uint8 of :meth:`linear`."""
        if wish.buffer in EXPOSED:
            image = np.asarray(to_display(image, np.float32(self.exposure(wish)), look="photograph"))
        return (255 * np.clip(image, 0, 1) + 0.5).astype(np.uint8)

    def exposure(self, wish: Wish) -> float:
        """Factor on linear values before AgX: metered once a light, at home, before it turns."""
        return self._lighting(wish.light)[1] * 2.0**wish.stops

    def first_hit(self, origin: np.ndarray, direction: np.ndarray) -> tuple[int, np.ndarray] | None:
        """Object that a ray meets first, and where, in the frame of the scene's file; None if nothing.

        Args:
            origin: (3,) where up is +z.
            direction: (3,) likewise, of any length.
        """
        scene, level = self.session.scene, np.eye(3)[np.abs(direction).argmin()]
        if self._shown is not None and self._shown[0] is scene and self._shown[1]:
            which = np.isin(scene.object_id, list(self._shown[1]))
            scene = removed(scene, which) if which.any() else scene
        pixel = Camera.look_at(origin, origin + direction, up=level, fov_deg=0.1, width=1, height=1)
        (pixel,) = turn_cameras([pixel], self.turn.T)
        surfels, distance = self.session.views.met(scene, pixel)
        if not len(surfels):
            return None
        ids, counts = np.unique(scene.object_id[surfels], return_counts=True)
        return int(ids[counts.argmax()]), pixel.position + distance * pixel.forward

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
        if wish.before:
            return self._base.scene
        scene = self.session.scene
        if self._shown is None or self._shown[0] is not scene or self._shown[1] != wish.hidden:
            which = np.isin(scene.object_id, list(wish.hidden))
            if which.all():
                raise TronError("everything is hidden", mend="show an object again")
            turned = (removed(scene, which) if which.any() else scene).upright()
            if scene is self._original and not which.any():
                turned = self._base.scene
            self._shown = scene, wish.hidden, turned
        return self._shown[2]

    def _relight(self, scene: GaussianScene, rough: bool) -> None:
        """Make a relighter of the scene: of moved surfels in the hierarchy that is there, if ``rough``."""
        if scene is self._relighter.scene and (rough or self._fresh):
            return
        stays = self._relighter.stands_as(scene)
        if scene is self._base.scene:
            self._relighter, self._fresh = self._base, True
        elif stays and (rough or self._fresh) and scene is not self._relighter.scene:
            self._relighter = self._relighter.changed(scene)
        elif rough and len(scene) == len(self._relighter.scene):
            self._relighter, self._fresh = self._relighter.changed(scene, quick=True), False
        else:
            proxy = "never" if self._base.proxy is None else "always"
            self._relighter = Relighter(scene, PREVIEW, self._seed, proxy=proxy, track=self._watched)
            self._fresh, self._settled = True, False

    def _surface(self, buffer: Buffer, camera: Camera) -> np.ndarray:
        seen = self._relighter.gbuffer(camera).numpy()
        there = seen["opacity"][..., None]
        if buffer == "normal":
            return there * (0.5 + 0.5 * seen["normal"])
        if buffer == "base color":
            return there * np.asarray(linear_to_srgb(seen["base_color"]))
        return np.broadcast_to(there * seen[buffer][..., None], (*seen["opacity"].shape, 3))

    def _watched(self, work: range) -> Iterable[int]:
        for each in work:
            if self._yields:
                dr.sync_thread()  # launches are asynchronous: else all of them are under way already
                self._watch()
            yield each
