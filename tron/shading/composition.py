"""Light arriving at a surface -> radiance leaving it towards a view: one formula for every picture.

    pbr         kd U + S                       no occlusion
    shadowed    kd E + S                       shadows on the diffuse part
    lit         kd (E + I) + o S + ks M        with bounced light

U is the unshadowed irradiance / pi, E the shadowed irradiance / pi, I the irradiance / pi of bounced light, S
the split-sum specular of the environment, o the share of S that is not occluded by the scene, and M the mean
radiance over the lobe of the scene parts that occlude it. kd and ks come from
:mod:`tron.brdf.reflectance`.

Without reflection rays (:mod:`tron.shading.reflections`) M is I: the scene is as bright in the lobe as in all
directions. And o is (1 - roughness) openness + roughness E / U: a rough lobe sees the same light as a diffuse
surface, a mirror mostly misses the sun that dominates E. On training scenes this gains 0.3 to 0.4 dB over
openness alone. But radiance in the lobe far above U comes from lamps, which make up most of U. Where most of
U arrives they are visible; where little arrives they are hidden, and the lobe's radiance is limited to E.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.brdf.reflectance import lobe_parts, reflectance
from tron.estimation import Brdf
from tron.shading.direct.visibility import shading_normal
from tron.shading.lighting import SplitSum
from tron.tracing.hierarchy.transmittance import OPAQUE_TRANSMITTANCE

if TYPE_CHECKING:
    from tron.tracing import Surface


LAMP = 4.0
"""Radiance in a lobe above this many times U is a lamp's; above twice that, the limit is fully E."""
HIDDEN, SEEN = 0.25, 0.75
"""E / U up to which the lamps in a lobe are hidden, and above which they are visible."""
CLEAR_TRANSMITTANCE = 0.25
"""Transmittance from which the background is seen with its full share."""
_END = 1 / 64
"""This near its ends the transition is 0 or 1 in float32; its terms would overflow there."""
Array = TypeVar("Array")


@dataclass
class Bounced:
    """Bounced light at surfaces, one lane each, linear.

    Attributes:
        indirect: I, irradiance / pi.
        openness: o, share by channel.
        mirrored: M, radiance.
    """

    indirect: mi.Color3f
    openness: mi.Color3f
    mirrored: mi.Color3f


@dataclass
class Response:
    """A surface under the environment, towards its view: kd, ks, U and S, one lane each, linear."""

    diffuse: mi.Color3f
    lobe: mi.Color3f
    unshadowed: mi.Color3f
    specular: mi.Color3f

    @classmethod
    def of(
        cls, surface: Surface, split_sum: SplitSum, brdf: Brdf, looked_up: Surface | None = None
    ) -> Response:
        """The response along the surface's own rays; differentiable by material, normal and light.

        ``looked_up``: a surface of another roughness, whose lobe looks up the light; None: its own.
        """
        normal, to_camera = shading_normal(surface), -surface.direction
        cosine = dr.dot(normal, to_camera)
        share = reflectance(surface, split_sum.brdf, cosine, brdf)
        seen = surface if looked_up is None else looked_up
        if brdf == "lambert":  # as the paper looks it up
            mirrored = split_sum.reflected(normal, to_camera, seen.roughness)
        else:
            mirrored = split_sum.averaged(lobe_parts(seen, split_sum.brdf, normal, to_camera))
        return cls(share.diffuse, share.specular, split_sum.diffuse(normal), mirrored * share.specular)

    def open(self) -> mi.Color3f:
        """Radiance with nothing in the way."""
        return self.diffuse * self.unshadowed + self.specular

    def direct(self, irradiance: mi.Color3f) -> mi.Color3f:
        """Radiance by direct light, given its shadowed ``irradiance`` / pi."""
        return self.diffuse * irradiance + self.specular

    def lit(self, irradiance: mi.Color3f, bounced: Bounced) -> mi.Color3f:
        """Radiance by all light, given the shadowed ``irradiance`` / pi of direct light."""
        return (
            self.diffuse * (irradiance + bounced.indirect)
            + bounced.openness * self.specular
            + self.lobe * bounced.mirrored
        )


def evenly_bounced(
    indirect: mi.Color3f, openness: mi.Float, visibility: mi.Color3f, roughness: mi.Float, response: Response
) -> Bounced:
    """Bounced light without reflection rays: the same from all directions.

    Args:
        indirect: I.
        openness: cosine-weighted share of the directions in which no surfel is met.
        visibility: E / U.
        roughness: in [0, 1].
        response: U and the lobe.
    """
    direct = dr.minimum(visibility, 1)
    share = dr.lerp(mi.Color3f(openness), direct, roughness)
    even = response.lobe * response.unshadowed
    beyond = dr.clip(ratio(response.specular, even, 0) / LAMP - 1, 0, 1)
    rest = dr.lerp(LAMP * even, even * direct, beyond)
    lamp = ratio(dr.maximum(response.specular - rest, 0), response.specular, 0)
    seen = dr.clip((direct - HIDDEN) / (SEEN - HIDDEN), 0, 1)
    return Bounced(indirect, dr.lerp(share, seen, lamp), indirect)


def ratio(part: mi.Color3f, whole: mi.Color3f, otherwise: float) -> mi.Color3f:
    """Part over whole by channel; ``otherwise`` where the whole is 0."""
    pairs = zip(part, whole, strict=True)
    return mi.Color3f(*[dr.select(b > 0, a / dr.select(b > 0, b, 1), otherwise) for a, b in pairs])


def background_share(transmittance: Array) -> Array:
    """Weight in [0, 1] of the radiance behind surfels, by their transmittance T; theirs is one minus it.

        share(T) = 0                                            T <= 0.01
                   T / (1 + exp(1/s - 1/(1 - s)))               s = (T - 0.01) / (0.25 - 0.01)
                   T                                            T >= 0.25

    The surfels of a solid let through a few thousandths of the light, and on one ray in a hundred more than
    0.02. That is invisible until a sun stands behind: its radiance may be 10^4 times exposed white. So a
    transmittance below 0.01 counts as none, as for shadow rays, and above it a smooth transition, flat to
    every order at both ends, blends to the full share: at T = 0.026 it lets through 10^-8. The share is
    smooth and monotone. Shading has the weight 1 - share, so that opaque surfels are not dimmed either.
    Opacity itself, which is the mask, stays 1 - T.

    Args:
        transmittance: 1 - opacity of the surfels along a ray, any shape, in [0, 1]; differentiable if it is
            of Dr.Jit's.
    """
    arrays, choose = (np, np.where) if isinstance(transmittance, np.ndarray) else (dr, dr.select)
    along = (transmittance - OPAQUE_TRANSMITTANCE) / (CLEAR_TRANSMITTANCE - OPAQUE_TRANSMITTANCE)
    along = arrays.clip(along, _END, 1 - _END)
    transition = 1 / (1 + arrays.exp(1 / along - 1 / (1 - along)))
    return choose(transmittance > OPAQUE_TRANSMITTANCE, transmittance * transition, 0)


def over_background(shaded: mi.Color3f, behind: mi.Color3f, opacity: mi.Float) -> mi.Color3f:
    """Linear radiance of surfels of this ``opacity`` in front of ``behind``; at opacity 0, ``behind``."""
    return dr.select(opacity > 0, dr.lerp(shaded, behind, background_share(1 - opacity)), behind)
