"""Edge-avoiding a-trous filter (Dammertz et al. 2010) for irradiance of few rays, guided by the shadow.

The shadowed and the unshadowed estimate go through the same weights and their ratio is kept: it loses
noise but not the shading of curved surfaces (Heitz et al. 2018, "Combining Analytic Direct Illumination
and Stochastic Shadows"), and of a neighbourhood's rays it is not biased as it is of a pixel's few.

Weights that look at the noise they weigh choose by it, and without any the filter draws light into shadow.
So they look at a guide: the share of light that arrives by :mod:`tron.shading.few_rays`, itself smoothed
by three small passes, the last of them guided by what the first two left. Three passes of the filter
follow, taps 1, 2 and 4 pixels apart, and the farther they reach, the more alike the guide must be.

Measured at 128 x 128 on 20k surfels of a seed that no benchmark uses: mean over reference in shadowed
pixels, and RMSE over an upward plane's light, before (weights by the noisy visibility itself) and now:

    rays    sun: before     now             soft: before    now
    2       1.17  0.040     1.04  0.030     1.04  0.035     1.00  0.038
    4       1.17  0.037     1.04  0.025     1.07  0.028     1.03  0.028
    8       1.16  0.036     1.03  0.023     1.06  0.025     1.03  0.022

At 64 rays it blurs more than it cleans.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from tron.shading.neighbours import neighbourhood_mean

if TYPE_CHECKING:
    from tron.tracing import GBuffer

GUIDE_PASSES = ((1, 0.0), (1, 0.0), (2, 4.0))
"""Step in pixels and stop of each pass that smooths the guide; a stop is over the share of light, 0 to 1."""
FILTER_PASSES = ((1, 4.0), (2, 8.0), (4, 12.0))


def atrous(
    shadowed: mi.Color3f, unshadowed: mi.Color3f, share: mi.Float, gbuffer: GBuffer, spacing: float
) -> tuple[mi.Color3f, mi.Color3f]:
    """Filter both estimates of irradiance / pi with common weights; pixels of opacity 0 stay as they are.

    Args:
        shadowed, unshadowed: linear, from the same rays.
        share: of the light that arrives, in [0, 1], to be smoothed and guide the weights.
        gbuffer: positions, unit normals and opacity of the same pixels.
        spacing: the scene's surfel spacing, world units.
    """
    dr.eval(share)
    for step, stop in GUIDE_PASSES:
        (smooth,), found = neighbourhood_mean([share], gbuffer, spacing, step=step, guide=share, stop=stop)
        share = dr.select(found, smooth, share)
        dr.eval(share)
    values = [*shadowed, *unshadowed]
    for step, stop in FILTER_PASSES:
        means, found = neighbourhood_mean(values, gbuffer, spacing, step=step, guide=share, stop=stop)
        values = [dr.select(found, mean, value) for mean, value in zip(means, values, strict=True)]
        dr.eval(values)
    return mi.Color3f(*values[:3]), mi.Color3f(*values[3:])
