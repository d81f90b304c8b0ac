"""Views of a scene that edits are made in: what a pixel shows, and masks lifted to surfels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from tron.cameras import Camera
from tron.errors import TronError
from tron.gaussians.scene import GaussianScene
from tron.io.images import read_image

if TYPE_CHECKING:
    from tron.relighting import Relighter
    from tron.tracing import SurfelTracer

PICKED = 0.95
"""Share of what a picked pixel shows that the picked surfels make up: all of them are thousands, at times."""
THICKNESS = 2.0
"""Spacings, or deviations of its own, from the median of what a pixel's ray meets: farther none is picked."""
DEPTH_TOLERANCE = 3.0
"""Spacings behind the surface that a view sees, up to which it sees a surfel."""


@dataclass(frozen=True)
class Views:
    """Cameras that edits may name, by name or by place.

    Attributes:
        cameras: in the scene's frame.
        names: of the cameras, as many; or none.
    """

    cameras: Sequence[Camera] = ()
    names: Sequence[str] = ()
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
        surfels, _ = self.shown(scene, camera, x, y)
        if not len(surfels):
            raise TronError(f"pixel {list(pixel)} of view {view} shows nothing", mend="pick another")
        return surfels

    def shown(self, scene: GaussianScene, camera: Camera, x: int, y: int) -> tuple[np.ndarray, np.ndarray]:
        """Surfels that a pixel of a picture shows, and the point of them that it shows; none if empty.

        Args:
            scene: the surfels; where normals have no sign, they are turned to the camera.
            camera: of the picture. x, y: the pixel, from the upper left corner.

        Returns:
            Numbers of the surfels that weigh most in the pixel, of those that its ray meets near the median
            (:data:`THICKNESS`), and the median point, (3,) in world units.
        """
        import drjit as dr
        import mitsuba as mi

        from tron.tracing.surface import depth_along

        # Projections are those of the whole picture in a stripe along its longer side.
        wide = camera.width >= camera.height
        stripe = camera.window(0, y, camera.width, 1) if wide else camera.window(x, 0, 1, camera.height)
        tracer, place = self._tracer(scene, camera), mi.UInt32(x if wide else y)
        values = dr.zeros(mi.Float, len(scene))
        dr.enable_grad(values)
        seen = tracer.gbuffer(stripe, [values]).rows()
        distance = float(seen.depth[place[0]])
        if not distance:
            return np.empty(0, int), np.zeros(3)
        # A composited quantity's derivatives by the surfels' own are their weights in the picture.
        dr.backward(dr.gather(mi.Float, seen.values[0] * dr.detach(seen.opacity), place))
        weights = np.array(dr.grad(values))
        weighty = np.flatnonzero(weights)
        start, along = camera.position.tolist(), [float(each[place[0]]) for each in seen.direction]
        distances = depth_along(tracer.records, mi.UInt32(weighty), mi.Point3f(start), mi.Vector3f(along))
        size = np.maximum(np.exp(scene.log_scales[weighty].max(1)), scene.spacing)
        shown = weighty[np.abs(np.array(distances) - distance) <= THICKNESS * size]
        shown = shown[np.argsort(-weights[shown], kind="stable")]
        before = np.cumsum(weights[shown]) - weights[shown]
        shown = np.sort(shown[before < PICKED * weights[shown].sum()])
        return shown, camera.position + distance * np.array(along)

    def below(self, scene: GaussianScene, point: np.ndarray) -> float | None:
        """Distance from a point straight down to the surface, world units; None where there is none.

        A ray's, among disks in space as light meets them: no picture is asked.
        """
        import mitsuba as mi

        level = np.eye(3)[np.abs(scene.up).argmin()]
        downward = Camera.look_at(point, point - scene.up, up=level, fov_deg=1, width=1, height=1)
        at, along = ([float(value) for value in vector] for vector in (point, -scene.up))
        seen = self._tracer(scene, downward).trace(mi.Point3f(at), mi.Vector3f(along))
        return float(seen.depth[0]) or None

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

    def _tracer(self, scene: GaussianScene, camera: Camera) -> SurfelTracer:
        """A tracer whose rays meet what the camera sees: the scene itself, and no back face."""
        from tron.relighting import Estimation, Relighter

        if not self._kept or self._kept[0].scene is not scene:
            self._kept[:] = [Relighter(scene, Estimation(two_sided=False), proxy="never")]
        return cast("SurfelTracer", self._kept[0].tracer(camera))  # of no proxy and no mesh
