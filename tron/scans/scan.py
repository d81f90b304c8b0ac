"""An opened file of splats, ready to be lit; tron-relight, tron-bake, tron-view and tron-edit use it.

    scan = Scan.open("scan.ply")
    frame = scan.under("studio.hdr").render(camera)   # the first frame of tron-relight from there

What is cheap is done when the scan is opened: it is read, and what is up is settled. All else is done when it
is first asked for: what surrounds it is found, its materials are found, once, and kept beside it, and so is
its proxy for light. Cameras, grounds and lights are of the world that is upright, +z up; :attr:`Scan.turn`
takes the file's there.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from tron.cameras import Camera
from tron.estimation import PREVIEW, Estimation
from tron.framing import upright
from tron.gaussians.edit import subset
from tron.gaussians.kept import KeptFiles
from tron.gaussians.scene import GaussianScene
from tron.runtime import activate
from tron.scans import GroundChoice, Treatment
from tron.scans.camera_files import filmed_orbit, filmed_with
from tron.scans.materials import put_on, with_materials
from tron.scans.surroundings import Surrounded, treat_surroundings
from tron.seeds import integer
from tron.trajectories import TrajectoryName, plan_cameras

if TYPE_CHECKING:
    from tron.models.parts import Part
    from tron.reconstruction.progress import Track
    from tron.relighting import EnvironmentMap, Illumination, Relighter
    from tron.relighting.ground import Footing, Ground, GroundOf

log = logging.getLogger(__name__)

LIGHT = "environment.exr"
"""File name of the light of a capture: tron-reconstruct writes it beside the scene, in the scene's frame."""
APART = Path("outputs")
"""Folder for files derived from a scan whose own folder is read-only."""
Materials = Literal["auto", "kept", "as_is"]


