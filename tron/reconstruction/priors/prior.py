"""What a prior is: whatever tells of a capture's normals, materials and light beyond its photos.

A :class:`Prior` is a strategy with four hooks that :func:`tron.reconstruction.reconstruct` calls in order. A
:class:`MapPrior` has maps of each view: it says which it can give and reads them; stages 2 and 3 learn from
them. A field that a prior lacks stays None on the views, so that whoever needs it says so, rather than learn
from an invention.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np
from pydantic import ConfigDict

from tron.cameras import Camera
from tron.captures import Capture, View
from tron.captures.view import Pixels
from tron.errors import TronError
from tron.gaussians import GaussianScene
from tron.gaussians.fields import MATERIALS
from tron.reconstruction.light.fit_environment import fit_environment
from tron.reconstruction.materials.carried import Carried
from tron.reconstruction.progress import Track, untracked
from tron.reconstruction.settings import FitSettings
from tron.relighting.proxy import Proxy
from tron.shading.environments.environment import EnvironmentMap
from tron.tracing import SurfelTracer

FIELDS = ("normal", "base_color", "roughness", "metallic", "irradiance", "sky_mask")
"""The fields of :class:`tron.captures.View` that priors fill; spaces and frames are stated there."""

Maps = Callable[[View], Mapping[str, Pixels]]
"""The maps of one view: field -> array, or what reads the array when it is asked for."""

CONFIG = ConfigDict(extra="forbid", allow_inf_nan=False)
"""Of the pydantic dataclasses that priors are: values outside of their range are refused when one is made."""

log = logging.getLogger(__name__)
NormalFrame = Literal["camera_opengl", "camera_opencv", "world"]
"""Axes of a normal map: x right, y up, z towards the viewer (OpenGL); x right, y down, z away (OpenCV)."""
ASPECT_TOLERANCE = 0.01
"""Relative difference of aspect ratios that rounding to whole pixels, or to multiples of 8, explains."""
_UNIT_RANGE = (0.5, 1.5)  # lengths of vectors that are normals, give or take what a network gets wrong


@dataclass(frozen=True, eq=False)
class Surfels:
    """Surfels whose geometry is found, and what a prior finds their materials with.

    Attributes:
        capture: with what the prior has taught.
        scene: the surfels; their base color is their mean radiance, decoded from sRGB.
        learn: stage 2: the scene after these materials were learnt from the views' maps, with checkpoints.
        seed: root of all random numbers.
        track: wraps long loops.
    """

    capture: Capture
    scene: GaussianScene
    learn: Callable[[Collection[str]], GaussianScene]
    seed: int
    track: Track


@dataclass(frozen=True, eq=False)
class Light:
    """A light that was found.

    Attributes:
        environment: in the unit of the photos over the capture's exposure.
        said: plain values of a report.
    """

    environment: EnvironmentMap
    said: dict[str, Any]


@dataclass(frozen=True, eq=False)
class Materials:
    """Materials that a prior found, and the light where it finds both at once.

    Attributes:
        scene: the surfels with them.
        learnt: the materials that were found; the others are what surfels begin with.
        light: None where :meth:`Prior.find_light` has to look for it.
        gains: (V, 3) linear exposure and white balance of the training photos over the mean photo's, where
            the prior finds them.
        proxy: that they were found on; None: on the surfels themselves.
    """

    scene: GaussianScene
    learnt: tuple[str, ...] = ()
    light: Light | None = None
    gains: np.ndarray | None = None
    proxy: Proxy | None = None


class Prior(ABC):
    """Strategy of a reconstruction; plain values, for Hydra's ``_target_``."""

    @abstractmethod
    def check(self, capture: Capture) -> None:
        """Raise TronError where nothing can be had for a capture: it is told before long work."""

    def teach(self, capture: Capture, fields: Collection[str], track: Track) -> Capture:  # noqa: ARG002
        """The capture, its training views with those of the fields that the prior has; by itself as it is."""
        return capture

    def carry(self, capture: Capture, seed: int, track: Track) -> Carried | None:  # noqa: ARG002
        """Find materials for the surfels of the capture's scan, and its light; None: not by this prior."""
        log.info("prior %s finds materials on new surfels alone", type(self).__name__)

    @abstractmethod
    def find_materials(self, surfels: Surfels) -> Materials:
        """Find materials on frozen geometry."""

    def find_light(  # noqa: B027 (a prior may find none, or find it with the materials)
        self, surfels: Surfels, tracer: SurfelTracer, settings: FitSettings
    ) -> Light | None:
        """The light of the capture, or None where it cannot be found, which the log says.

        It is asked for where :meth:`find_materials` gave none.

        Args:
            surfels: as before materials were found.
            tracer: of the surfels with materials.
            settings: of the fit.
        """


