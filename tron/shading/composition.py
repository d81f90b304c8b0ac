"""Light that arrives at a surface -> radiance that leaves it towards a view: one formula for every picture.

    pbr         kd U + S                       nothing in the way
    shadowed    kd E + S                       shadows on the diffuse part
    lit         kd (E + I) + o S + ks M        and light that has met the scene

U is the unshadowed irradiance / pi, E what arrives of it, I the irradiance / pi of bounced light, S the
split-sum specular of the environment alone, o the share of it that escapes the scene, M the mean radiance
over the lobe of the scene that is in the way of the rest. kd and ks are those of
:mod:`tron.shading.reflectance`.

Without reflection rays (:mod:`tron.shading.reflections`) M is I: the scene shines into the lobe as it does
from everywhere. And o is (1 - roughness) openness + roughness E / U: a rough lobe sees what a diffuse surface
sees, a mirror mostly something else than the sun that E is about. On training scenes that is 0.3 to 0.4 dB
above openness alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from tron.estimation import Diffuse
from tron.shading.reflectance import reflectance
from tron.shading.split_sum import SplitSum
from tron.shading.visibility import shading_normal

if TYPE_CHECKING:
    from tron.tracing import Surface


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
    def of(cls, surface: Surface, split_sum: SplitSum, diffuse: Diffuse) -> Response:
        """The response along the surface's own rays; differentiable by material, normal and light."""
        normal, to_camera = shading_normal(surface), -surface.direction
        share = reflectance(surface, split_sum.brdf, dr.dot(normal, to_camera), diffuse)
        mirrored = split_sum.reflected(normal, to_camera, surface.roughness)
        return cls(share.diffuse, share.specular, split_sum.diffuse(normal), mirrored * share.specular)

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
    indirect: mi.Color3f, openness: mi.Float, visibility: mi.Color3f, roughness: mi.Float
) -> Bounced:
    """Bounced light without reflection rays: from everywhere alike.

    Args:
        indirect: I.
        openness: share of the directions, by the cosine, in which nothing is met.
        visibility: E / U.
        roughness: in [0, 1].
    """
    share = dr.lerp(mi.Color3f(openness), dr.minimum(visibility, 1), roughness)
    return Bounced(indirect, share, indirect)
