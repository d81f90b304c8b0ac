"""Clear sky and sun after Hosek and Wilkie (2012, 2013), by Mitsuba's ``sunsky``.

Mitsuba writes the sun's aperture into a kernel's code and nothing else of a sky. So the disc is always
evaluated at one aperture, at angles scaled to it, and no sky compiles a kernel that another has compiled.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.aligned import aligned

_APERTURE_DEG = 5.0
_FEWEST = 16


@dataclass(frozen=True)
class Sky:
    """Sky without clouds.

    Attributes:
        sun: unit direction (3,) to the sun, world, z up, above the horizon.
        turbidity: of the air, 1 to 10.
        albedo: of the ground, which lights the sky from below.
    """

    sun: np.ndarray
    turbidity: float
    albedo: float

    def dome(self, directions: np.ndarray) -> np.ndarray:
        """Linear radiance (N, 3) of the air alone along unit directions (N, 3); black below the horizon."""
        return self._evaluate(directions, sun_scale=0.0)

    def disc(self, directions: np.ndarray, aperture_deg: float) -> np.ndarray:
        """Linear radiance (N, 3) of the sun alone, ``aperture_deg`` wide and as strong as the true one."""
        image = np.zeros(directions.shape)
        inside = np.flatnonzero(directions @ self.sun > np.cos(np.radians(0.5 * aperture_deg)))
        toward = directions[inside]
        cosine = toward @ self.sun
        across = toward - cosine[:, None] * self.sun
        sine = np.linalg.norm(across, axis=1)
        # Limb darkening is a function of the sine relative to the rim's.
        sine_there = sine * np.sin(np.radians(0.5 * _APERTURE_DEG)) / np.sin(np.radians(0.5 * aperture_deg))
        there = (
            np.sqrt(1.0 - sine_there**2)[:, None] * self.sun
            + (sine_there / np.maximum(sine, 1e-12))[:, None] * across
        )
        wider = _cap(_APERTURE_DEG) / _cap(aperture_deg)
        if not len(inside):
            return image
        image[inside] = wider * self._evaluate(there, sky_scale=0.0, sun_aperture=_APERTURE_DEG)
        return image * (directions[:, 2:] > 0.0)

    def _evaluate(self, directions: np.ndarray, **scales: float) -> np.ndarray:
        emitter = mi.load_dict(
            {
                "type": "sunsky",
                "sun_direction": self.sun.tolist(),
                "turbidity": float(self.turbidity),
                "albedo": float(self.albedo),
                **scales,
            }
        )
        si = dr.zeros(mi.SurfaceInteraction3f, max(len(directions), _FEWEST))
        # Where NumPy's memory begins would be a part of the kernel, and so would a width of a few numbers.
        padded = np.resize(directions, (max(len(directions), _FEWEST), 3)).T.astype(np.float32)
        si.wi = -mi.Vector3f(*(mi.Float(aligned(axis)) for axis in padded))
        return np.array(emitter.eval(si)).T[: len(directions)].astype(np.float64)


def _cap(aperture_deg: float) -> float:
    """Solid angle of a disc, relative to the sphere's half."""
    return 1.0 - float(np.cos(np.radians(0.5 * aperture_deg)))