class MapPrior(Prior):
    """Source of maps of each view, which stages 2 (materials) and 3 (light) learn from."""

    @abstractmethod
    def fields(self, capture: Capture) -> Mapping[str, str]:
        """Maps that can be given for this capture: field -> how, in a few words.

        Raises:
            TronError: nothing can be given, for example because a folder or a checkpoint is missing.
        """

    @abstractmethod
    def prepare(self, capture: Capture, fields: Collection[str]) -> Maps:
        """Load or fit what all views share, and return what makes the maps of one view.

        The maps hold the wanted fields at most, in the spaces that View states, and lack what this view has
        not got.

        Args:
            capture: all its views are offered; only the training views are asked for maps afterwards.
            fields: wanted; a subset of :meth:`fields`.
        """

    def check(self, capture: Capture) -> None:
        """See :meth:`fields`; a name that is none of FIELDS would never be asked for, and is refused."""
        _require_fields(self.fields(capture))

    def teach(self, capture: Capture, fields: Collection[str], track: Track) -> Capture:
        """See :func:`apply_prior`."""
        return apply_prior(capture, self, fields, track)

    def find_materials(self, surfels: Surfels) -> Materials:
        """Learn the materials that any view has a map of."""
        views = surfels.capture.train_views
        given = tuple(name for name in MATERIALS if any(view.has(name) for view in views))
        scene = surfels.learn(given) if given else surfels.scene
        for name in (name for name in MATERIALS if name not in given):
            log.warning("no prior for %s: it stays what surfels begin with", name)
        return Materials(scene, given)

    def find_light(self, surfels: Surfels, tracer: SurfelTracer, settings: FitSettings) -> Light | None:
        """Fit the light to maps of irradiance (paper, Algorithm 2), where any view has one."""
        if not any(view.has("irradiance") for view in surfels.capture.train_views):
            log.warning("the prior gives no irradiance, so no light can be fitted")
            return None
        fit = fit_environment(surfels.capture, tracer, settings, surfels.track)
        error = float(np.mean(fit.cubemap.loss[-50:]))
        return Light(fit.environment, {"sigma": fit.scale.sigma, "irradiance_l1": error})


def _require_fields(names: Collection[str], where: str | None = None) -> None:
    if unknown := sorted(set(names) - set(FIELDS)):
        raise TronError(f"{unknown[0]!r} is no field of a prior", where, f"use {', '.join(FIELDS)}")


def apply_prior(
    capture: Capture,
    prior: MapPrior,
    fields: Collection[str] = FIELDS,
    track: Track = untracked,
) -> Capture:
    """A capture whose training views carry the maps of a prior, and of no one else.

    The fields asked for are overwritten, with None where the prior has nothing: maps of two sources are never
    mixed. Held-out views keep what they have, the truth by which they are judged. Arrays are kept in half
    precision (8 bits for masks), readers are kept as they are. What is given and what is not is logged.

    Args:
        capture: its training views get the maps.
        prior: whose maps.
        fields: of ``FIELDS``, those to fill.
        track: shows the progress of long loops.

    Raises:
        TronError: an unknown field, or what the prior raises.
    """
    _require_fields(fields)
    name = type(prior).__name__
    offered = prior.fields(capture)
    given = [each for each in fields if each in offered]
    for each in fields:
        log.info("prior %s: %s: %s", name, each, offered.get(each, f"not available from {name}"))
    found: dict[str, Mapping[str, Pixels]] = {}
    if given:
        maps = prior.prepare(capture, frozenset(given))
        for view in track(capture.train_views, f"prior {name}"):
            found[view.name] = maps(view)
            _require_fields(found[view.name], f"maps of view {view.name}")
    for each in given:
        without = [view for view, maps in found.items() if each not in maps]
        if without:
            gap = f"missing for {len(without)} of {len(found)} views (first: {without[0]})"
            log.warning("prior %s: %s: %s", name, each, gap)
    views = tuple(
        view if view.name in capture.test else _carrying(view, fields, found.get(view.name, {}))
        for view in capture.views
    )
    return replace(capture, views=views)


def _carrying(view: View, wanted: Collection[str], maps: Mapping[str, Pixels]) -> View:
    # Arrays are checked by a View of their own before they are packed; readers when they read.
    checked = replace(view, **{field: maps.get(field) for field in wanted})
    packed: dict[str, Any] = {
        field: _packed(field, checked.read(field))
        for field, value in maps.items()
        if field in wanted and not callable(value)
    }
    return replace(checked, **packed) if packed else checked


def _packed(field: str, pixels: np.ndarray) -> Callable[[], np.ndarray]:
    """Hold a map in half precision, or 8 bits, until it is read; half's relative error is 5e-4."""
    if field == "sky_mask":
        return partial(_unpacked, np.round(255 * pixels.clip(0, 1)).astype(np.uint8), 255)
    limit = float(np.finfo(np.float16).max)
    return partial(_unpacked, pixels.clip(-limit, limit).astype(np.float16), 1)


def _unpacked(pixels: np.ndarray, scale: int) -> np.ndarray:
    return pixels.astype(np.float32) / scale


def world_normals(normals: np.ndarray, camera: Camera, frame: NormalFrame) -> np.ndarray:
    """Unit world normals (H, W, 3) float32 from signed ones of any frame, zero where there is none.

    Vectors far from unit length, such as a black or grey background decodes to, are no normals.
    """
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    low, high = _UNIT_RANGE
    unit = np.where((length > low) & (length < high), normals / np.maximum(length, 1e-12), 0.0)
    if frame == "camera_opengl":
        unit = unit * (1.0, -1.0, -1.0)
    if frame != "world":
        unit = unit @ camera.camera_to_world[:3, :3].T
    return unit.astype(np.float32)


def resized(pixels: np.ndarray, width: int, height: int) -> np.ndarray:
    """(H, W) or (H, W, C) -> (height, width[, C]) float32: means of areas where it shrinks, else bilinear."""
    import cv2

    pixels = np.ascontiguousarray(pixels, np.float32)
    if pixels.shape[:2] == (height, width):
        return pixels
    shrinks = width <= pixels.shape[1] and height <= pixels.shape[0]
    return cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


def same_aspect(pixels: np.ndarray, camera: Camera) -> bool:
    """Whether a map has the proportions of the view; one pixel of rounding is allowed on small maps."""
    height, width = pixels.shape[:2]
    allowed = max(ASPECT_TOLERANCE, 1.0 / min(height, width, camera.height, camera.width))
    return abs(width * camera.height / (height * camera.width) - 1) <= allowed
