"""Mean over the neighbours in a pixel's 5 x 5 window that lie on its surface, by the G-buffer.

A neighbour's weight is the B-spline kernel (1 4 6 4 1), with taps ``step`` pixels apart (Dammertz et al.
2010), times a weight for the same surface: normals agree and the neighbour is near the pixel's plane. With a
guide, it is also multiplied by exp(-(stop x difference)^2) of the guide. Pixels with next to no neighbour on
their surface, such as leaves and wires, accept neighbours farther from it (``LOOSE``, ``ALONE``)."""

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
LOOSE, ALONE = 8.0, 12.0
"""Factor on that distance for pixels whose neighbours' total weight, of 220, is below the second number."""


def neighbourhood_mean(
    values: Sequence[mi.Float],
    gbuffer: GBuffer,
    spacing: float,
    *,
    step: int = 1,
    guide: mi.Float | None = None,
    stop: mi.Float | float = 0.0,
    own: bool = True,
) -> tuple[list[mi.Float], mi.Bool]:
    """Weighted means of ``values`` around each pixel, and whether a pixel had any neighbour to average.

    Args:
        values: of each of the G-buffer's lanes, evaluated.
        gbuffer: positions, unit normals and opacity of the same pixels; those of opacity 0 do not count.
        spacing: the scene's surfel spacing, world units.
        step: distance of the taps, pixels.
        guide: of each pixel; with ``stop``, in its inverse unit, one for all or for each pixel, unlike
            neighbours count less.
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
        stop if isinstance(stop, mi.Float) else dr.opaque(mi.Float, stop),
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

    def read(index: mi.UInt32, inside: mi.Bool) -> list[mi.Float]:
        return [dr.gather(mi.Float, value, index, inside) for value in values]

    def added(sums: list[mi.Float], w: mi.Float, read: list[mi.Float]) -> list[mi.Float]:
        return [total + w * value for total, value in zip(sums, read)]

    sums, weight = [mi.Float(0) for _ in values], mi.Float(0)
    loose_sums, loose_weight = [mi.Float(0) for _ in values], mi.Float(0)
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
        kernel = dr.select(inside, spline(dx) * spline(dy) * dr.exp(-unlike * unlike), 0)
        w = kernel * agreement**NORMAL_POWER * dr.exp(-off_plane * off_plane)
        far = off_plane / LOOSE
        loose = kernel * agreement * dr.exp(-far * far)
        there = read(index, inside)
        sums = added(sums, w, there)
        weight += w
        loose_sums = added(loose_sums, loose, there)
        loose_weight += loose
        tap += 1
    alone = weight < dr.select(own, 36.0 + ALONE, ALONE)
    alone &= loose_weight > weight
    weight = dr.select(alone, loose_weight, weight)
    found = weight > 0
    return _chosen(sums, loose_sums, alone, weight), found


def _chosen(
    strict: list[mi.Float], loose: list[mi.Float], alone: mi.Bool, weight: mi.Float
) -> list[mi.Float]:
    pairs = zip(strict, loose, strict=True)
    return [dr.select(weight > 0, dr.select(alone, b, a) / weight, 0) for a, b in pairs]
