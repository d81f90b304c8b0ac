"""The sun of a capture, found by the shadows it casts.

A sun of direction d adds s V(p, d) (n_p . d)+ to what point p receives. With the rest of the light known,
however roughly, each direction predicts by how much one of two like neighbours is brighter, because the other
lies in the shadow or faces away. The direction whose predictions fit best is the sun's; what it explains says
whether there is one. Directions are searched over the sphere, then ever more finely about the best; then
widths: wide suns have soft shadows.

The lobe is a spherical Gaussian, radiance ~ exp((cos angle - 1) / width^2), of unit irradiance / pi.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from tron.framing import even_directions
from tron.reconstruction.light.fit_pairs import ALIKE, ROBUST, Light, Points
from tron.reconstruction.light.sky_visibility import visibility_towards
from tron.seeds import generator
from tron.shading.direct.irradiance import Occluder

WIDTHS = np.radians([0.5, 2.0, 4.0, 8.0, 14.0])
"""Widths that are tried; the true sun, 0.53 degrees across, has about 0.2."""
_DIRECTIONS, _FEW = 600, 2000
"""Of the first search, and the points that it looks at: directions lie 9 degrees apart."""
_SAMPLES = 16
_NEIGHBOURS = 12
_RINGS = np.radians([9.0, 4.0, 1.6, 0.6])
_STRENGTHS = np.array([0.3, 1.0, 3.0, 10.0, 30.0])
_FINER = np.array([0.4, 0.6, 1.0, 1.6, 2.5])
"""Sun over the mean rest of the light, on a surface that faces it."""
_BRIGHTEST = 2.0
"""Radiance of the rest of the light, at most, over its median."""


@dataclass(frozen=True)
class Sun:
    """A lobe of light.

    Attributes:
        direction: (3,) unit, towards it, world.
        width: radians.
        strength: (3,) irradiance / pi on a surface that faces it.
    """

    direction: np.ndarray
    width: float
    strength: np.ndarray

    def radiance(self, directions: np.ndarray) -> np.ndarray:
        """(..., 3) radiance from unit world directions (..., 3)."""
        sharp = 1 / self.width**2
        # Integral of exp(sharp (cos - 1)) cos over the hemisphere, in closed form.
        total = 2 * (sharp - 1 + np.exp(-sharp)) / sharp**2
        shape = np.exp(sharp * (directions @ self.direction - 1)) / total
        return shape[..., None] * self.strength


class SunSearch:
    """Pairs of neighbours that tell of a sun.

    Args:
        tracer: what casts shadows.
        points: the surface.
        soft: light without a sun.
        radius: of the patches that are compared, world units.
        seed: root of the pairs.
    """

    def __init__(self, tracer: Occluder, points: Points, soft: Light, radius: float, seed: int) -> None:
        self.tracer, self.points, self.soft = tracer, points, soft
        self.radius, self.seed = radius, seed
        self.patches = points.patches(radius)
        averaged = points.averaged(self.patches)
        # The soft light has put what it could of the sun into its brightest texels: that is not the rest.
        grey = soft.texels.mean(1)
        rest = np.minimum(grey, _BRIGHTEST * np.median(grey))
        self.rest = np.maximum(averaged.transport @ rest + averaged.bounced.mean(1), 1e-5)
        shown = np.log(np.maximum(averaged.color, 1e-4))
        chroma = shown[:, [0, 2]] - shown[:, 1:2]
        size = np.ptp(points.position, axis=0).max()
        place = points.position / size
        near = np.asarray(KDTree(place).query(place, k=min(_NEIGHBOURS * 4, len(place)))[1])
        draw = generator(seed, "joint light", "sun")
        chosen = draw.integers(1, near.shape[1], (len(near), _NEIGHBOURS))
        self.first = np.repeat(np.arange(len(near)), _NEIGHBOURS)
        self.second = np.take_along_axis(near, chosen, 1).ravel()
        # Shadows are bluer than the sun's light: chromaticity may differ by more than within a material.
        gap = ((chroma[self.first] - chroma[self.second]) / (2 * ALIKE)) ** 2
        self.weight = np.exp(-gap.sum(1))
        self.weight /= self.weight.sum()
        brightness = shown.mean(1)
        self.shown = brightness[self.first] - brightness[self.second]

    def find(self) -> tuple[np.ndarray, float]:
        """Direction (3,) of the best sun, and its strength over the mean rest."""
        up = self.tracer.scene.up
        best = self._of_few()._best(_above(even_directions(_DIRECTIONS), up))
        for ring in _RINGS:
            best = self._best(_above(_around(best[0], ring), up))
        return best[0], best[1]

    def loss(self, light: Light, points: Points) -> float:
        """Misfit of a light to the neighbours among averaged points: mean robust log difference."""
        received = (light.irradiance(points) + points.bounced).mean(1)
        return self._loss(np.log(np.maximum(received, 1e-5)))

    def _of_few(self) -> SunSearch:
        """The same search among some of the points."""
        stride = -(-len(self.points.position) // _FEW)
        few = self.points.taken(slice(None, None, stride))
        return SunSearch(self.tracer, few, self.soft, self.radius, self.seed)

    def width(self, direction: np.ndarray, strength: float) -> tuple[float, float]:
        """The width, of ``WIDTHS``, and the strength near another, whose shadows fit best together.

        A sun that is too strong would be taken for one that is too wide.
        """
        shares = [self.received(direction, width) * self.rest.mean() for width in WIDTHS]
        tried = [
            (self._loss(np.log(self.rest + finer * share)), float(width), float(finer))
            for width, share in zip(WIDTHS, shares, strict=True)
            for finer in strength * _FINER
        ]
        return min(tried)[1:]

    def received(self, direction: np.ndarray, width: float) -> np.ndarray:
        """(P,) share of a sun's irradiance that arrives at the patches, cosine included."""
        points = self.points
        return self.patches.mean(
            lobe_transport(self.tracer, points.position, points.normal, direction, width)
        )

    def _best(self, directions: np.ndarray) -> tuple[np.ndarray, float, float]:
        points, found = self.points, []
        for first in range(0, len(directions), 64):
            some = directions[first : first + 64]
            seen = visibility_towards(self.tracer, points.position, points.normal, some)
            seen = self.patches.mean(seen * np.maximum(points.normal @ some.T, 0))
            for column, direction in zip(seen.T, some, strict=True):
                for strength in _STRENGTHS:
                    received = self.rest + strength * self.rest.mean() * column
                    found.append((direction, float(strength), self._loss(np.log(received))))
        return min(found, key=lambda one: one[2])

    def _loss(self, log_received: np.ndarray) -> float:
        off = np.abs(self.shown - log_received[self.first] + log_received[self.second])
        return float((self.weight * np.log1p(off / ROBUST)).sum())


