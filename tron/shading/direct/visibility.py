"""Share of the unshadowed irradiance that reaches each point, estimated as an :class:`Estimation` says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import drjit as dr
import mitsuba as mi

from tron.estimation import Estimation
from tron.shading.direct.irradiance import Occluder, irradiance, visible_share
from tron.shading.direct.neighbours import neighbourhood_mean
from tron.shading.direct.noise import NoiseSums, without_noise
from tron.shading.lighting import Lighting

if TYPE_CHECKING:
    from tron.shading.direct.irradiance import Light
    from tron.tracing import GBuffer, Surface


class Shadows(Protocol):
    """Shadow rays of either sidedness: :class:`tron.tracing.SurfelTracer`, or a closed form in a test."""

    def sided(self, two_sided: bool) -> Occluder: ...


def visibility(
    tracer: Shadows, gbuffer: GBuffer, lighting: Lighting, estimation: Estimation, seed: int
) -> mi.Color3f:
    """Share of the unshadowed irradiance that reaches each pixel, by channel in [0, 1].

    Args:
        tracer: the occluders.
        gbuffer: positions, unit normals and opacity of the pixels.
        lighting: the prepared environment.
        estimation: how it is estimated.
        seed: root of the shadow rays' random numbers.
    """
    estimation = estimation.of_pixels()
    occluder, lanes = tracer.sided(estimation.two_sided), dr.width(gbuffer.opacity)
    narrow = noise = None
    if estimation.filtered and estimation.rays >= RATIO_FROM_RAYS:
        noise = NoiseSums.none(lanes)
    elif estimation.filtered:
        narrow = NarrowSums.none(lighting.light, lanes)
    observers = [each for each in (narrow, noise) if each is not None]
    found = irradiance(occluder, gbuffer, lighting.light, estimation.rays, seed, observers=observers)
    return reaching_share(*found, gbuffer, lighting, occluder.scene.spacing, estimation, narrow, noise)


def reaching_share(
    shadowed: mi.Color3f,
    unshadowed: mi.Color3f,
    gbuffer: GBuffer,
    lighting: Lighting,
    spacing: float,
    estimation: Estimation,
    narrow: NarrowSums | None = None,
    noise: NoiseSums | None = None,
) -> mi.Color3f:
    """Visibility from the two estimates of :func:`tron.shading.direct.irradiance`.

    ``narrow`` and ``noise`` come from the same rays, for the filters of few and of many rays. None: no light
    is narrow, nothing is noisy.
    """
    plain, many = estimation.estimator == "plain", estimation.rays >= RATIO_FROM_RAYS
    if noise is not None:
        shadowed, unshadowed = without_noise(shadowed, unshadowed, noise, estimation.rays, gbuffer, spacing)
    if many and not plain:
        return visible_share(shadowed, unshadowed)
    known = lighting.split_sum.diffuse(shading_normal(gbuffer))
    if not many and (estimation.filtered or not plain):
        share = regressed_share(shadowed, unshadowed, known, gbuffer, spacing)
        if not estimation.filtered:
            return share
        detail = mi.Float(0)
        if narrow is not None:
            all_rays = mi.luminance(unshadowed) * (estimation.rays // 2)
            detail = narrow.detail(all_rays, gbuffer, spacing)
        shadowed, unshadowed = atrous(shadowed, unshadowed, mi.luminance(share), gbuffer, spacing, detail)
    return visible_share(shadowed, known if plain else unshadowed)


def shading_normal(surface: Surface) -> mi.Vector3f:
    """Unit world normals, up where there is no surface."""
    # An empty pixel has no normal, and 0 / 0 must not reach a lookup.
    return dr.select(surface.opacity > 0, mi.Vector3f(surface.normal), mi.Vector3f(0, 0, 1))


# With s and u the sums of a pixel's rays with and without what is in their way
# (:mod:`tron.shading.direct.irradiance`) and U the unshadowed irradiance, known without noise:
#
#     from 16 rays    s / u
#     below           1 - (b + g (U - u)) / U, within [0, 1],      b = u - s, the light that is blocked
#                     g = cov(b, u) / var(u) over the neighbours' rays, without the pixel's own
#
# Both give exactly 1 where every ray is open. The ratio is biased at few rays: if no ray goes to a sun, the
# others say that all light arrives, and U includes the sun. The regression is unbiased for any g, because g
# is independent of the pixel's own rays and u - U has mean 0: a control variate (Owen, "Monte Carlo theory,
# methods and examples", 8.9). g is the blocked part of u's noise: 0 in the open, 1 in a dark umbra. The clamp
# leaves some bias. g is computed from luminances. A pixel without neighbours keeps the ratio.
#
# Mean over reference in shadowed pixels and RMSE of all, over an upward plane's light (128 x 128, 20k
# surfels of a seed that no benchmark uses):
#
#     rays    sun: s / u      regression      soft: s / u     regression
#     2       1.80  0.178     1.02  0.081     1.18  0.230     1.01  0.171
#     4       1.26  0.085     1.01  0.055     1.05  0.138     1.01  0.125
#     8       1.04  0.038     1.00  0.036     1.01  0.087     1.01  0.084

RATIO_FROM_RAYS = 16
"""Rays per pixel from which the ratio is used."""


def regressed_share(
    shadowed: mi.Color3f, unshadowed: mi.Color3f, known: mi.Color3f, gbuffer: GBuffer, spacing: float
) -> mi.Color3f:
    """Share of the light that arrives at each pixel, by channel in [0, 1]; the regression of this module.

    Args:
        shadowed, unshadowed: irradiance / pi, linear, from the same rays.
        known: unshadowed irradiance / pi without noise.
        gbuffer: positions, unit normals and opacity of the same pixels.
        spacing: the scene's surfel spacing, world units.
    """
    blocked = unshadowed - shadowed
    part, found = _blocked_part_of_noise(mi.luminance(blocked), mi.luminance(unshadowed), gbuffer, spacing)
    # For a pixel without neighbours g is b / u, and the regression is the ratio.
    ratio = visible_share(shadowed, unshadowed)
    lost = blocked + part * (known - unshadowed)
    share = [dr.select(k > 0, dr.clip(1 - lost_ / k, 0, 1), 1) for lost_, k in zip(lost, known, strict=True)]
    share = dr.select(found, mi.Color3f(*share), ratio)
    dr.eval(share)
    return share


def _blocked_part_of_noise(
    blocked: mi.Float, unshadowed: mi.Float, gbuffer: GBuffer, spacing: float
) -> tuple[mi.Float, mi.Bool]:
    """g of this module in [0, 1], and whether a pixel has neighbours to compute it from."""
    moments = [blocked, unshadowed, blocked * unshadowed, unshadowed * unshadowed]
    dr.eval(moments)
    (b, u, bu, uu), found = neighbourhood_mean(moments, gbuffer, spacing, own=False)
    variance = uu - u * u
    return dr.select(variance > 0, dr.clip((bu - b * u) / variance, 0, 1), 0), found


# A light as narrow as a sun casts hard shadows, and a thin object's shadow is a few pixels wide. But a pixel
# whose ray went to the sky does not sample the sun, and would say that all light arrives. So rays whose
# density of drawing the light exceeds ``NARROW`` per steradian are summed separately: a disc that sends all
# light has that density at 3 degrees' width. Their visibility is noisy only in penumbras; a pixel without
# such a ray uses its neighbours':
#
#     V = (s + e <s>) / (u + e <u>),   share of the light that is narrow = <u> / <all u>
#
# with s and u the sums of those rays with and without occlusion, <> means over 5 x 5 pixels, and e = 0.1.

NARROW = 500.0
"""Least density of narrow lights, per steradian; the benchmark's sun, of two degrees' radius, has 150."""
NEIGHBOURS = 0.1
STOP = 2.0


@dataclass
class NarrowSums:
    """Sums of luminance over rays to narrow lights, with and without occlusion, by pixel."""

    light: Light
    shadowed: mi.Float
    unshadowed: mi.Float

    @classmethod
    def none(cls, light: Light, lanes: int) -> NarrowSums:
        """No rays yet."""
        sums = cls(light, dr.zeros(mi.Float, lanes), dr.zeros(mi.Float, lanes))
        dr.make_opaque(sums.shadowed, sums.unshadowed)
        return sums

    def add(
        self, directions: Sequence[mi.Vector3f], light: Sequence[mi.Color3f], visible: Sequence[mi.Float]
    ) -> None:
        """Add rays: unit world directions, the linear light along them, and the share that arrives."""
        for direction, value, share in zip(directions, light, visible, strict=True):
            narrow = dr.select(self.light.pdf(direction) > NARROW, mi.luminance(value), 0)
            self.shadowed += narrow * share
            self.unshadowed += narrow
        dr.eval(self.shadowed, self.unshadowed)

    def detail(self, unshadowed: mi.Float, gbuffer: GBuffer, spacing: float) -> mi.Float:
        """The narrow lights' part of visibility, in [0, 1].

        Args:
            unshadowed: sums of luminance over all rays without occlusion.
            gbuffer, spacing: as in :func:`neighbourhood_mean`.
        """
        sums = [self.shadowed, self.unshadowed, unshadowed]
        dr.eval(sums)
        (s, u, every), _ = neighbourhood_mean(sums, gbuffer, spacing)
        weight = self.unshadowed + NEIGHBOURS * u
        there = weight > 0
        share = (self.shadowed + NEIGHBOURS * s) / dr.select(there, weight, 1)
        share = dr.select(there, dr.clip(share, 0, 1), 1)
        dr.eval(share)
        (smooth,), found = neighbourhood_mean([share], gbuffer, spacing, guide=share, stop=STOP)
        part = dr.select(every > 0, dr.clip(u / dr.select(every > 0, every, 1), 0, 1), 0)
        detail = part * dr.select(found, smooth, share)
        dr.eval(detail)
        return detail


# The shadowed and the unshadowed estimate are filtered with the same weights and their ratio is used: it has
# less noise but keeps the shading of curved surfaces (Heitz et al. 2018, "Combining Analytic Direct
# Illumination and Stochastic Shadows"), and over a neighbourhood's rays its bias is small.
#
# Weights computed from the noisy values themselves are biased by the noise, and without such weights light
# leaks into shadows. So weights use a guide: the share of light that arrives, smoothed by three small passes,
# the last of them guided by the result of the first two. Three passes of the filter follow, with taps 1, 2
# and 4 pixels apart; the farther they reach, the more alike the guide must be.
#
# Such a guide misses shadows a few pixels wide, and light would leak into them. So the narrow lights' part is
# subtracted from the guide before it is smoothed, and added again
# after. Under bars 0.04 wide and a sun of 1 degree, the deep shadow has 1.34, 1.20 and 1.10 of the reference
# at 2, 4 and 8 rays; on 20k surfels all shadows have 1.04 of it or less, with a third less noise.
# For many rays it would blur more than it denoises; they use :mod:`tron.shading.direct.noise`.

GUIDE_PASSES = ((1, 0.0), (1, 0.0), (2, 4.0))
"""Step in pixels and stop of each pass that smooths the guide; a stop is over the share of light, 0 to 1."""
FILTER_PASSES = ((1, 4.0), (2, 8.0), (4, 12.0))
FILTER_REACH = 2 * (1 + 1 + sum(step for step, _ in GUIDE_PASSES) + sum(step for step, _ in FILTER_PASSES))
"""Radius, in pixels, that filtered light depends on: two taps per pass of narrow lights, guide and filter."""


def atrous(
    shadowed: mi.Color3f,
    unshadowed: mi.Color3f,
    share: mi.Float,
    gbuffer: GBuffer,
    spacing: float,
    detail: mi.Float | float = 0.0,
) -> tuple[mi.Color3f, mi.Color3f]:
    """Filter both estimates of irradiance / pi with common weights; pixels of opacity 0 stay as they are.

    Args:
        shadowed, unshadowed: linear, from the same rays.
        share: share of the light that arrives, in [0, 1]; smoothed, it guides the weights.
        gbuffer: positions, unit normals and opacity of the same pixels.
        spacing: the scene's surfel spacing, world units.
        detail: part of the share that is known without noise and not to be smoothed in the guide.
    """
    share = share - detail
    dr.eval(share)
    for step, stop in GUIDE_PASSES:
        (smooth,), found = neighbourhood_mean([share], gbuffer, spacing, step=step, guide=share, stop=stop)
        share = dr.select(found, smooth, share)
        dr.eval(share)
    share += detail
    dr.eval(share)
    values = [*shadowed, *unshadowed]
    for step, stop in FILTER_PASSES:
        means, found = neighbourhood_mean(values, gbuffer, spacing, step=step, guide=share, stop=stop)
        values = [dr.select(found, mean, value) for mean, value in zip(means, values, strict=True)]
        dr.eval(values)
    return mi.Color3f(*values[:3]), mi.Color3f(*values[3:])
