"""Mean of a pixel's 5 x 5 neighbourhood over those that lie on its surface, by the G-buffer.

A neighbour's weight is the B-spline kernel's (1 4 6 4 1), its taps ``step`` pixels apart (Dammertz et al.
2010), times how far it lies on the same surface: its normal agrees and it is near the pixel's plane; on
request also how alike a guide is there: exp(-(stop x difference)^2)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from tron.tracing.tiled.tiles import lane_at, tile_counts

if TYPE_CHECKING:
    from tron.tracing import GBuffer

NORMAL_POWER = 32
PLANE_SPACINGS = 1.0
"""Distance from the pixel's plane, in surfel spacings, at which a neighbour's weight has fallen by e."""


def neighbourhood_mean(
    values: Sequence[mi.Float],
    gbuffer: GBuffer,
    spacing: float,
    *,
    step: int = 1,
    guide: mi.Float | None = None,
    stop: float = 0.0,
    own: bool = True,
) -> tuple[list[mi.Float], mi.Bool]:
    """Weighted means of ``values`` about each pixel, and where there was anything to average.

    Args:
        values: of each of the G-buffer's lanes, evaluated.
        gbuffer: positions, unit normals and opacity of the same pixels; those of opacity 0 do not count.
        spacing: the scene's surfel spacing, world units.
        step: distance of the taps, pixels.
        guide: of each pixel; with ``stop``, in its inverse unit, unlike neighbours count less.
        own: whether the pixel itself counts.

    Returns:
        the means, 0 where nothing counts, and whether something does.
    """
    if guide is None:
        guide = dr.zeros(mi.Float, dr.width(gbuffer.opacity))
    means, found = _means(
        list(values),
        guide,
        gbuffer,
        dr.opaque(mi.Int, step),
        dr.opaque(mi.Float, PLANE_SPACINGS * spacing),
        dr.opaque(mi.Float, stop),
        dr.opaque(mi.Bool, own),
    )
    dr.eval(means, found)
    return means, found


@dr.syntax
def _means(
    values: list[mi.Float],
    guide: mi.Float,
    gbuffer: GBuffer,
    step: mi.Int,
    plane: mi.Float,
    stop: mi.Float,
    own: mi.Bool,
) -> tuple[list[mi.Float], mi.Bool]:
    width, height = dr.opaque(mi.Int, gbuffer.width), dr.opaque(mi.Int, gbuffer.height)
    across = dr.opaque(mi.UInt32, tile_counts(gbuffer.width, gbuffer.height)[0])
    position, normal, surface = gbuffer.position, gbuffer.normal, gbuffer.opacity > 0
    pixel = mi.Int(gbuffer.pixel)
    x, y = pixel % width, pixel // width

    def at(value: mi.Color3f, index: mi.UInt32, inside: mi.Bool) -> mi.Color3f:
        return type(value)(*[dr.gather(mi.Float, channel, index, inside) for channel in value])

    def spline(offset: mi.Int) -> mi.Float:
        return dr.select(offset == 0, 6.0, dr.select(dr.abs(offset) == 1, 4.0, 1.0))

    def added(sums: list[mi.Float], w: mi.Float, index: mi.UInt32, inside: mi.Bool) -> list[mi.Float]:
        return [total + w * dr.gather(mi.Float, v, index, inside) for total, v in zip(sums, values)]

    sums, weight = [mi.Float(0) for _ in values], mi.Float(0)
    tap = mi.Int(0)
    while tap < 25:
        dx, dy = tap % 5 - 2, tap // 5 - 2
        tap_x, tap_y = x + dx * step, y + dy * step
        inside = surface & (tap_x >= 0) & (tap_x < width) & (tap_y >= 0) & (tap_y < height)
        inside &= own | (tap != 12)
        index = lane_at(mi.UInt32(tap_x), mi.UInt32(tap_y), across)
        inside &= dr.gather(mi.Bool, surface, index, inside)
        agreement = dr.maximum(dr.dot(normal, at(normal, index, inside)), 0)
        off_plane = dr.dot(normal, at(position, index, inside) - position) / plane
        unlike = stop * (dr.gather(mi.Float, guide, index, inside) - guide)
        w = spline(dx) * spline(dy) * agreement**NORMAL_POWER
        w = dr.select(inside, w * dr.exp(-off_plane * off_plane - unlike * unlike), 0)
        sums = added(sums, w, index, inside)
        weight += w
        tap += 1
    found = weight > 0
    return [dr.select(found, total / weight, 0) for total in sums], found
