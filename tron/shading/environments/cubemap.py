"""The cubemap: radiance on six square faces, used to fit and filter a light.

Faces are +x, -x, +y, -y, +z, -z; u and v in [-1, 1] run along the next two axes in cyclic order (for +-x: y
and z; +-y: z and x; +-z: x and y). Texels are centred, so beside an edge a bilinear lookup needs texels of
the next face. Each face therefore carries a border of one texel: across an edge it is the neighbour's texel
at the same place along the edge, at the cube's eight corners the mean of the three texels that meet there.
Both faces then compute the same value all along their edge: radiance is continuous on the sphere.

Everything here is differentiable with respect to the texels, except the sampling density, which is a choice
and not a result.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.color import LUMINANCE
from tron.errors import TronError
from tron.shading.environments.environment import PDF_FLOOR, EnvironmentMap

BELOW_ONE = 1 - 2**-24


def face_direction(face: mi.UInt32, u: mi.Float, v: mi.Float) -> mi.Vector3f:
    """Unit world direction of a point on a cube face; (u, v) outside [-1, 1] extend the face's plane."""
    return dr.normalize(_face_point(face, u, v, mi.Float(1)))


def direction_face(d: mi.Vector3f) -> tuple[mi.UInt32, mi.Float, mi.Float]:
    """The inverse of :func:`face_direction`: face and (u, v) in [-1, 1] of directions ``d`` (any length)."""
    a = dr.abs(d)
    on_x = (a.x >= a.y) & (a.x >= a.z)
    on_y = ~on_x & (a.y >= a.z)
    major = dr.select(on_x, d.x, dr.select(on_y, d.y, d.z))
    u = dr.select(on_x, d.y, dr.select(on_y, d.z, d.x))
    v = dr.select(on_x, d.z, dr.select(on_y, d.x, d.y))
    face = dr.select(on_x, mi.UInt32(0), dr.select(on_y, mi.UInt32(2), mi.UInt32(4)))
    scale = dr.rcp(dr.abs(major))
    return face + dr.select(major < 0, mi.UInt32(1), 0), u * scale, v * scale


def bilinear(texels: mi.Float, first: mi.UInt32, resolution: mi.UInt32, d: mi.Vector3f) -> mi.Color3f:
    """Bilinear lookup in directions ``d`` (any length) in a cubemap with borders.

    Args:
        texels: r, g, b, 0 of texels in order of face, row (v), column (u); faces are resolution + 2 wide.
        first: index of the cubemap's first texel in ``texels``, which may hold several.
        resolution: texels along a face edge, border not counted.
    """
    face, u, v = direction_face(d)
    half = 0.5 * mi.Float(resolution)
    x, y = u * half + half + 0.5, v * half + half + 0.5
    column, row = mi.UInt32(x), mi.UInt32(y)
    column = dr.select(column > resolution, resolution, column)
    row = dr.select(row > resolution, resolution, row)
    width = resolution + 2
    corner = first + (face * width + row) * width + column

    def texel(index: mi.UInt32) -> mi.Vector4f:
        return dr.gather(mi.Vector4f, texels, index)

    fx, fy = x - mi.Float(column), y - mi.Float(row)
    upper = dr.lerp(texel(corner), texel(corner + 1), fx)
    lower = dr.lerp(texel(corner + width), texel(corner + width + 1), fx)
    value = dr.lerp(upper, lower, fy)
    return mi.Color3f(value.x, value.y, value.z)


def seamless(texels: mi.Float, resolution: int, d: mi.Vector3f) -> mi.Color3f:
    """Bilinear lookup in directions ``d`` of any three channels on a cubemap without borders, differentiable.

    Args:
        texels: channels of texels in order of face, row (v), column (u), 18 resolution^2 numbers.
        resolution: texels along a face edge.
    """
    first, width = dr.opaque(mi.UInt32, 0), dr.opaque(mi.UInt32, resolution)
    return bilinear(_bordered(texels, resolution), first, width, d)


