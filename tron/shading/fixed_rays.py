"""All light on a view as a differentiable function of materials and light, for rays that stand still.

The shadow rays of a view and of the surfels are drawn once, for one light, and kept with their visibility
(:mod:`tron.shading.transport`), as is what surfels see of one another. ``lit`` is then the composition of
:mod:`tron.shading.composition` with

    E = U s / u,    s = sum of w L V, u = sum of w L over the rays,

at pixels and at surfels, and bounces that are gathered anew: gradients reach base color, roughness and
metallic of all surfels through the light they send to one another, and the light's texels along every ray,
shadows included. They stop at what is visible, that is at positions, sizes and opacities. Lobes see the scene
as they do without reflection rays. Memory grows with (pixels x rays + surfels x 8), some 30 bytes each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from tron.cameras import Camera
from tron.estimation import FINAL, Estimation
from tron.seeds import integer
from tron.shading.bounce import DIRECT, BounceTransport
from tron.shading.bounce_rays import Part, parts
from tron.shading.guidance import Arriving, shade_surface
from tron.shading.irradiance import Light, visible_share
from tron.shading.lighting import Lighting
from tron.shading.transport import Transport
from tron.tracing import GBuffer, SurfelTracer


@dataclass
class FixedRays:
    """Rays of one view of a scene; make them by :meth:`trace`.

    Attributes:
        tracer: of the scene, differentiable by its parameters.
        camera: the view.
        bounce: what surfels see of one another.
        estimation: bounces and material.
        pixels: shadow rays of the view.
        surfels: shadow rays of the surfels, part by part.
    """

    tracer: SurfelTracer
    camera: Camera
    bounce: BounceTransport
    estimation: Estimation
    pixels: Transport
    surfels: list[tuple[Part, Transport]]

    @classmethod
    def trace(
        cls,
        tracer: SurfelTracer,
        camera: Camera,
        light: Light,
        bounce: BounceTransport,
        estimation: Estimation = FINAL,
        seed: int = 0,
    ) -> FixedRays:
        """Draw and trace the rays.

        Args:
            tracer: the scene.
            camera: the view.
            light: what half the shadow rays are drawn from.
            bounce: of the same tracer.
            estimation: shadow rays per pixel, sides, bounces and material.
            seed: root of the shadow rays' random numbers.
        """
        occluder = tracer.sided(estimation.two_sided)
        with dr.suspend_grad():
            pixels = Transport.trace(occluder, tracer.gbuffer(camera), light, estimation.rays, seed)
            surfels = []
            for part in parts(tracer):
                root = integer(seed, "bounce", "direct", part.first)
                surfels.append((part, Transport.trace(occluder, part.gbuffer, light, DIRECT.rays, root)))
        return cls(tracer, camera, bounce, estimation, pixels, surfels)

    def shade(
        self, lighting: Lighting, background: Sequence[float] | None = None
    ) -> tuple[GBuffer, dict[str, mi.Color3f]]:
        """The view, and its colours by name as of :class:`tron.shading.guidance.Guidance`, one lane a pixel.

        Args:
            lighting: of any light; gradients reach the texels of a :class:`CubemapLight`.
            background: linear RGB radiance behind the surfels; None: the environment.
        """
        values = ()
        if self.estimation.bounces:
            values = self.bounce.bounced(self._direct(lighting), self.estimation).values()
        gbuffer = self.tracer.gbuffer(self.camera, values)
        arriving = Arriving(visible_share(*self.pixels.irradiance(lighting.light)))
        return gbuffer, shade_surface(gbuffer, arriving, lighting, background, self.estimation.diffuse)

    def _direct(self, lighting: Lighting) -> mi.Color3f:
        """(M,) irradiance / pi of direct light at each surfel."""
        share = dr.zeros(mi.Color3f, len(self.tracer.scene))
        for part, rays in self.surfels:
            found = visible_share(*rays.irradiance(lighting.light))
            for target, value in zip(share, found, strict=True):
                dr.scatter(target, value, part.surfel, part.gbuffer.opacity > 0)
        return lighting.split_sum.diffuse(dr.detach(self.bounce.surfels().normal)) * share
