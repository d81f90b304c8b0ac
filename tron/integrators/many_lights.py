"""``tron_many_lights``: one frame under many environment maps at once.

    property       type      meaning
    lights         object    environment maps: tron.integrators.embed([map, ...])
    max_depth      integer   longest path in segments, as in Mitsuba's ``path`` (default: 6)
    hide_emitters  boolean   leave out the light that is seen directly (default: false)
    first_rays     integer   shadow rays at the first hit of a path (default: as many as lights)
    later_rays     integer   shadow rays at each later hit (default: two fifths of first_rays)

Channels ``light0.R``, ``light0.G`` and so on are linear radiance under each light, in expectation equal to
``path``'s render of the scene under that light alone; the main channels are their mean. Emitters of the
Mitsuba scene are not seen.

Paths, hits and materials do not depend on the light, so all lights share them. At each hit, shadow rays go
where any of the lights is bright (:class:`StackedLights`), and each unblocked ray adds the radiance of all
lights: a ray's cost is paid once. They and the material's own sample, which adds the lights' radiance when it
leaves the scene, are weighted by the balance heuristic (Veach 1997), one weight for all lights:

    K rays of density q and one of density p:   L f cos / (K q + p)   for each of the K + 1

A bilinear map is a sum of texels, each a small light in the shape of a hat function: texel j sends radiance
hat_j(d) L_j from direction d, and the hats sum to one. So a light's sample is a texel and a direction within
its hat, and a direction from the material picks one of the four hats above it in proportion to their heights
(stochastic texture filtering, Fajardo et al. 2023). Either way one texel is read, in which all lights'
radiances lie side by side. hat_j is a factor of both density and radiance, so it cancels from every weight.

Texels are drawn from one distribution for all lights: proportional to the root of the sum of squares of the
lights' luminances, each divided by its mean. Among all densities q it minimises the sum over lights of the
integral of L^2 / q: suns at different places each keep a share, and smooth lights, which are alike, use the
same samples. It is inverted along a Hilbert curve through blocks of texels: stratified numbers stay near one
another on the sphere (Steigleder & McCool 2003), so each sun gets its number of samples almost exactly.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.color import luminance
from tron.errors import TronError
from tron.integrators.plugin import unwrap
from tron.runtime import aligned
from tron.shading.environments.environment import PDF_FLOOR, EnvironmentMap

NAME = "tron_many_lights"
MAX_DEPTH = 6
LATER_SHARE = 0.4
"""Ratio of shadow rays at later hits to those at the first: with 20 lights, 0.2 to 0.6 are equally good."""
BLOCK = 8
"""Texels along a side of the blocks that the Hilbert curve runs through."""
PACKET = 4
"""Numbers read by one gather."""
ONE_BELOW = float(np.nextafter(np.float32(1), np.float32(0)))


def many_lights_class() -> type:
    """The integrator for the active variant: Mitsuba's base classes differ between them."""

    class ManyLights(mi.SamplingIntegrator):
        def __init__(self, properties: mi.Properties) -> None:
            super().__init__(properties)
            carried = unwrap(properties, "lights", list, NAME)
            if not all(isinstance(light, EnvironmentMap) for light in carried):
                raise TronError(
                    f"property 'lights' of {NAME} holds no environment maps",
                    mend="give tron.integrators.embed([EnvironmentMap, ...])",
                )
            self.lights = StackedLights(carried)
            self.max_depth = properties.get("max_depth", MAX_DEPTH)
            self.hides = properties.get("hide_emitters", False)
            first = properties.get("first_rays", self.lights.count)
            rays = [first, properties.get("later_rays", math.ceil(LATER_SHARE * first))]
            if self.max_depth < 1 or min(rays) < 1:
                raise TronError(f"{NAME} has no path or no shadow ray", mend="give numbers of 1 or more")
            # Opaque, so that all numbers of rays and bounces share one kernel.
            self._depth = dr.opaque(mi.UInt32, self.max_depth)
            self._rays = [dr.opaque(mi.UInt32, number) for number in rays]

        def sample(
            self,
            scene: mi.Scene,
            sampler: mi.Sampler,
            ray: mi.RayDifferential3f,
            medium: mi.Medium | None = None,
            active: mi.Bool | bool = True,
        ) -> tuple[mi.Color3f, mi.Bool, list[mi.Float]]:
            """Mitsuba's contract: mean radiance along rays, whether they hit, radiance under each light."""
            del medium
            colors, hit = trace(
                scene, sampler, ray, self.lights, self._depth, self._rays, self.hides, mi.Bool(active)
            )
            mean = sum(colors[1:], colors[0]) / len(colors)
            return mean, hit if self.hides else mi.Bool(active), [part for color in colors for part in color]

        def aov_names(self) -> list[str]:
            return [f"light{k}.{part}" for k in range(self.lights.count) for part in "RGB"]

        def to_string(self) -> str:
            return f"{NAME}[lights={self.lights.count}, max_depth={self.max_depth}]"

    return ManyLights


