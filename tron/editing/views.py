"""Views of a scene that edits are made in: what a pixel shows, and masks lifted to surfels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tron.cameras import Camera
from tron.errors import TronError
from tron.gaussians.scene import GaussianScene
from tron.io.images import read_image
from tron.seeds import integer

if TYPE_CHECKING:
    from tron.relighting import Relighter
    from tron.relighting.beside import BesideMeshes
    from tron.relighting.proxy import ProxiedTracer
    from tron.tracing import SurfelTracer

PICK_RAYS = 32
"""Rays of a pick: each meets a surfel by its weight in the picture."""
THICKNESS = 2.0
"""Spacings around the middle of what they meet, within which surfels are picked."""
DEPTH_TOLERANCE = 3.0
"""Spacings behind the surface that a view sees, up to which it sees a surfel."""


@dataclass(frozen=True)
class Views:
    """Cameras that edits may name, by name or by place.

    Attributes:
        cameras: in the scene's frame.
        names: of the cameras, as many; or none.
        seed: root of the random numbers of rays.
    """

    cameras: Sequence[Camera] = ()
    names: Sequence[str] = ()
    seed: int = 0
    _kept: list[Relighter] = field(default_factory=list, init=False, repr=False, compare=False)

    def __getitem__(self, name: str | int) -> Camera:
        """The camera of a name, or at a place; TronError where there is none."""
        if not self.cameras:
            raise TronError(f"view {name} is of no camera", mend="give the cameras too: cameras=cameras.json")
        if name in self.names:
            return self.cameras[list(self.names).index(str(name))]
        try:
            place = int(name)
        except ValueError:
            place = -1
        if not 0 <= place < len(self.cameras):
            known = f"views are 0..{len(self.cameras) - 1}"
            shown = ", ".join(self.names[:5]) + (", ..." if len(self.names) > 5 else "")
            raise TronError(f"there is no view {name}", mend=f"{known}{f', or {shown}' if shown else ''}")
        return self.cameras[place]

    def picked(self, scene: GaussianScene, view: str | int, pixel: Sequence[float]) -> np.ndarray:
        """Numbers of the surfels that a pixel shows.

        Args:
            scene: the surfels.
            view: name or place of a camera.
            pixel: (x, y) from the upper left corner of the image, in pixels.

        Raises:
            TronError: no such view or pixel, or it shows nothing.
        """
        camera, (x, y) = self[view], (int(np.floor(each)) for each in pixel)
        if not (0 <= x < camera.width and 0 <= y < camera.height):
            size = f"{camera.width} x {camera.height} pixels"
            raise TronError(f"pixel {list(pixel)} is outside view {view}", mend=f"it has {size}")
        surfels, _ = self.met(scene, camera.window(x, y, 1, 1))
        if not len(surfels):
            raise TronError(f"pixel {list(pixel)} of view {view} shows nothing", mend="pick another")
        return surfels

    def met(self, scene: GaussianScene, pixel: Camera) -> tuple[np.ndarray, float]:
        """Surfels that a camera of one pixel sees, and their distance; none where it is empty.

        Args:
            scene: the surfels; where normals have no sign, they are turned to the camera.
            pixel: the camera.

        Returns:
            Numbers of the surfels that rays meet within two spacings of the median, and the median distance,
            world units.
        """
        import drjit as dr
        import mitsuba as mi

        tracer = self._tracer(scene, pixel)
        from tron.tracing.hierarchy.first_hit import NOTHING, ray_seeds

        lane = dr.arange(mi.UInt32, PICK_RAYS)
        root = dr.opaque(mi.UInt32, integer(self.seed, "editing", "pick"))
        start, along = (
            [dr.full(mi.Float, float(value), PICK_RAYS) for value in vector]
            for vector in (pixel.position, pixel.rays()[0, 0])
        )
        start, along = mi.Point3f(*start), mi.Vector3f(*along)
        dr.make_opaque(start, along)
        seeds = ray_seeds(root, lane, dr.opaque(mi.UInt32, 0))
        (hit,) = tracer.first_hits(start, [along], [dr.full(mi.Bool, True, PICK_RAYS)], [seeds])
        surfels, distances = np.array(hit.surfel), np.array(hit.distance)
        found = surfels != NOTHING
        if 2 * found.sum() < PICK_RAYS:
            return np.empty(0, int), 0.0
        # One that was met: the mean of the two in the middle may lie between two layers.
        middle = float(np.quantile(distances[found], 0.5, method="lower"))
        near = found & (np.abs(distances - middle) <= THICKNESS * scene.spacing)
        return np.unique(surfels[near]).astype(int), middle

    def shares(self, scene: GaussianScene, which: np.ndarray, camera: Camera) -> np.ndarray:
        """(H, W) in [0, 1]: how much of each pixel of a camera shows the surfels (M,) bool."""
        import mitsuba as mi

        tracer = self._tracer(scene, camera)
        seen = tracer.gbuffer(camera, [mi.Float(which.astype(np.float32))]).numpy()
        return seen["opacity"] * seen["values"][..., 0]

    def lifted(self, scene: GaussianScene, masks: Mapping[str, Path]) -> np.ndarray:
        """(M,) bool: surfels for which most votes of the masked views are for their masks.

        A view votes on a surfel that faces it and whose centre projects into its image no further than three
        spacings behind the surface there; with the cosine of its slant, since outlines cut surfels that are
        seen aslant. What no masked view sees is not selected.

        Args:
            scene: the surfels.
            masks: image of each view, white (above one half) where it is selected.

        Raises:
            TronError: no such view, or a mask that cannot be read or has another shape.
        """
        votes, normals = np.zeros(len(scene)), scene.normals()
        for view, path in masks.items():
            camera, mask = self[view], read_image(path, 1, color=False)[..., 0] > 0.5
            height, width = mask.shape
            if abs(width * camera.height - height * camera.width) > max(camera.height, camera.width):
                what = f"the mask has {width} x {height} pixels, view {view} {camera.width} x {camera.height}"
                raise TronError(what, path, "give it the view's shape")
            camera = camera.resized(width, height)
            depth = self._tracer(scene, camera).gbuffer(camera).numpy()["depth"]
            pixels, before = camera.project(scene.means)
            towards = camera.position - scene.means
            distance = np.linalg.norm(towards, axis=1)
            cosine = np.einsum("mi,mi->m", normals, towards) / distance
            cosine = cosine if scene.oriented else np.abs(cosine)
            with np.errstate(invalid="ignore"):
                framed = (before > 0) & (cosine > 0) & ((pixels >= 0) & (pixels < (width, height))).all(1)
            x, y = pixels[framed].astype(int).T
            surface = depth[y, x]
            seen = (surface > 0) & (distance[framed] <= surface + DEPTH_TOLERANCE * scene.spacing)
            votes[framed] += np.where(mask[y, x], 1, -1) * seen * cosine[framed]
        return votes > 0

    def _tracer(self, scene: GaussianScene, camera: Camera) -> SurfelTracer | ProxiedTracer | BesideMeshes:
        """A tracer whose rays meet what the camera sees: the scene itself, and no back face."""
        from tron.relighting import Estimation, Relighter

        if not self._kept or self._kept[0].scene is not scene:
            self._kept[:] = [Relighter(scene, Estimation(two_sided=False), self.seed, proxy="never")]
        return self._kept[0].tracer(camera)
