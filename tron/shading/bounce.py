"""Light that bounces: from every surfel some rays, traced once a scene; bounces of a light are gathers.

What a surfel's cosine-distributed rays meet does not depend on light, so it is found once and kept
(:class:`BounceTransport`): one word a ray. With E the irradiance / pi of direct light and a the albedo of
each surfel, its specular lobe included, k bounces are the sum

    I_0 = 0,    I_{k+1}(i) = 1/n sum_r s_r a (E + I_k) (met_r(i))

over the n rays of surfel i: I is the irradiance / pi of indirect light, a (E + I) what a surfel sends out,
the same in all directions. s is 1 where the ray meets a front, 0 where it meets nothing, and ``BACK`` where
it meets a back: an underside that no camera saw, which stands for one that is there. Rays are stopped as in
:mod:`tron.tracing.first_hit`, so each estimates the composited radiance without bias.

Memory: 4 bytes a ray are kept, 128 MB of a million surfels with 32 rays each. While rays are traced,
a million surfels at a time take another 250 bytes each: 380 MB in all, measured. Surfels of two faces
(:mod:`tron.shading.both_sides`) take more than three times that.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from tron.errors import TronError
from tron.estimation import FINAL, Diffuse, Estimation
from tron.seeds import integer
from tron.shading.bounce_rays import SurfelRays, parts
from tron.shading.brdf_table import BrdfTable
from tron.shading.lighting import Lighting
from tron.shading.reflectance import bounce_albedo
from tron.shading.visibility import visibility
from tron.tracing.centres import centres
from tron.tracing.first_hit import NOTHING
from tron.tracing.surface import Surface
from tron.tracing.tracer import SurfelTracer

RAYS = 32
BACK = 0.5
"""Radiance of a back face as a share of its front's."""
DIRECT = Estimation(rays=8)
"""Direct light at a surfel: more than 8 rays gain nothing, 32 are worth 0.02 dB."""


@dataclass
class BouncedLight:
    """One light at each surfel, M lanes in the scene's order, linear.

    Attributes:
        direct: mi.Color3f, irradiance / pi of the environment, shadows included.
        indirect: mi.Color3f, irradiance / pi of light that has met surfels.
        outgoing: mi.Color3f, radiance that the surfel's front sends out, taken as the same in all directions.
        behind: mi.Color3f, radiance that its back sends out, likewise.
        openness: mi.Float in [0, 1], share of the surfel's rays that meet nothing.
    """

    direct: mi.Color3f
    indirect: mi.Color3f
    outgoing: mi.Color3f
    behind: mi.Color3f
    openness: mi.Float

    def values(self) -> list[mi.Float]:
        """Indirect light and openness, four numbers a surfel: ``values`` of ``SurfelTracer.gbuffer``."""
        return [*self.indirect, self.openness]