@dr.syntax
def trace(
    scene: mi.Scene,
    sampler: mi.Sampler,
    ray: mi.Ray3f,
    lights: StackedLights,
    max_depth: mi.UInt32,
    rays: list[mi.UInt32],
    hides: bool,
    active: Any,
) -> tuple[list[mi.Color3f], mi.Bool]:
    """Radiance under every light along camera rays, and whether they hit.

    Args:
        scene: its shapes; emitters are not seen.
        sampler: of a wavefront as wide as ``ray``.
        ray: from a sensor.
        lights: the environments.
        max_depth: longest path, segments.
        rays: shadow rays at the first hit and at later ones.
        hides: leave out light that is seen directly.
        active: lanes to trace.
    """
    context = mi.BSDFContext()
    si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=True, active=active)
    hit = active & si.is_valid()
    if dr.hint(hides, mode="scalar"):
        total = [mi.Color3f(0) for _ in range(lights.count)]
    else:
        total = lights.background(ray.d, active & ~hit)
    throughput = mi.Color3f(1)
    depth = mi.UInt32(1)
    active = hit & (depth < max_depth)
    while active:
        bsdf = si.bsdf()
        count = dr.select(depth == 1, rays[0], rays[1])
        number = mi.Float(count)

        k = mi.UInt32(0)
        while k < count:
            along = (mi.Float(k) + sampler.next_1d()) / number
            light = lights.sample(along, sampler.next_2d(), active)
            value, pdf = bsdf.eval_pdf(context, si, si.to_local(light.direction), active)
            value *= throughput
            wanted = active & (dr.max(value) > 0)
            weight = dr.select(wanted, value / (number * light.density + pdf), 0)
            open_ = wanted & ~scene.ray_test(si.spawn_ray(light.direction), wanted)
            total = lights.add(total, light.index, weight, open_)
            k += 1

        drawn, weight = bsdf.sample(context, si, sampler.next_1d(), sampler.next_2d(), active)
        throughput *= weight
        active &= dr.max(throughput) > 0
        onward = si.spawn_ray(si.to_world(drawn.wo))
        si = scene.ray_intersect(onward, mi.RayFlags.All, coherent=False, active=active)
        away = active & ~si.is_valid()
        texel = lights.seen(onward.d, sampler.next_1d(), away)
        delta = mi.has_flag(drawn.sampled_type, mi.BSDFFlags.Delta)
        mis = dr.select(delta, 1, drawn.pdf / (drawn.pdf + number * texel.density))
        total = lights.add(total, texel.index, dr.select(away, throughput * mis, 0), away)
        depth += 1
        active &= si.is_valid() & (depth < max_depth)
    return total, hit