class Scan:
    """An opened file of splats; made by :meth:`open`.

    Attributes:
        file: the file of splats.
        loaded: all splats, in the file's frame. Up is known; materials may be guessed.
        seed: root of all random numbers.
    """

    def __init__(
        self, file: Path, loaded: GaussianScene, seed: int, treatment: Treatment, materials: Materials,
        apart: Path, track: Track, key: str, standing: bool,
    ) -> None:  # fmt: skip
        self.file, self.loaded, self.seed, self._track = file, loaded, seed, track
        self._treatment: Treatment = treatment
        self._materials, self._key, self._standing = materials, key, standing
        self.kept = KeptFiles(file, apart)  # where what is made of it once lies

    @classmethod
    def open(
        cls,
        file: str | Path,
        *,
        up: Sequence[float] | None = None,
        projection: Literal["auto", "disks"] = "auto",
        surroundings: Treatment = "drop",
        materials: Materials = "auto",
        seed: int = 0,
        apart: str | Path = APART,
        track: Track = lambda items, _: items,
        key: str = "surroundings",
        standing: bool = True,
    ) -> Scan:
        """Read a scan, with a line in the log where its materials or which way is up are guessed.

        What is up is settled by that: files that are made of the scan say so, and nobody is warned again.

        Args:
            file: a PLY of TRON, 3DGS or 2DGS, or another file of splats.
            up: direction of any length, in the file's frame; None: the file's own.
            projection: of its splats: the file's (auto), or disks in space.
            surroundings: what is done with a sky around it.
            materials: those that are guessed are looked for (auto), are those found before, where they are
                kept (kept), or stay (as_is).
            seed: root of all random numbers.
            apart: folder of what is made of it once, where its own cannot be written.
            track: wraps long loops, ``track(items, label)``.
            key: the setting that a line about surroundings names; empty: no line.
            standing: whether it is turned upright; else the upright world is the file's own frame.

        Raises:
            TronError: the file holds no splats or is damaged.
        """
        file = Path(file)
        scene = GaussianScene.load(file)
        if projection != "auto":
            scene.projection = projection
        if scene.materials_guessed and materials == "as_is":
            log.warning(
                "%s has no materials%s: they are guessed from its colours, which keep the light that it was "
                "captured in", file, "" if scene.oriented else " and normals without a sign",
            )  # fmt: skip
        if up is not None:
            scene.up = np.array(up) / np.linalg.norm(up)
        elif scene.up_guessed:
            log.warning(
                "%s does not say which way is up: -y is taken, as in most 3DGS files; if the picture lies on "
                "its side, give up=[0,0,1] or another direction", file,
            )  # fmt: skip
        scene.up_guessed = False
        return cls(file, scene, seed, surroundings, materials, Path(apart), track, key, standing)

    @property
    def offset(self) -> np.ndarray:
        """(3,) offset: coordinates of the file = local coordinates + offset."""
        return self.loaded.offset

    @cached_property
    def turn(self) -> np.ndarray:
        """(3, 3) rotation from the file's frame to the upright world, where +z is up as in environments."""
        return upright(self.loaded.up) if self._standing else np.eye(3)

    @cached_property
    def _surrounded(self) -> Surrounded:
        _set_variant()
        scene = self.loaded.upright() if self._standing else self.loaded
        return treat_surroundings(scene, self._treatment, self.file, self._key)

    @property
    def content(self) -> GaussianScene:
        """The surfels that cameras frame and that light meets, upright; their materials may be guessed."""
        return self._surrounded.content

    @property
    def shown(self) -> GaussianScene:
        """The surfels that cameras see, upright, with the materials of the file, guessed or not."""
        return self._surrounded.shown

    @property
    def backdrop(self) -> np.ndarray | None:
        """(M,) bool, surfels of :attr:`scene` that block no light; None if all surfels do."""
        return self._surrounded.backdrop

    @cached_property
    def filmed(self) -> list[Camera] | None:
        """Cameras of the scan's photos, upright; None if they are not known."""
        return filmed_with(self.file, self.turn, self.offset, self.content)

    def film(
        self, path: TrajectoryName, frames: int, width: int, height: int, fov_deg: float,
        distance: float = 1.0,
    ) -> list[Camera]:  # fmt: skip
        """Cameras of a path around the scan, upright; orbit and still lie between :attr:`filmed`, if known.

        Args: as of :func:`tron.trajectories.plan_cameras`.
        """
        view = {"width": width, "height": height, "fov_deg": fov_deg, "distance": distance}
        if self.filmed is None or path not in ("orbit", "still"):
            return plan_cameras(self.content, path, frames, **view)
        still = path == "still"
        cameras = filmed_orbit(self.filmed, 1 if still else frames, up=self.content.up, **view)
        return cameras * frames if still else cameras

    @property
    def _finds_materials(self) -> bool:
        return self.loaded.materials_guessed and self._materials != "as_is"

    @cached_property
    def scene(self) -> GaussianScene:
        """The surfels that cameras see, upright, with materials: found once, in minutes, and kept in a file.

        If they cannot be found, they stay guessed, and a line says why.
        """
        if not self._finds_materials:
            return self.shown
        whose = self.shown, self.kept, self.filmed, self.seed
        find = self._materials == "auto"
        return with_materials(*whose, self.backdrop, self.turn, self._track, find)

    @cached_property
    def in_file(self) -> GaussianScene:
        """All splats in the file's frame, with the materials of :attr:`scene`, to be edited.

        Surroundings have no found materials and stay as they are.
        """
        if not self._finds_materials or self.scene.materials_guessed:
            return self.loaded
        around = self._surrounded.around
        found = self.scene if self.backdrop is None else subset(self.scene, ~self.backdrop)
        return put_on(self.loaded, found, around)

    def over(self, environment: EnvironmentMap, file: Path) -> EnvironmentMap:
        """Turn the map of the scan's own capture upright with the scan; return any other map as it is.

        Any other map has +z up and stays.
        """
        if not is_of_capture(file, self.file) or np.allclose(self.turn, np.eye(3), atol=1e-6):
            return environment
        log.info("%s is of the scene's world and is turned upright with it", file)
        return environment.turned(self.turn)

    def ground(self, cameras: Sequence[Camera], choice: GroundChoice = "auto") -> Ground | None:
        """Return the ground plane for the first camera of a film, upright; None: the scan has none.

        Args:
            cameras: of the film.
            choice: where all cameras see a thing without a floor of its own from without (auto), nothing
                (none), or at a height along up, in the file's units.
        """
        if choice == "none" or (choice == "auto" and not self._footing.free(cameras)):
            return None
        away = float(self.turn[2] @ self.offset)
        return self._footing.ground(cameras[0], None if isinstance(choice, str) else choice - away)

    def ground_of(self, choice: GroundChoice = "auto") -> Callable[[Camera], Ground | None]:
        """Return a function that gives :meth:`ground` for a single camera."""
        return lambda camera: self.ground([camera], choice)

    @cached_property
    def _footing(self) -> Footing:
        from tron.relighting.ground import Footing

        return Footing.of(self.content)

    def relighter(
        self,
        estimation: Estimation = PREVIEW,
        *,
        ground: GroundOf | Literal["auto"] = "auto",
        proxy: Literal["auto", "always", "never"] = "auto",
        meshes: Sequence[Sequence[Part]] = (),
    ) -> Relighter:
        """Return a Relighter of the scan, with its ground and its proxy; the proxy is kept beside the file.

        Args:
            estimation: of the light; the default is tron-relight's.
            ground: for all frames (:meth:`ground`); auto: a separate one for each frame.
            proxy, meshes: as of :class:`tron.relighting.Relighter`.
        """
        from tron.relighting import Relighter

        if proxy == "never":
            log.info("proxy=never: light sees the scan itself")
        relighter = Relighter(
            self.scene, estimation, self.root, backdrop=self.backdrop, proxy=proxy, cameras=self.filmed,
            proxy_file=None if proxy == "never" else self.proxy_file, meshes=meshes,
            ground=self.ground_of() if ground == "auto" else ground,
            track=lambda rays: self._track(rays, "where light bounces"),
            filming=lambda views: self._track(views, "filming a proxy for light"),
        )  # fmt: skip
        relighter.frame_seed = self.frame_seed(0)
        return relighter

    def about(self, ground: GroundChoice = "auto") -> dict[str, Any]:
        """Return arguments for a Relighter of :attr:`in_file`, turned upright, also after edits.

        Surroundings, if there are any, block light there: so the proxy is not the one kept in a file.
        """
        whole = self._surrounded.around is None
        return {
            "ground": self.ground_of(ground),
            "cameras": self.filmed,
            "proxy_file": self.proxy_file if whole else None,
        }

    @property
    def proxy_file(self) -> Path:
        """Path of the proxy for light, which may not exist yet."""
        from tron.relighting.proxy import fingerprint

        content = self.scene if self.backdrop is None else subset(self.scene, ~self.backdrop)
        return self.kept.path("proxy", fingerprint(content, self.filmed))

    @property
    def root(self) -> int:
        """Root of the random numbers for bounced light."""
        return integer(self.seed, "relight", "bounces")

    def frame_seed(self, index: int) -> int:
        """Return the root of the random numbers for a frame of a film."""
        return integer(self.seed, "relight", index)

    def under(
        self, light: str | Path | EnvironmentMap, estimation: Estimation = PREVIEW, *, rotation: float = 0.0
    ) -> Illumination:
        """Light the scan; the result renders from any camera, upright.

        Args:
            light: an environment, +z up, or its file; the light of the scan's capture is turned upright.
            estimation: of the light.
            rotation: of the environment about up, degrees, counter-clockwise seen from above.

        Raises:
            TronError: the file holds no light.
        """
        _set_variant()
        from tron.relighting import EnvironmentMap
        from tron.shading.lighting import Lighting

        if not isinstance(light, EnvironmentMap):
            light = self.over(EnvironmentMap.load(Path(light)), Path(light))
        return self.relighter(estimation).under(Lighting(light).turned_to(rotation))


def is_of_capture(light: Path, scene: Path) -> bool:
    """Return whether a light is the ``environment.exr`` beside the scene's file."""
    return light.resolve() == scene.with_name(LIGHT).resolve()


def _set_variant() -> None:
    import mitsuba as mi

    if mi.variant() is None:
        activate()