def lobe_transport(
    tracer: Occluder, position: np.ndarray, normal: np.ndarray, direction: np.ndarray, width: float
) -> np.ndarray:
    """(P,) float32 share of a lobe's irradiance that arrives at points, cosine included."""
    along = _samples(direction, width)
    cosine = np.maximum(normal @ along.T, 0)
    facing = float((along @ direction).mean())
    return (visibility_towards(tracer, position, normal, along) * cosine).mean(1) / np.float32(facing)


def _above(directions: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Those of some directions (N, 3) that are above the horizon."""
    return directions[directions @ up > 0]


def _around(direction: np.ndarray, angle: float) -> np.ndarray:
    """(19, 3) the direction, and rings at half the angle and at all of it."""
    turns = [(0.0, 0.0), *((0.5, k / 6) for k in range(6)), *((1.0, k / 12) for k in range(12))]
    radius, turn = np.array(turns).T
    return _tilted(direction, radius * angle, 2 * np.pi * turn)


def _samples(direction: np.ndarray, width: float) -> np.ndarray:
    """(samples, 3) directions of a spherical Gaussian, on a spiral."""
    share = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    cosine = 1 + width**2 * np.log(1 - share * (1 - np.exp(-2 / width**2)))
    turn = np.arange(_SAMPLES) * np.pi * (3 - np.sqrt(5))
    return _tilted(direction, np.arccos(np.clip(cosine, -1, 1)), turn)


def _tilted(direction: np.ndarray, angle: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Directions at angles from one, turned about it."""
    helper = np.eye(3)[np.argmin(np.abs(direction))]
    u = np.cross(direction, helper)
    u /= np.linalg.norm(u)
    v = np.cross(direction, u)
    across = np.cos(turn)[:, None] * u + np.sin(turn)[:, None] * v
    return np.cos(angle)[:, None] * direction + np.sin(angle)[:, None] * across