class Texel(NamedTuple):
    """A sampled texel and a direction within its hat, one lane each.

    Attributes:
        direction: unit, world.
        index: of the texel, row-major.
        density: of drawing this texel and direction, per steradian, divided by the texel's hat.
    """

    direction: mi.Vector3f
    index: mi.UInt32
    density: mi.Float


class StackedLights:
    """Environment maps of one size, their rotations baked in.

    Args:
        environments: at least one; all of the same (H, W).

    Raises:
        TronError: there is none, sizes differ, or a map is rotated (``EnvironmentMap.baked`` mends that).
    """

    def __init__(self, environments: Sequence[EnvironmentMap]) -> None:
        if not environments:
            raise TronError("there is no light to trace", mend="give at least one environment map")
        sizes = {environment.image.shape[:2] for environment in environments}
        if len(sizes) > 1:
            wide = " and ".join(f"{width} x {height}" for height, width in sorted(sizes))
            raise TronError(
                f"environment maps traced together have sizes {wide}", mend="resize them to one size"
            )
        if any(environment.rotation_deg for environment in environments):
            raise TronError(
                "an environment map traced with others is turned", mend="give environment.baked()"
            )
        self.count = len(environments)
        images = np.stack([environment.image for environment in environments])
        _, height, width, _ = images.shape
        # Opaque numbers: lights of all sizes must share one compiled kernel.
        self._width, self._height = dr.opaque(mi.UInt32, width), dr.opaque(mi.UInt32, height)
        self._column, self._row = (
            dr.opaque(mi.Float, 2 * math.pi / width),
            dr.opaque(mi.Float, math.pi / (height - 1)),
        )
        # Half of the hat of a texel on a pole lies beyond the pole.
        area = np.full((height, 1), 2 * math.pi / width * math.pi / (height - 1))
        area[[0, -1]] /= 2
        mass = _mass(images, environments[0].solid_angles())
        mass = self._prepare_blocks(mass)
        records = -(-(1 + 3 * self.count) // PACKET) * PACKET
        texels = np.zeros((height * width, records), np.float32)
        texels[:, 0] = (mass / area).ravel()
        texels[:, 1 : 1 + 3 * self.count] = images.transpose(1, 2, 0, 3).reshape(height * width, -1)
        self._packets = records // PACKET
        self._texels = mi.Float(aligned(texels.ravel()))

    def _prepare_blocks(self, mass: np.ndarray) -> np.ndarray:
        """Lay out the distribution; return its actual probabilities (H, W) after rounding."""
        height, width = mass.shape
        rows, columns = -(-height // BLOCK), -(-width // BLOCK)
        padded = np.zeros((rows * BLOCK, columns * BLOCK))
        padded[:height, :width] = mass
        blocks = padded.reshape(rows, BLOCK, columns, BLOCK).transpose(0, 2, 1, 3)
        place = hilbert_order(rows, columns)
        blocks = blocks[place[:, 0], place[:, 1]]
        bounds = np.cumsum(blocks.sum(axis=(1, 2)))
        bounds = np.concatenate([[0.0], bounds / bounds[-1]]).astype(np.float32)
        # For bisection, padded to a power of two by a value above every number.
        size = 1 << (len(blocks) - 1).bit_length()
        self._steps = [size >> k for k in range(1, size.bit_length())]
        lower = np.concatenate([bounds[:-1], np.full(size - len(blocks), 2.0, np.float32)])
        by_row = _cumulative(blocks.sum(axis=2))
        by_column = _cumulative(blocks)
        self._bounds = mi.Float(aligned(lower))
        self._corner = mi.UInt32(aligned((place * BLOCK).astype(np.uint32).ravel()))
        self._by_row = mi.Float(aligned(by_row.ravel()))
        self._by_column = mi.Float(aligned(by_column.ravel()))
        exact = np.diff(bounds.astype(np.float64))[:, None, None] * (
            np.diff(by_row.astype(np.float64), axis=-1, prepend=0)[..., None]
            * np.diff(by_column.astype(np.float64), axis=-1, prepend=0)
        )
        back = np.zeros((rows, columns, BLOCK, BLOCK))
        back[place[:, 0], place[:, 1]] = exact
        return back.transpose(0, 2, 1, 3).reshape(padded.shape)[:height, :width]

    def sample(self, along: mi.Float, u: mi.Point2f, active: mi.Bool) -> Texel:
        """Draw texels, and directions within their hats.

        Args:
            along: place on the curve, uniform in [0, 1): stratify it.
            u: uniform in [0, 1)^2.
            active: lanes to sample.
        """
        block = mi.UInt32(0)
        for step in self._steps:
            low = dr.gather(mi.Float, self._bounds, block + step, active)
            block = dr.select(low <= along, block + step, block)
        corner = dr.gather(mi.Point2u, self._corner, block, active)
        row, v = _invert(self._by_row, block, u.y, active)
        column, h = _invert(self._by_column, block * BLOCK + row, u.x, active)
        row, column = corner.x + row, corner.y + column
        offset = mi.warp.square_to_tent(mi.Point2f(h, v))
        polar = dr.abs(mi.Float(row) + offset.y)
        last = mi.Float(self._height - 1)
        polar = dr.select(polar > last, 2 * last - polar, polar) * self._row
        sin_p, cos_p = dr.sincos(polar)
        sin_a, cos_a = dr.sincos((mi.Float(column) + 0.5 + offset.x) * self._column)
        direction = mi.Vector3f(sin_p * sin_a, sin_p * cos_a, cos_p)
        return self._texel(direction, row, column, active)

    def seen(self, direction: mi.Vector3f, u: mi.Float, active: mi.Bool) -> Texel:
        """Pick one of the four hats above unit world directions; ``u`` is uniform in [0, 1)."""
        row, column, fy, fx = self._cell(direction)
        right = u < fx
        u = dr.select(right, u / fx, (u - fx) / (1 - fx))
        row, column = self._corner_of(row, column, u < fy, right)
        return self._texel(direction, row, column, active)

    def background(self, direction: mi.Vector3f, active: mi.Bool) -> list[mi.Color3f]:
        """Bilinear radiance of every light along unit world directions, free of noise."""
        row, column, fy, fx = self._cell(direction)
        total = [mi.Color3f(0) for _ in range(self.count)]
        for lower in (False, True):
            for right in (False, True):
                weight = (fy if lower else 1 - fy) * (fx if right else 1 - fx)
                i, j = self._corner_of(row, column, mi.Bool(lower), mi.Bool(right))
                total = self.add(total, i * self._width + j, mi.Color3f(weight), active)
        return total

    def add(
        self, total: list[mi.Color3f], index: mi.UInt32, weight: mi.Color3f, active: mi.Bool
    ) -> list[mi.Color3f]:
        """Add ``weight`` times every light's radiance at a texel to its ``total``."""
        numbers = []
        for k in range(self._packets):
            packet = dr.gather(mi.Vector4f, self._texels, index * self._packets + k, active)
            numbers += list(packet)
        return [color + weight * mi.Color3f(*numbers[1 + 3 * k : 4 + 3 * k]) for k, color in enumerate(total)]

    def _texel(self, direction: mi.Vector3f, row: mi.UInt32, column: mi.UInt32, active: mi.Bool) -> Texel:
        index = row * self._width + column
        density = dr.gather(mi.Float, self._texels, index * (self._packets * PACKET), active)
        # d(solid angle) = sin(polar) d(polar) d(azimuth)
        sine = dr.sqrt(direction.x * direction.x + direction.y * direction.y)
        return Texel(direction, index, density / dr.maximum(sine, 1e-7))

    def _cell(self, d: mi.Vector3f) -> tuple[mi.UInt32, mi.UInt32, mi.Float, mi.Float]:
        """Upper left of the four texels around a direction, and the direction's place between them."""
        around = dr.atan2(d.x, d.y) * (0.5 / math.pi)
        x = (around - dr.floor(around)) * mi.Float(self._width) - 0.5
        y = dr.atan2(dr.sqrt(d.x * d.x + d.y * d.y), d.z) / self._row
        left = mi.Int(dr.floor(x))
        fx = x - mi.Float(left)
        column = dr.select(left < 0, self._width - 1, mi.UInt32(left))
        row = dr.minimum(mi.UInt32(y), self._height - 2)
        return row, column, y - mi.Float(row), fx

    def _corner_of(
        self, row: mi.UInt32, column: mi.UInt32, lower: mi.Bool, right: mi.Bool
    ) -> tuple[mi.UInt32, mi.UInt32]:
        column = dr.select(right, column + 1, column)
        return dr.select(lower, row + 1, row), dr.select(column >= self._width, 0, column)


def _mass(images: np.ndarray, solid_angles: np.ndarray) -> np.ndarray:
    """(H, W) probability of each texel, from (N, H, W, 3) radiance and (H,) solid angles of hats."""
    brightness = np.asarray(luminance(images), np.float64)
    area = np.broadcast_to(solid_angles[:, None], brightness.shape[1:])
    mean = (brightness * area).sum(axis=(1, 2), keepdims=True) / area.sum()
    lit = np.where(mean > 0, brightness / np.where(mean > 0, mean, 1.0), 1.0)
    density = np.sqrt((lit**2).sum(axis=0))
    density = np.maximum(density, PDF_FLOOR * (density * area).sum() / area.sum())
    return density * area / (density * area).sum()


def hilbert_order(rows: int, columns: int) -> np.ndarray:
    """(rows * columns, 2) row and column of each cell of a grid, in the order of a Hilbert curve.

    The curve fills the smallest power-of-two square around the grid; cells outside the grid are skipped.
    """
    x, y = (part.ravel() for part in np.meshgrid(np.arange(columns), np.arange(rows)))
    place = np.stack([y, x], axis=1)
    side = 1 << max(rows - 1, columns - 1, 1).bit_length()
    distance = np.zeros_like(x)
    size = side // 2
    while size:
        right, upper = (x & size) > 0, (y & size) > 0
        distance += size * size * ((3 * right) ^ upper)
        flipped = right & ~upper
        x, y = np.where(flipped, side - 1 - x, x), np.where(flipped, side - 1 - y, y)
        x, y = np.where(upper, x, y), np.where(upper, y, x)
        size //= 2
    return place[np.argsort(distance, kind="stable")]


def _cumulative(mass: np.ndarray) -> np.ndarray:
    """Cumulative distribution along the last axis, float32, ending at 1; all 1 if the sum is 0."""
    total = mass.sum(axis=-1, keepdims=True)
    bounds = np.cumsum(mass, axis=-1) / np.where(total > 0, total, 1.0)
    bounds = np.where(total > 0, bounds, 1.0).astype(np.float32)
    # Texels after the last one with weight, such as a block's padding, begin at 1.
    return np.where(bounds >= bounds[..., -1:], np.float32(1.0), bounds)


def _invert(bounds: mi.Float, group: mi.UInt32, u: mi.Float, active: mi.Bool) -> tuple[mi.UInt32, mi.Float]:
    """Index within each ``group`` of BLOCK that ``u`` falls on, and ``u`` rescaled to [0, 1) within it."""
    member, low, high = mi.UInt32(0), mi.Float(0), mi.Float(1)
    for half in range(BLOCK // PACKET):
        packet = dr.gather(mi.Vector4f, bounds, group * (BLOCK // PACKET) + half, active)
        for bound in packet:
            above = u >= bound
            member = dr.select(above, member + 1, member)
            low = dr.select(above, bound, low)
            high = dr.select(above, high, dr.minimum(high, bound))
    return dr.minimum(member, BLOCK - 1), dr.clip((u - low) / dr.maximum(high - low, 1e-12), 0, ONE_BELOW)