def texel_directions(resolution: int) -> mi.Vector3f:
    """Unit world directions of the centres of 6 resolution^2 texels, in order of face, row, column."""
    width = dr.opaque(mi.UInt32, resolution)
    lane = dr.arange(mi.UInt32, 6 * resolution**2)
    step = 2 / mi.Float(width)
    u = (mi.Float(lane % width) + 0.5) * step - 1
    v = (mi.Float((lane // width) % width) + 0.5) * step - 1
    return face_direction(lane // (width * width), u, v)


class CubemapLight:
    """A cubemap on the device: radiance, importance sampling, and its density.

    A texel is drawn in proportion to its mean bilinear luminance times its solid angle, floored at
    ``PDF_FLOOR`` of the mean; inside it the point is uniform in (u, v). Make a new light after each change
    of the texels: that rebuilds the borders and the distribution, in time linear in the texels.

    Args:
        texels: linear radiance, not negative: r, g, b of texels in order of face, row (v), column (u), so
            3 x 6 x resolution^2 numbers. Gradients flow into it from :meth:`radiance`.
        resolution: texels along a face edge.

    Raises:
        TronError: the number of texels is not that of the resolution, or the resolution is below 2.
    """

    def __init__(self, texels: mi.Float, resolution: int) -> None:
        if resolution < 2 or dr.width(texels) != 18 * resolution**2:
            raise TronError(
                f"{dr.width(texels)} numbers are no cubemap of {resolution} texels a face edge",
                mend="give 18 resolution^2 numbers, resolution at least 2",
            )
        self.texels, self.resolution = texels, resolution
        self._bordered = _bordered(texels, resolution)
        # Not on demand: it is first needed inside a symbolic loop, where nothing can be evaluated.
        self._distribution = _RowsAndColumns(dr.detach(self._bordered), resolution)
        self._width, self._first = dr.opaque(mi.UInt32, resolution), dr.opaque(mi.UInt32, 0)

    @property
    def face_resolution(self) -> int:
        """Texels along a quarter of the horizon."""
        return self.resolution

    def numpy(self) -> np.ndarray:
        """(6, R, R, 3) float32 texels: face, row (v), column (u)."""
        return np.array(self.texels).reshape(6, self.resolution, self.resolution, 3)

    def radiance(self, d: mi.Vector3f) -> mi.Color3f:
        """Bilinear lookup: linear radiance arriving from unit world directions ``d``."""
        return bilinear(self._bordered, self._first, self._width, d)

    def sample(self, u: mi.Point2f, active: Any = True) -> tuple[mi.Vector3f, mi.Float]:
        """Unit world directions and their densities (per steradian) from uniform ``u`` in [0, 1)^2."""
        row, in_row = self._distribution.row(u.y, active)
        column, in_column = self._distribution.column(row, u.x, active)
        face, row_in_face = row // self._width, row % self._width
        step = 2 / mi.Float(self._width)
        x = (mi.Float(column) + in_column) * step - 1
        y = (mi.Float(row_in_face) + in_row) * step - 1
        density = self._distribution.density(row * self._width + column, active)
        return face_direction(face, x, y), density * _stretch(x, y)

    def pdf(self, d: mi.Vector3f) -> mi.Float:
        """Density (per steradian) with which :meth:`sample` draws unit world directions ``d``."""
        face, u, v = direction_face(d)
        half = 0.5 * mi.Float(self._width)
        column, row = mi.UInt32((u + 1) * half), mi.UInt32((v + 1) * half)
        column = dr.select(column < self._width, column, self._width - 1)
        row = dr.select(row < self._width, row, self._width - 1)
        texel = (face * self._width + row) * self._width + column
        return self._distribution.density(texel, True) * _stretch(u, v)

    def to_environment(self, height: int | None = None) -> EnvironmentMap:
        """The lat-long map of this light, each texel an average over its own solid angle.

        ``height`` is 2 x resolution if not given: as many texels around the horizon as the cubemap has.
        """
        height = max(4, 2 * self.resolution if height is None else height)
        samples = int(np.clip(np.ceil(3 * self.resolution / height), 3, 16))
        rgb = _lat_long_means(self, dr.opaque(mi.UInt32, height), dr.opaque(mi.UInt32, samples), height)
        image = np.array(rgb).T.reshape(height, 2 * height, 3)
        return EnvironmentMap(np.maximum(image, 0))


class _RowsAndColumns:
    """A texel in two steps: its row among the 6 R of all faces, then its column. All of it on the device."""

    def __init__(self, bordered: mi.Float, resolution: int) -> None:
        self._rows, self._columns = 6 * resolution, resolution
        self._width = width = dr.opaque(mi.UInt32, resolution)
        lane = dr.arange(mi.UInt32, 6 * resolution**2)
        column, row = lane % width, lane // width
        corner = (row + 2 * (row // width)) * (width + 2) + column
        # Mean over a texel of the bilinear function: 1/8, 6/8, 1/8 along either axis.
        brightness = mi.Float(0)
        for y, above in enumerate((1.0, 6.0, 1.0)):
            for x, left in enumerate((1.0, 6.0, 1.0)):
                texel = dr.gather(mi.Vector4f, bordered, corner + y * (width + 2) + x)
                grey = LUMINANCE[0] * texel.x + LUMINANCE[1] * texel.y + LUMINANCE[2] * texel.z
                brightness += (above * left / 64) * grey
        step = 2 / mi.Float(width)
        u = (mi.Float(column) + 0.5) * step - 1
        v = (mi.Float(row % width) + 0.5) * step - 1
        solid = step * step / _stretch(u, v)
        mean = dr.sum(brightness * solid) * float(1 / (4 * np.pi))
        floor = dr.select(mean > 0, PDF_FLOOR * mean, 1)
        mass = dr.select(brightness > floor, brightness, floor) * solid
        self._within = dr.block_prefix_sum(mass, resolution, exclusive=False)
        self._up_to = dr.cumsum(dr.block_sum(mass, resolution))
        self._total = dr.gather(mi.Float, self._up_to, dr.opaque(mi.UInt32, self._rows - 1))
        self._density = mass / (self._total * step * step)
        dr.eval(self._within, self._up_to, self._total, self._density)

    def density(self, texel: mi.UInt32, active: Any) -> mi.Float:
        """Density in (u, v) at a texel."""
        return dr.gather(mi.Float, self._density, texel, active)

    def row(self, u: mi.Float, active: Any) -> tuple[mi.UInt32, mi.Float]:
        return self._find(self._up_to, mi.UInt32(0), self._rows, u * self._total, active)

    def column(self, row: mi.UInt32, u: mi.Float, active: Any) -> tuple[mi.UInt32, mi.Float]:
        first = row * self._width
        total = dr.gather(mi.Float, self._within, first + self._width - 1, active)
        return self._find(self._within, first, self._columns, u * total, active)

    @staticmethod
    def _find(
        running: mi.Float, first: mi.UInt32, count: int, target: mi.Float, active: Any
    ) -> tuple[mi.UInt32, mi.Float]:
        """The first of ``count`` running sums above ``target``, and how far into its share the target is."""

        def below(i: mi.UInt32) -> mi.Bool:
            return dr.gather(mi.Float, running, first + i, active) <= target

        index = dr.binary_search(0, count - 1, below)
        upper = dr.gather(mi.Float, running, first + index, active)
        lower = dr.gather(mi.Float, running, first + index - 1, active & (index > 0))
        share = (target - lower) / (upper - lower)
        return index, dr.select(share < 0, 0, dr.select(share < BELOW_ONE, share, BELOW_ONE))


def _face_point(face: mi.UInt32, u: mi.Float, v: mi.Float, height: mi.Float) -> mi.Vector3f:
    """The point (u, v) of the face's plane, ``height`` away from the centre of the cube."""
    axis = face >> 1
    major = dr.select((face & 1) == 0, height, -height)
    x = dr.select(axis == 0, major, dr.select(axis == 1, v, u))
    y = dr.select(axis == 0, u, dr.select(axis == 1, major, v))
    z = dr.select(axis == 0, v, dr.select(axis == 1, u, major))
    return mi.Vector3f(x, y, z)


def _stretch(u: mi.Float, v: mi.Float) -> mi.Float:
    """Area on the face over solid angle."""
    squared = 1 + u * u + v * v
    return squared * dr.sqrt(squared)


def _texel_index(point: mi.Vector3f, resolution: mi.UInt32) -> mi.UInt32:
    face, u, v = direction_face(point)
    half = 0.5 * mi.Float(resolution)
    return (face * resolution + mi.UInt32((v + 1) * half)) * resolution + mi.UInt32((u + 1) * half)


def _bordered(texels: mi.Float, resolution: int) -> mi.Float:
    """r, g, b of the faces' texels -> r, g, b, 0 of the same with borders; linear and differentiable."""
    width = dr.opaque(mi.UInt32, resolution)
    inner = 1 - 1 / mi.Float(width)
    # The eight corners of the cube, numbered by the signs of x, y, z, stand behind the texels.
    corner = dr.arange(mi.UInt32, 8)
    sign = mi.Vector3f(*[dr.select((corner >> axis) & 1 == 1, mi.Float(1), -1) for axis in range(3)])
    meeting = []
    for axis in range(3):
        point = sign * inner
        point[axis] = sign[axis]
        meeting.append(_texel_index(point, width))

    lane = dr.arange(mi.UInt32, 6 * (resolution + 2) ** 2)
    column, row = lane % (width + 2), (lane // (width + 2)) % (width + 2)
    face = lane // ((width + 2) * (width + 2))
    beside, above = (column == 0) | (column > width), (row == 0) | (row > width)
    step = 2 / mi.Float(width)
    u = dr.clip((mi.Float(column) - 0.5) * step - 1, -1, 1)
    v = dr.clip((mi.Float(row) - 0.5) * step - 1, -1, 1)
    # A border texel, folded over the edge, is the neighbour's first.
    point = _face_point(face, u, v, dr.select(beside | above, inner, 1))
    positive = [dr.select(x > 0, mi.UInt32(1), 0) for x in point]
    corner = 6 * width * width + positive[0] + 2 * positive[1] + 4 * positive[2]
    source = dr.select(beside & above, corner, _texel_index(point, width))
    dr.eval(source)

    every = dr.arange(mi.UInt32, 6 * resolution**2)
    channels = []
    for k in range(3):
        plane = dr.gather(mi.Float, texels, 3 * every + k)
        mean = sum(dr.gather(mi.Float, plane, index) for index in meeting) / 3
        channels.append(dr.gather(mi.Float, dr.concat([plane, mean]), source))
    bordered = dr.ravel(mi.Vector4f(*channels, dr.zeros(mi.Float, dr.width(source))))
    dr.eval(bordered)
    return bordered


@dr.syntax
def _lat_long_means(light: CubemapLight, height: mi.UInt32, per_edge: mi.UInt32, size: int) -> mi.Color3f:
    """Rows stand on the poles, so the first and the last cover half a row."""
    lane = dr.arange(mi.UInt32, 2 * size**2)
    column, row = lane % (2 * height), lane // (2 * height)
    last = mi.Float(height - 1)
    upper, lower = dr.maximum(mi.Float(row) - 0.5, 0), dr.minimum(mi.Float(row) + 0.5, last)
    total, area = mi.Color3f(0), mi.Float(0)
    i = mi.UInt32(0)
    while i < per_edge * per_edge:
        x = mi.Float(column) + (mi.Float(i % per_edge) + 0.5) / mi.Float(per_edge)
        y = dr.lerp(upper, lower, (mi.Float(i // per_edge) + 0.5) / mi.Float(per_edge))
        sin, cos = dr.sincos(y * float(np.pi) / last)
        across, along = dr.sincos(x * float(np.pi) / mi.Float(height))
        total += sin * light.radiance(mi.Vector3f(sin * across, sin * along, cos))
        area += sin
        i += 1
    return total / area
