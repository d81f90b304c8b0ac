"""Edge-avoiding a-trous filter (Dammertz et al. 2010) for irradiance of few rays, guided by the G-buffer.

Three passes of the 5 x 5 B-spline kernel, its taps 1, 2 and 4 pixels apart. A tap counts as far as it lies
on the same surface: its normal agrees and it is near the pixel's plane; after the first pass, which sees
raw noise, also as far as its visibility is similar. The shadowed and the unshadowed estimate go through the
same weights: guidance keeps their ratio, which then loses noise but not the shading of curved surfaces
(Heitz et al. 2018, "Combining Analytic Direct Illumination and Stochastic Shadows").

Measured on 20k surfels at 256 x 256 and 2 rays a pixel, relative RMSE of irradiance: sun 0.32 -> 0.05, studio
0.37 -> 0.07, overcast 0.31 -> 0.05. At 64 rays it blurs more than it cleans.
"""

# pyright: reportOperatorIssue=false, reportArgumentType=false, reportCallIssue=false, reportReturnType=false
# (Mitsuba's type stubs know neither arithmetic between its own array types nor its aliases of Dr.Jit's.)

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from tron.color import LUMINANCE

if TYPE_CHECKING:
    from tron.tracing import GBuffer

VISIBILITY_STOPS = (0.0, 1.0, 2.0)
"""One pass each: a tap's weight falls by e when log visibility differs by the inverse of this."""
NORMAL_POWER = 32
PLANE_SPACINGS = 1.0
"""Distance from the pixel's plane, in surfel spacings, at which a tap's weight has fallen by e."""
DARKEST = 0.05
"""Visibilities below this count as equally dark."""


def atrous(
    shadowed: mi.Color3f, unshadowed: mi.Color3f, gbuffer: GBuffer, spacing: float
) -> tuple[mi.Color3f, mi.Color3f]:
    """Filter both estimates of irradiance / pi with common weights; pixels of opacity 0 stay as they are.

    Args:
        shadowed, unshadowed: linear, row-major, from the same rays.
        gbuffer: positions, unit normals and opacity of the same pixels.
        spacing: the scene's surfel spacing, world units.
    """
    for step, stop in enumerate(VISIBILITY_STOPS):
        shadowed, unshadowed = _pass(
            shadowed,
            unshadowed,
            gbuffer,
            dr.opaque(mi.Int, 1 << step),
            dr.opaque(mi.Float, PLANE_SPACINGS * spacing),
            dr.opaque(mi.Float, stop),
        )
        dr.eval(shadowed, unshadowed)
    return shadowed, unshadowed


def _log_visibility(shadowed: mi.Color3f, unshadowed: mi.Color3f) -> mi.Float:
    grey = mi.Color3f(LUMINANCE)
    light = dr.maximum(dr.dot(unshadowed, grey), 1e-12)
    return dr.log(dr.dot(shadowed, grey) / light + DARKEST)


@dr.syntax
def _pass(
    shadowed: mi.Color3f,
    unshadowed: mi.Color3f,
    gbuffer: GBuffer,
    step: mi.Int,
    plane: mi.Float,
    stop: mi.Float,
) -> tuple[mi.Color3f, mi.Color3f]:
    width, height = dr.opaque(mi.Int, gbuffer.width), dr.opaque(mi.Int, gbuffer.height)
    position, normal, surface = gbuffer.position, gbuffer.normal, gbuffer.opacity > 0
    lane = mi.Int(dr.arange(mi.UInt32, gbuffer.width * gbuffer.height))
    x, y = lane % width, lane // width
    own = _log_visibility(shadowed, unshadowed)

    def at(value: mi.Color3f, index: mi.UInt32, inside: mi.Bool) -> mi.Color3f:
        return type(value)(*[dr.gather(mi.Float, channel, index, inside) for channel in value])

    def spline(offset: mi.Int) -> mi.Float:
        return dr.select(offset == 0, 6.0, dr.select(dr.abs(offset) == 1, 4.0, 1.0))

    sum_shadowed, sum_unshadowed, weight = mi.Color3f(0), mi.Color3f(0), mi.Float(0)
    tap = mi.Int(0)
    while tap < 25:
        dx, dy = tap % 5 - 2, tap // 5 - 2
        tap_x, tap_y = x + dx * step, y + dy * step
        inside = surface & (tap_x >= 0) & (tap_x < width) & (tap_y >= 0) & (tap_y < height)
        index = mi.UInt32(tap_y * width + tap_x)
        inside &= dr.gather(mi.Bool, surface, index, inside)
        tap_shadowed, tap_unshadowed = at(shadowed, index, inside), at(unshadowed, index, inside)
        agreement = dr.maximum(dr.dot(normal, at(normal, index, inside)), 0)
        off_plane = dr.dot(normal, at(position, index, inside) - position) / plane
        unlike = stop * dr.abs(_log_visibility(tap_shadowed, tap_unshadowed) - own)
        w = spline(dx) * spline(dy) * agreement**NORMAL_POWER * dr.exp(-off_plane * off_plane - unlike)
        w = dr.select(inside, w, 0)
        sum_shadowed += w * tap_shadowed
        sum_unshadowed += w * tap_unshadowed
        weight += w
        tap += 1
    scale = dr.select(weight > 0, dr.rcp(weight), 0)
    return (
        dr.select(weight > 0, sum_shadowed * scale, shadowed),
        dr.select(weight > 0, sum_unshadowed * scale, unshadowed),
    )
