"""``tron_gbuffer``: the surfels' G-buffer along each ray of a sensor.

    property       type      meaning
    filename       string    the surfels: a PLY of TRON, 2DGS or 3DGS
    surfels        object    or a scene from memory: tron.integrators.embed(scene)

Main channels: radiance of the surfels' harmonics, display space, premultiplied by alpha, the opacity.
Other channels, in the style of Mitsuba's ``aov`` integrator, 0 where there is no surfel:

    position.X .Y .Z     world
    depth.T              distance along the ray from the near plane to the median hit, 0 where there is none
    normal.X .Y .Z       unit, world
    base_color.R .G .B   linear
    roughness.Y  metallic.Y  opacity.Y

A pixel is the film's filtered mean of these over its rays. For rays through pixel centres only, use a box
filter and the sampler ``{"type": "stratified", "jitter": False, "sample_count": 1}``. A ray begins on its
sensor's near plane, and nearer surfels are not seen; the far plane is ignored.

``mi.traverse(integrator)`` exposes the parameters of the surfels. All are differentiable through
``mi.render``, like :class:`tron.tracing.SurfelTracer`; visibility is not differentiated.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from tron.integrators.plugin import Shown, Surfels
from tron.tracing import Surface

CHANNELS = {
    "position": "XYZ",
    "depth": "T",
    "normal": "XYZ",
    "base_color": "RGB",
    "roughness": "Y",
    "metallic": "Y",
    "opacity": "Y",
}
"""Fields of a surface and the names of their components."""


class GBufferAppearance:
    """Shows the fields of the surface that a ray meets."""

    def __init__(self, properties: mi.Properties) -> None:
        self.surfels = Surfels(properties, "tron_gbuffer")
        self.channels = [f"{name}.{part}" for name, parts in CHANNELS.items() for part in parts]

    def show(self, scene: mi.Scene, ray: mi.Ray3f, active: mi.Bool, width: int, seed: int) -> Shown:
        """See :class:`tron.integrators.plugin.Appearance`."""
        del scene, width, seed
        surface = self.surfels.trace(ray.o, ray.d, active)
        extra = [part for name in CHANNELS for part in _parts(surface, name)]
        return Shown(surface.rgb, surface.opacity, extra)


def _parts(surface: Surface, name: str) -> list[mi.Float]:
    value = getattr(surface, name)
    if len(CHANNELS[name]) == 1:
        return [value]
    here = surface.opacity > 0  # without a surfel there is no position, only an origin
    return [dr.select(here, part, 0) for part in value]