class BounceTransport:
    """Hits of the cosine-distributed rays of each of M surfels; made by :meth:`trace`.

    Attributes:
        rays: those rays, and what stops each of them.
    """

    def __init__(self, rays: SurfelRays) -> None:
        self.rays = rays

    @property
    def tracer(self) -> SurfelTracer:
        """The surfels."""
        return self.rays.tracer

    @classmethod
    def trace(
        cls,
        tracer: SurfelTracer,
        rays: int = RAYS,
        seed: int = 0,
        track: Callable[[range], Iterable[int]] = iter,
    ) -> BounceTransport:
        """Trace ``rays`` rays of each surfel: 0.2 seconds for 20,000 surfels of 32 rays on one core.

        The more rays the less noise; powers of two from 8 on are stratified and traced in fans. ``track``
        wraps the loop over a part's fans of rays, to show progress.

        Raises:
            TronError: no rays, or more than 32-bit indices address.
        """
        count = len(tracer.scene)
        if rays < 1:
            raise TronError(f"rays is {rays}", mend="give 1 or more")
        if rays * count >= 1 << 32:
            raise TronError(f"{count} surfels of {rays} rays are too many", mend="trace fewer rays")
        return cls(SurfelRays(tracer, rays, seed, track))

    def moved(self, tracer: SurfelTracer) -> BounceTransport:
        """The same rays among surfels that have moved: of ``tracer``, which is ``self.tracer.moved(..)``.

        Only what has changed is traced again (:mod:`tron.shading.bounce_rays`): of 20,000 surfels, 4 % moved,
        in half the time; of 200,000, 2 % moved, in a tenth.

        Raises:
            TronError: another number of surfels.
        """
        if len(tracer.scene) != len(self.tracer.scene):
            raise TronError("surfels have come or gone", mend="trace the rays of the new scene")
        return BounceTransport(self.rays.after(tracer))

    def surfels(self) -> Surface:
        """(M,) the surfels themselves, each at its centre; differentiable as the tracer is."""
        return centres(self.tracer.attached(), dr.arange(mi.UInt32, len(self.tracer.scene)))

    def openness(self) -> mi.Float:
        """(M,) share of each surfel's rays that meet nothing."""
        return _openness(self.rays.met, self.rays.rays, len(self.tracer.scene))

    def albedo(self, diffuse: Diffuse = "principled") -> mi.Color3f:
        """(M,) :func:`tron.shading.reflectance.bounce_albedo`, differentiable as the tracer is."""
        return bounce_albedo(self.surfels(), BrdfTable.load(), diffuse)

    def direct(self, lighting: Lighting, estimation: Estimation = DIRECT, seed: int = 0) -> mi.Color3f:
        """(M,) irradiance / pi of direct light at each surfel, shadows included, linear.

        The unshadowed irradiance, which has no noise, times the share of it that arrives: as pixels have it.
        """
        return lighting.split_sum.diffuse(self.surfels().normal) * self.visible(lighting, estimation, seed)

    def visible(self, lighting: Lighting, estimation: Estimation = DIRECT, seed: int = 0) -> mi.Color3f:
        """(M,) share of the unshadowed irradiance that reaches each surfel; detached.

        Surfels that are neighbours in the hierarchy share out the strata of their shadow rays, and lend each
        other theirs, as pixels do.
        """
        found = dr.zeros(mi.Color3f, len(self.tracer.scene))
        for part in parts(self.tracer):
            root = integer(seed, "bounce", "direct", part.first)
            share = visibility(self.tracer, part.gbuffer, lighting, estimation, root)
            for target, value in zip(found, share, strict=True):
                dr.scatter(target, value, part.surfel, part.gbuffer.opacity > 0)
            dr.eval(found)
        return found

    def indirect(
        self, direct: mi.Color3f, albedo: mi.Color3f, bounces: int = FINAL.bounces, back: float = BACK
    ) -> mi.Color3f:
        """(M,) irradiance / pi of indirect light at each surfel, linear; differentiable in both arguments.

        Args:
            direct: (M,) irradiance / pi of direct light.
            albedo: (M,) share that leaves again; below 1, or light does not die out.
            bounces: 1 is light that has met one surfel on its way.
            back: radiance of back faces as a share of their fronts'.
        """
        count = dr.width(self.rays.met) // self.rays.rays
        share = dr.opaque(mi.Float, back)
        total = dr.zeros(mi.Color3f, count)
        for _ in range(bounces):
            sent = _packed(albedo * (direct + total))
            total = _gathered(self.rays.met, sent, share, self.rays.rays, count)
            dr.eval(total)
        return total

    def bake(
        self,
        lighting: Lighting,
        estimation: Estimation = FINAL,
        bounces: int | None = None,
        back: float = BACK,
        seed: int = 0,
    ) -> BouncedLight:
        """The light of ``lighting`` at each surfel.

        Args:
            lighting: the prepared environment.
            estimation: of the frames; the surfels have their estimator, sides, material and bounces, but
                shadow rays of their own (``DIRECT``).
            bounces: None: those of ``estimation``.
            back, seed: as of :meth:`indirect` and :meth:`direct`.
        """
        return self.bounced(self.direct(lighting, at_surfels(estimation), seed), estimation, bounces, back)

    def bounced(
        self,
        direct: mi.Color3f,
        estimation: Estimation = FINAL,
        bounces: int | None = None,
        back: float = BACK,
    ) -> BouncedLight:
        """:meth:`bake` of :meth:`direct` light; differentiable in it and, as the tracer is, in materials."""
        bounces = estimation.bounces if bounces is None else bounces
        albedo = self.albedo(estimation.diffuse)
        indirect = self.indirect(direct, albedo, bounces, back)
        outgoing = albedo * (direct + indirect)
        behind = dr.opaque(mi.Float, back) * outgoing
        baked = BouncedLight(direct, indirect, outgoing, behind, self.openness())
        dr.eval(baked)
        return baked


def at_surfels(estimation: Estimation) -> Estimation:
    """Of direct light at surfels, where frames are estimated by ``estimation``."""
    return estimation.model_copy(update={"rays": DIRECT.rays, "filtered": DIRECT.filtered})


def _packed(color: mi.Color3f) -> mi.Float:
    """Four floats a lane, so that one read fetches a colour."""
    count = dr.width(color)
    packed = dr.zeros(mi.Float, 4 * count)
    dr.scatter(packed, mi.Vector4f(*color, mi.Float(0)), dr.arange(mi.UInt32, count))
    dr.eval(packed)
    return packed


@dr.syntax
def _gathered(met: mi.UInt32, sent: mi.Float, back: mi.Float, rays: int, count: int) -> mi.Color3f:
    """Mean over the rays of each surfel of what they meet: ``sent`` packed, (M,) by channel."""
    surfel, surfels = dr.arange(mi.UInt32, count), dr.opaque(mi.UInt32, count)
    ray, end, total = mi.UInt32(0), dr.opaque(mi.UInt32, rays), mi.Color3f(0)
    while dr.hint(ray < end, max_iterations=-1):
        code = dr.gather(mi.UInt32, met, ray * surfels + surfel)
        there = code != NOTHING
        value = dr.gather(mi.Vector4f, sent, code >> 1, there)
        share = dr.select((code & 1) == 0, 1, back)
        total += share * mi.Color3f(value.x, value.y, value.z)
        ray += 1
    return total / mi.Float(end)


@dr.syntax
def _openness(met: mi.UInt32, rays: int, count: int) -> mi.Float:
    surfel, surfels = dr.arange(mi.UInt32, count), dr.opaque(mi.UInt32, count)
    ray, end, free = mi.UInt32(0), dr.opaque(mi.UInt32, rays), mi.UInt32(0)
    while ray < end:
        free += dr.select(dr.gather(mi.UInt32, met, ray * surfels + surfel) == NOTHING, mi.UInt32(1), 0)
        ray += 1
    return mi.Float(free) / mi.Float(end)
