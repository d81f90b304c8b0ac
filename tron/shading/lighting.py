"""An environment prepared for lighting frames: importance sampling and prefiltered lookups.

Split-sum lighting is a prefiltered environment times a BRDF table (Karis 2013), in nvdiffrec's convention.
The prefiltered cubemap has one level for each of a few roughnesses, from 0.08 at full resolution to 0.5 at 32
texels a face, then roughness 1 at 16: level i of 0..L-2 is roughness 0.08 + 0.42 i / (L - 2), level L-1 is 1.
Between levels, texels and faces the lookup is linear. Diffuse light is the roughness-1 filter once more, at
32 texels a face: its kink at the terminator shows at 16 (4 % off at worst, against 0.4 %).
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.brdf.table import BrdfTable
from tron.errors import TronError
from tron.runtime import aligned
from tron.shading.environments.cubemap import CubemapLight, bilinear, face_direction
from tron.shading.environments.environment import EnvironmentLight, EnvironmentMap
from tron.shading.environments.prefilter import LightTree, ggx_prefilter, lobe_length

CUBEMAP_RESOLUTION = 128
"""Texels along a face edge of the sharpest level."""
SMALLEST_LEVEL, DIFFUSE_LEVEL = 16, 32
SHARPEST_ROUGHNESS, MIDDLE_ROUGHNESS = 0.08, 0.5
WIDTHS = 256
"""Entries of the table of lobes' widths."""


class Lighting:
    """An environment prepared once for every frame that it lights.

    Args:
        environment: the light; with a cubemap, everything is differentiable by its texels.
        cubemap_resolution: see :class:`SplitSum`.
    """

    def __init__(
        self, environment: EnvironmentMap | CubemapLight, cubemap_resolution: int = CUBEMAP_RESOLUTION
    ) -> None:
        drawn = isinstance(environment, EnvironmentMap)
        self.light = EnvironmentLight(environment) if drawn else environment
        self.split_sum = SplitSum(self.light, cubemap_resolution)

    @property
    def environment(self) -> EnvironmentMap:
        """The light as a map, its rotation included."""
        light = self.light
        return light.to_environment() if isinstance(light, CubemapLight) else light.environment

    def turned_to(self, rotation_deg: float) -> Lighting:
        """The same environment at another rotation about +z, in microseconds: lookups are turned.

        Raises:
            TronError: the light is a cubemap.
        """
        if isinstance(self.light, CubemapLight):
            raise TronError("a cubemap does not turn", mend="turn its to_environment()")
        other = copy(self)
        other.light = self.light.turned_to(rotation_deg)
        other.split_sum = self.split_sum.turned_to(rotation_deg)
        return other


