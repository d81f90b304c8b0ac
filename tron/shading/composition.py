"""Light that arrives at a surface -> radiance that leaves it towards a view: one formula for every picture.

    pbr         kd U + S                       nothing in the way
    shadowed    kd E + S                       shadows on the diffuse part
    lit         kd (E + I) + o S + ks M        and light that has met the scene

U is the unshadowed irradiance / pi, E what arrives of it, I the irradiance / pi of bounced light, S the
split-sum specular of the environment alone, o the share of it that escapes the scene, M the mean radiance
over the lobe of the scene that is in the way of the rest. kd and ks are those of
:mod:`tron.brdf.reflectance`.

Without reflection rays (:mod:`tron.shading.reflections`) M is I: the scene shines into the lobe as it does
from everywhere. And o is (1 - roughness) openness + roughness E / U: a rough lobe sees what a diffuse surface
sees, a mirror mostly something else than the sun that E is about. On training scenes that is 0.3 to 0.4 dB
above openness alone. But radiance in the lobe far beyond U comes from lamps, which are most of U. Where most
of U arrives they are seen; where little does they are hidden, and the lobe has no more of the rest than E.
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
"""Times U from which on radiance in a lobe is a lamp's; from twice that on the rest is what arrives, E."""
HIDDEN, SEEN = 0.25, 0.75
"""E / U up to which the lamps that a lobe meets are hidden, and from which on they are seen."""
CLEAR_TRANSMITTANCE = 0.25
"""From here on what lies behind is seen with its full share."""
_END = 1 / 64
"""The transition is 0 and 1 in float32 this near its ends, where its terms would overflow."""
Array = TypeVar("Array")


@dataclass
class Bounced:
    """Light that has met the scene, at surfaces, one lane each, linear.

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

        ``looked_up``: the same of another roughness, by whose lobe light is looked up; None: by its own.
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
        """Radiance of direct light, of which ``irradiance`` / pi arrives."""
        return self.diffuse * irradiance + self.specular

    def lit(self, irradiance: mi.Color3f, bounced: Bounced) -> mi.Color3f:
        """Radiance of all light: ``irradiance`` / pi of it is direct."""
        return (
            self.diffuse * (irradiance + bounced.indirect)
            + bounced.openness * self.specular
            + self.lobe * bounced.mirrored
        )


def evenly_bounced(
    indirect: mi.Color3f, openness: mi.Float, visibility: mi.Color3f, roughness: mi.Float, response: Response
) -> Bounced:
    """Bounced light without reflection rays: from everywhere alike.

    Args:
        indirect: I.
        openness: share of the directions, by the cosine, in which nothing is met.
        visibility: E / U.
        roughness: in [0, 1].
        response: U, and the lobe that is shared.
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
    """Part over whole by channel; ``otherwise`` where there is no whole."""
    pairs = zip(part, whole, strict=True)
    return mi.Color3f(*[dr.select(b > 0, a / dr.select(b > 0, b, 1), otherwise) for a, b in pairs])


def background_share(transmittance: Array) -> Array:
    """Weight in [0, 1] of the radiance behind surfels, by their transmittance T; theirs is one minus it.

        share(T) = 0                                            T <= 0.01
                   T / (1 + exp(1/s - 1/(1 - s)))               s = (T - 0.01) / (0.25 - 0.01)
                   T                                            T >= 0.25

    Surfels that make up a solid leave a few thousandths of the light, a hundredth of all rays more than two
    hundredths. That is invisible until a sun stands behind: its radiance may be 10^4 times exposed white. So
    a transmittance below 0.01 counts as none, as it does for shadow rays, and the rest comes back by the
    smooth transition function, which is flat to every order at both ends: at T = 0.026 it lets through 10^-8.
    The share is smooth and monotone. What is shaded has the weight 1 - share, so that opaque surfels are not
    dimmed either. Opacity itself, which is the mask, stays 1 - T.

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
    """Linear radiance of surfels of this ``opacity`` in front of ``behind``; of none, ``behind`` alone."""
    return dr.select(opacity > 0, dr.lerp(shaded, behind, background_share(1 - opacity)), behind)
