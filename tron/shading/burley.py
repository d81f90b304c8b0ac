"""Burley's diffuse factor for the light that arrives: rough floors under low suns.

The diffuse part of Mitsuba's ``principled`` (:mod:`tron.shading.brdf_table`) is a polynomial in roughness r,

    base / pi (t_0 + t_1 r + t_2 r^2)       t_0 = (1 - F_l / 2) (1 - F_v / 2)
                                            t_1 = (1 + l.v) (F_l + F_v - F_l F_v)
                                            t_2 = (1 + l.v)^2 F_l F_v

with F_l = (1 - n.l)^5, F_v alike. The means of t_0, t_1 and t_2 over the shadow rays, each by the luminance
that it brings, give the factor of the light that arrives, differentiable in r. The table's D is their mean
over even light: of a floor of roughness 1 under a sun 15 degrees high, seen 15 degrees from its plane, it
made 1.17 of path tracing's radiance on one side and 0.70 on the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from tron.color import LUMINANCE
from tron.tracing.surface import Surface


def burley_terms(normal: mi.Vector3f, along: mi.Vector3f, light: mi.Vector3f) -> mi.Vector3f:
    """t_0, t_1, t_2 for unit world normals, directions from the camera, and directions to the light."""
    towards = _schlick(dr.dot(normal, light))
    away = _schlick(-dr.dot(normal, along))
    back = 1 - dr.dot(light, along)
    return mi.Vector3f(
        (1 - towards / 2) * (1 - away / 2),
        back * (towards + away - towards * away),
        back * back * towards * away,
    )


_LEAST_WEIGHT = 1e-30
EVEN_LENGTH = 2 / 3
"""Length of the mean direction that even light arrives from; of a single direction it is 1."""


def even_terms(normal: mi.Vector3f, along: mi.Vector3f) -> mi.Vector3f:
    """Means of the terms over even light: Beta integrals of 2 c (1 - c)^5 over the cosine c of n and l.

    Arguments as of :func:`burley_terms`. The table's D is what :func:`burley_factor` makes of them.
    """
    cosine = -dr.dot(normal, along)
    away = _schlick(cosine)
    return mi.Vector3f(
        41 / 42 * (1 - away / 2),
        (1 - away) * (1 / 21 + cosine / 84) + away * (1 + EVEN_LENGTH * cosine),
        away * (1 / 21 + cosine / 42 + cosine * cosine / 252 + (1 - cosine * cosine) * 11 / 504),
    )


def terms_of_mean(normal: mi.Vector3f, along: mi.Vector3f, mean: mi.Vector3f) -> mi.Vector3f:
    """Terms of light whose mean direction is known alone, as of even light and a single direction besides.

    With k the part of that direction u, ``mean`` is k u + (1 - k) 2/3 n, which has one solution in [0, 1].

    Args:
        normal, along: as of :func:`burley_terms`.
        mean: of the unit world directions to the light, by luminance; no longer than 1.
    """
    beyond = mean - EVEN_LENGTH * normal
    b, c, a = EVEN_LENGTH * dr.dot(beyond, normal), dr.squared_norm(beyond), 1 - EVEN_LENGTH**2
    part = dr.clip((b + dr.sqrt(b * b + a * c)) / a, 0, 1)
    single = dr.normalize(dr.select(part > 1e-3, beyond + part * EVEN_LENGTH * normal, normal))
    return dr.lerp(even_terms(normal, along), burley_terms(normal, along, single), part)


@dataclass
class DirectionSums:
    """Sums of the unit world directions that light arrives from, by luminance, and of that; one a lane."""

    total: mi.Vector3f
    weight: mi.Float

    @classmethod
    def none(cls, surface: Surface) -> DirectionSums:
        """Nothing has arrived yet."""
        return cls(*_nothing(surface))

    def add(
        self, directions: Sequence[mi.Vector3f], light: Sequence[mi.Color3f], visible: Sequence[mi.Float]
    ) -> None:
        """Add rays: unit world directions, the linear light along them, and the share that arrives."""
        for direction, value, share in zip(directions, light, visible, strict=True):
            weight = grey(value) * share
            self.total += weight * self._of(direction)
            self.weight += weight
        dr.eval(self.total, self.weight)

    def _of(self, direction: mi.Vector3f) -> mi.Vector3f:
        return direction


@dataclass
class BurleySums(DirectionSums):
    """The same of the terms in place of the directions; one lane a pixel."""

    normal: mi.Vector3f
    along: mi.Vector3f

    @classmethod
    def none(cls, surface: Surface) -> BurleySums:
        """Nothing has arrived yet."""
        normal, along = dr.detach(mi.Vector3f(surface.normal)), dr.detach(surface.direction)
        dr.eval(normal, along)
        return cls(*_nothing(surface), normal, along)

    def _of(self, direction: mi.Vector3f) -> mi.Vector3f:
        return burley_terms(self.normal, self.along, direction)


def _nothing(surface: Surface) -> tuple[mi.Vector3f, mi.Float]:
    lanes = dr.width(surface.opacity)
    total, weight = dr.zeros(mi.Vector3f, lanes), dr.zeros(mi.Float, lanes)
    dr.make_opaque(total, weight)
    return total, weight


def weighed_mean(total: mi.Vector3f, weight: mi.Float) -> mi.Vector3f:
    """Means of terms or directions, from sums of them by ``weight``; 0 of none to speak of.

    Behind many surfels a ray's share is below float32's normal numbers, and its inverse is infinite.
    """
    there = weight > _LEAST_WEIGHT
    return dr.select(there, total / dr.select(there, weight, 1), 0)


def burley_factor(terms: mi.Vector3f, roughness: mi.Float, otherwise: mi.Float) -> mi.Float:
    """Factor on Lambert's albedo; ``otherwise`` where there are no terms, which is where t_0 is 0."""
    return dr.select(terms.x > 0, terms.x + roughness * (terms.y + roughness * terms.z), otherwise)


def _schlick(cosine: mi.Float) -> mi.Float:
    return (1 - dr.clip(cosine, 0, 1)) ** 5


def grey(color: mi.Color3f) -> mi.Float:
    """Luminance of linear BT.709."""
    return dr.dot(color, mi.Color3f(LUMINANCE))