class SplitSum:
    """An environment prepared for unshadowed shading of any surface.

    Everything it returns is differentiable with respect to the texels of a :class:`CubemapLight`, through the
    levels; make a new one after each change of the light.

    Attributes:
        brdf: the table beside the environment.

    Args:
        light: on the device.
        resolution: texels along a face edge of the sharpest level, a power of two in [64, 1024]. Preparing a
            light takes about 0.3, 1.2 and 5 seconds on one core at 128, 256 and 512.

    Raises:
        TronError: another resolution.
    """

    def __init__(self, light: EnvironmentLight | CubemapLight, resolution: int = CUBEMAP_RESOLUTION) -> None:
        if resolution not in (64, 128, 256, 512, 1024):
            raise TronError(f"cubemap resolution is {resolution}", mend="use 64, 128, 256, 512 or 1024")
        # Levels are those of the map at rest, and lookups are turned: one preparation serves all rotations.
        self._turn_to(0.0)
        if isinstance(light, EnvironmentLight):
            self._turn_to(light.environment.rotation_deg)
            light = _at_rest(light, 8 * resolution)
        tree = LightTree.build(light, resolution)
        resolutions = _level_resolutions(resolution)
        roughnesses = _level_roughnesses(len(resolutions))
        self._last = dr.opaque(mi.UInt32, len(resolutions) - 1)
        resolutions, roughnesses = [*resolutions, DIFFUSE_LEVEL], [*roughnesses, 1.0]
        levels = [
            _prefiltered_level(tree, r, alpha=roughness**2)
            for r, roughness in zip(resolutions, roughnesses, strict=True)
        ]
        offsets = np.cumsum([0] + [6 * (r + 2) ** 2 for r in resolutions[:-1]])
        self._texels = dr.concat(levels)
        self._offsets = mi.UInt32(aligned(offsets.astype(np.uint32)))
        self._resolutions = mi.UInt32(aligned(np.array(resolutions, np.uint32)))
        self._widths = mi.Float(aligned(_roughness_by_width()))
        self.brdf = BrdfTable.load()
        dr.eval(self._texels)

    def turned_to(self, rotation_deg: float) -> SplitSum:
        """The same map, prepared once, at another rotation about +z (as ``EnvironmentMap.rotation_deg``)."""
        other = copy(self)
        other._turn_to(rotation_deg)
        return other

    def _turn_to(self, rotation_deg: float) -> None:
        angle = np.radians(rotation_deg)
        self._cos, self._sin = (dr.opaque(mi.Float, float(value)) for value in (np.cos(angle), np.sin(angle)))

    def diffuse(self, normal: mi.Vector3f) -> mi.Color3f:
        """Unoccluded irradiance / pi: linear radiance of a white diffuse surface of unit ``normal``."""
        return self._level(self._at_rest(mi.Vector3f(normal)), self._last + 1)

    def reflected(self, normal: mi.Vector3f, to_camera: mi.Vector3f, roughness: mi.Float) -> mi.Color3f:
        """Mean radiance over the unoccluded lobe, looked up along the mirror's direction as in the paper.

        Times F0 A + B it is the specular reflection; :meth:`averaged` is more accurate for rough lobes.

        Args:
            normal, to_camera: unit, world.
            roughness: in [0, 1]; alpha is its square.
        """
        normal, to_camera = mi.Vector3f(normal), mi.Vector3f(to_camera)
        return self.prefiltered(2 * dr.dot(normal, to_camera) * normal - to_camera, roughness)

    def averaged(self, parts: Sequence[tuple[mi.Float, mi.Vector3f]]) -> mi.Color3f:
        """Mean linear radiance over a lobe of :func:`tron.brdf.reflectance.lobe_parts`.

        Each part is looked up in the direction and level whose lobe has the same first moment. These differ
        from the mirror's direction and the surface's roughness: lobes lean to the normal, cut by the horizon.
        """
        looked_up = []
        for share, mean in parts:
            length = dr.norm(mean)
            spread = dr.sqrt(dr.sqrt(dr.clip((1 - length) * 3, 1e-6, 1))) * (WIDTHS - 1)
            entry = dr.minimum(mi.UInt32(spread), WIDTHS - 2)
            pair = [dr.gather(mi.Float, self._widths, entry + i) for i in (0, 1)]
            roughness = dr.lerp(*pair, spread - mi.Float(entry))
            looked_up.append(share * self.prefiltered(mean / length, roughness))
        return sum(looked_up, mi.Color3f(0))

    def prefiltered(self, direction: mi.Vector3f, roughness: mi.Float) -> mi.Color3f:
        """Environment filtered by the lobe of ``roughness``, trilinear, in unit world ``direction``."""
        direction = self._at_rest(mi.Vector3f(direction))
        level = self._level_of(roughness)
        lower = mi.UInt32(level)
        lower = dr.select(lower < self._last, lower, self._last - 1)
        return dr.lerp(
            self._level(direction, lower), self._level(direction, lower + 1), level - mi.Float(lower)
        )

    def _at_rest(self, d: mi.Vector3f) -> mi.Vector3f:
        """World directions in the frame of the map before it is turned."""
        return mi.Vector3f(self._cos * d.x + self._sin * d.y, self._cos * d.y - self._sin * d.x, d.z)

    def _level_of(self, roughness: mi.Float) -> mi.Float:
        before_last = mi.Float(self._last) - 1
        sharp = dr.clip(roughness, SHARPEST_ROUGHNESS, MIDDLE_ROUGHNESS) - SHARPEST_ROUGHNESS
        rough = dr.clip(roughness, MIDDLE_ROUGHNESS, 1) - MIDDLE_ROUGHNESS
        return sharp / (MIDDLE_ROUGHNESS - SHARPEST_ROUGHNESS) * before_last + rough / (1 - MIDDLE_ROUGHNESS)

    def _level(self, direction: mi.Vector3f, level: mi.UInt32) -> mi.Color3f:
        resolution = dr.gather(mi.UInt32, self._resolutions, level)
        return bilinear(self._texels, dr.gather(mi.UInt32, self._offsets, level), resolution, direction)


@cache
def _roughness_by_width() -> np.ndarray:
    """(WIDTHS,) float32: roughness of the lobe of mean length 1 - x^4 / 3, x in [0, 1]."""
    roughness = np.linspace(0.02, 0.9999, 400)
    width = np.array([(3 * (1 - lobe_length(each**2))) ** 0.25 for each in roughness])
    return np.interp(np.linspace(0, 1, WIDTHS), [0, *width, 1], [0, *roughness, 1]).astype(np.float32)


def _at_rest(light: EnvironmentLight, widest: int) -> EnvironmentLight:
    """The map before it is turned; one with far more columns than the levels can show is averaged down."""
    light = light.turned_to(0.0)
    if light.environment.image.shape[1] <= widest:
        return light
    return EnvironmentLight(light.environment.resized(widest // 2))


def _level_resolutions(resolution: int) -> list[int]:
    levels = [resolution]
    while levels[-1] > SMALLEST_LEVEL:
        levels.append(levels[-1] // 2)
    return levels


def _level_roughnesses(count: int) -> list[float]:
    step = (MIDDLE_ROUGHNESS - SHARPEST_ROUGHNESS) / (count - 2)
    return [SHARPEST_ROUGHNESS + step * i for i in range(count - 1)] + [1.0]


def _prefiltered_level(tree: LightTree, resolution: int, alpha: float) -> mi.Float:
    """r, g, b, 0 of 6 (resolution + 2)^2 texels; the border is filtered on the face's extended plane."""
    width = dr.opaque(mi.UInt32, resolution + 2)
    texel = dr.arange(mi.UInt32, 6 * (resolution + 2) ** 2)
    face, inside = texel // (width * width), texel % (width * width)
    scale = dr.opaque(mi.Float, 2 / resolution)
    u, v = (mi.Float(inside % width) - 0.5) * scale - 1, (mi.Float(inside // width) - 0.5) * scale - 1
    # The small levels have few texels, wide lobes and the closely watched diffuse light: they can be exact.
    opening = dr.opaque(mi.Float, 0.35 if resolution > DIFFUSE_LEVEL else 0.1)
    colour = ggx_prefilter(tree, face_direction(face, u, v), dr.opaque(mi.Float, alpha), opening)
    return dr.ravel(mi.Vector4f(*colour, dr.zeros(mi.Float, dr.width(texel))))
