"""Bounced light: rays from every surfel are traced once per scene; the bounces of each light are gathers.

The hits of a surfel's cosine-distributed rays do not depend on light, so they are traced once and kept
(:class:`BounceTransport`), one word per ray. With E the irradiance / pi of direct light, a the albedo of each
surfel, its specular lobe included, and L its emission, k bounces are the sum

    I_0 = 0,    I_{k+1}(i) = 1/n sum_r (a (E + I_k) + L) (met_r(i))

over the n rays of face i that meet one: I is the irradiance / pi of indirect light, and a (E + I) + L the
radiance of a face, the same in all directions; only fronts emit L. Without bounces, emission lights nothing.
Few rays of a surfel meet a lamp, so if anything glows, I is finally averaged among neighbours. Faces are the
M fronts and the backs that rays meet: undersides that no camera saw, with light of their own. Rays are
stopped as in
:mod:`tron.tracing.hierarchy.first_hit`, so each estimates the composited radiance without bias.

Memory: 4 bytes per ray are kept, 128 MB for a million surfels with 32 rays each. While rays are traced, a
million surfels at a time take another 250 bytes each: 380 MB in all, measured.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cache, cached_property

import drjit as dr
import mitsuba as mi

from tron.brdf.reflectance import bounce_albedo
from tron.brdf.table import BrdfTable
from tron.errors import TronError
from tron.estimation import FINAL, Brdf, Estimation
from tron.seeds import integer
from tron.shading.bounces.bounce_rays import OWN, Part, SurfelRays, parts, surfel_met
from tron.shading.bounces.lending import Lending
from tron.shading.direct.visibility import visibility
from tron.shading.lighting import Lighting
from tron.tracing.hierarchy.first_hit import NOTHING
from tron.tracing.surface import Surface, centres
from tron.tracing.tracer import SurfelTracer

RAYS = 32
DIRECT = Estimation(rays=8)
"""Estimation of direct light at a surfel: more than 8 rays gain little, 32 rays 0.02 dB."""
SHOWN_RAYS = 32
"""Shadow rays per surfel for frames that trace none; with 8, frames are 0.4 dB worse."""
QUICK_RAYS = 8
"""Shadow rays per surfel while a light is being turned; they give the direct light too."""
BOUNCED_VALUES = 4
"""Number of baked values per surfel in every frame: indirect light and openness."""
FEWEST = 2
"""Least number of rays that must meet a surfel's back for it to count."""


@dataclass
class BouncedLight:
    """One light at each surfel, M lanes in the scene's order, linear.

    Attributes:
        direct: mi.Color3f, irradiance / pi of the environment, shadows included.
        indirect: mi.Color3f, irradiance / pi of light reflected or emitted by surfels.
        outgoing: mi.Color3f, radiance of the surfel's front, taken as the same in all directions.
        behind: mi.Color3f, radiance of its back, taken as the same in all directions: from the back's own
            light if rays of surfels meet it, else from the indirect light of its front.
        openness: mi.Float in [0, 1], share of the surfel's rays that meet nothing.
        reaching: gives the share of the unshadowed irradiance that reaches the surfel, by channel, averaged
            among neighbours (:mod:`tron.shading.bounces.lending`); None if it is not known.
        faces: direct light of all faces, fronts first (:meth:`BounceTransport.direct_of_faces`).
        emitted: mi.Color3f, radiance emitted by the surfel's front, already included in ``outgoing``;
            None if nothing glows.
    """

    direct: mi.Color3f
    indirect: mi.Color3f
    outgoing: mi.Color3f
    behind: mi.Color3f
    openness: mi.Float
    reaching: Callable[[], list[mi.Float]] | None = None
    faces: Sequence[mi.Color3f] = ()
    emitted: mi.Color3f | None = None

    def values(self, rays: int = FINAL.rays) -> list[mi.Float]:
        """The values to composite by ``SurfelTracer.gbuffer``, for frames of ``rays`` shadow rays per pixel.

        Indirect light and openness, four numbers per surfel; without rays also ``reaching``, three more.
        """
        reaching = [] if rays or self.reaching is None else self.reaching()
        return [*self.indirect, self.openness, *reaching]


class BounceTransport:
    """Hits of the cosine-distributed rays of each of M surfels; made by :meth:`trace`.

    Attributes:
        rays: the rays and their hits.
        undersides: the B backs that they meet; None if they meet none, or if backs are dark.
    """

    def __init__(self, rays: SurfelRays, undersides: Undersides | None = None) -> None:
        self.rays, self.undersides = rays, undersides

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

        More rays give less noise; powers of two from 8 on are stratified and traced in fans. ``track`` wraps
        the loop over a part's fans of rays, to show progress.

        Raises:
            TronError: no rays, or more than 32-bit indices address.
        """
        count = len(tracer.scene)
        if rays < 1:
            raise TronError(f"rays is {rays}", mend="give 1 or more")
        if rays * count >= 1 << 32:
            raise TronError(f"{count} surfels of {rays} rays are too many", mend="trace fewer rays")
        traced = SurfelRays(tracer, rays, seed, track)
        return cls(traced, Undersides.of(traced))

    def moved(self, tracer: SurfelTracer) -> BounceTransport:
        """The same rays among moved surfels; ``tracer`` is ``self.tracer.moved(..)``.

        Only changed rays are traced again (:mod:`tron.shading.bounces.bounce_rays`): with 4 % of 20,000
        surfels moved, in half the time of all rays; with 2 % of 200,000, in a tenth.

        Raises:
            TronError: another number of surfels.
        """
        if len(tracer.scene) != len(self.tracer.scene):
            raise TronError("surfels have come or gone", mend="trace the rays of the new scene")
        rays = self.rays.after(tracer)
        if rays.met is not self.rays.met:
            return BounceTransport(rays, Undersides.of(rays))
        other = BounceTransport(rays, self.undersides)  # only materials are read
        if "_lending" in self.__dict__:
            other.__dict__["_lending"] = self._lending
        return other

    def carried(self, tracer: SurfelTracer) -> BounceTransport:
        """:meth:`moved` without a ray: what was met, and who lends to whom, stays as it was where it was.

        For :meth:`bake_quickly`, while surfels move.
        """
        rays = copy(self.rays)
        rays.tracer = tracer
        other = BounceTransport(rays, self.undersides)
        other.__dict__["_lending"] = self._lending
        return other

    def surfels(self) -> Surface:
        """(M,) the surfels themselves, each at its centre; differentiable as the tracer is."""
        return centres(self.tracer.attached(), dr.arange(mi.UInt32, len(self.tracer.scene)))

    def openness(self) -> mi.Float:
        """(M,) share of each surfel's rays that meet nothing."""
        return _openness(self.rays.met, self.rays.rays, len(self.tracer.scene))

    def albedo(self, brdf: Brdf = "conserving") -> mi.Color3f:
        """(M,) :func:`tron.brdf.reflectance.bounce_albedo`, differentiable as the tracer is."""
        return bounce_albedo(self.surfels(), BrdfTable.load(), brdf)

    def direct(self, lighting: Lighting, estimation: Estimation = DIRECT, seed: int = 0) -> mi.Color3f:
        """(M,) irradiance / pi of direct light at each surfel, shadows included, linear.

        The unshadowed irradiance, which has no noise, times the share of it that arrives: as pixels have it.
        """
        return lighting.split_sum.diffuse(self.surfels().normal) * self.visible(lighting, estimation, seed)

    def direct_of_faces(
        self, lighting: Lighting, estimation: Estimation = DIRECT, seed: int = 0
    ) -> list[mi.Color3f]:
        """:meth:`direct`, and where there are undersides theirs, (B,)."""
        found = [self.direct(lighting, estimation, seed)]
        if self.undersides is not None:
            visible = _visible_behind(self.undersides, lighting, estimation, seed)
            found.append(lighting.split_sum.diffuse(self.undersides.normals()) * visible)
        return found

    def visible(self, lighting: Lighting, estimation: Estimation = DIRECT, seed: int = 0) -> mi.Color3f:
        """(M,) share of the unshadowed irradiance that reaches each surfel; detached.

        Surfels that are neighbours in the hierarchy share out the strata of their shadow rays, and lend each
        other theirs, as pixels do.
        """

        def of(part: Part) -> mi.Color3f:
            root = integer(seed, "bounce", "direct", part.first)
            return visibility(self.tracer, part.gbuffer, lighting, estimation, root)

        return mi.Color3f(*_of_parts(parts(self.tracer), len(self.tracer.scene), of))

    def indirect(
        self, direct: mi.Color3f | Sequence[mi.Color3f], albedo: mi.Color3f, bounces: int = FINAL.bounces
    ) -> mi.Color3f:
        """(M,) irradiance / pi of indirect light at each surfel, linear; differentiable in both arguments.

        Args:
            direct: irradiance / pi of direct light, of all faces (:meth:`direct_of_faces`); or (M,) alone:
                undersides then get what fronts do.
            albedo: (M,) share that leaves again; below 1, or light does not die out.
            bounces: 1 is light that has met one surfel on its way.
        """
        direct = self._of_faces(direct) if isinstance(direct, mi.Color3f) else direct
        return self._indirect(direct, self._of_faces(albedo), bounces)[0]

    def _of_faces(self, color: mi.Color3f) -> list[mi.Color3f]:
        """(M,), and where there are undersides what they have of their surfels, (B,)."""
        behind = self.undersides
        return [color] if behind is None else [color, dr.gather(mi.Color3f, color, behind.surfel)]

    def _indirect(
        self, direct: Sequence[mi.Color3f], albedo: Sequence[mi.Color3f], bounces: int
    ) -> list[mi.Color3f]:
        """:meth:`indirect`, of all faces."""
        behind, place = self.undersides, dr.opaque(mi.UInt32, NOTHING)
        met, count = [self.rays.met], dr.width(self.rays.met) // self.rays.rays
        if behind is not None:
            met, place = [self.rays.met, behind.met], behind.place
        total = [dr.zeros(mi.Color3f, dr.width(there) // self.rays.rays) for there in met]
        emitted = self.tracer.emission
        for _ in range(bounces):
            sent = _packed(_sent(albedo, direct, total, emitted))
            total = [
                _gathered(
                    there,
                    sent,
                    place,
                    dr.opaque(mi.UInt32, count),
                    dr.opaque(mi.UInt32, over),
                    self.rays.rays,
                )
                for over, there in enumerate(met)
            ]
            dr.eval(total)
        return total

    def bake(
        self,
        lighting: Lighting,
        estimation: Estimation = FINAL,
        bounces: int | None = None,
        seed: int = 0,
    ) -> BouncedLight:
        """Bake the light of ``lighting`` at each surfel.

        Args:
            lighting: the prepared environment.
            estimation: of the frames; its estimator, sides, material and bounces are used, but the surfels
                have their own number of shadow rays (``DIRECT``).
            bounces: None: those of ``estimation``.
            seed: as in :meth:`direct`.
        """
        direct = self.direct_of_faces(lighting, at_surfels(estimation), seed)
        baked = self.bounced(direct, estimation, bounces)

        shown = at_surfels(estimation).model_copy(update={"rays": SHOWN_RAYS})

        @cache
        def reaching() -> list[mi.Float]:
            return self.reaching(lighting, shown, integer(seed, "shown"), lent=True)

        return replace(baked, reaching=reaching)

    def bake_quickly(self, lighting: Lighting, estimation: Estimation = FINAL, seed: int = 0) -> BouncedLight:
        """:meth:`bake` in a third of its time, for frames without rays that are looked at for a moment.

        Few rays, of fronts alone and lent among neighbours, are both the direct light and what reaches.
        """
        shown = at_surfels(estimation).model_copy(update={"rays": QUICK_RAYS})
        reaching = self.reaching(lighting, shown, integer(seed, "shown"), lent=True)
        direct = lighting.split_sum.diffuse(self.surfels().normal) * mi.Color3f(*reaching[:3])
        dr.eval(direct)
        return replace(self.bounced(self._of_faces(direct), estimation), reaching=lambda: reaching)

    def rebaked(self, baked: BouncedLight, estimation: Estimation = FINAL) -> BouncedLight:
        """Update a bake of the same surfels with other materials: no ray is traced."""
        return replace(self.bounced(baked.faces, estimation), reaching=baked.reaching)

    def reaching(
        self, lighting: Lighting, estimation: Estimation, seed: int = 0, *, lent: bool
    ) -> list[mi.Float]:
        """(M,) ``reaching`` of :class:`BouncedLight`, from a surfel's own rays or averaged with neighbours.

        Arguments as in :meth:`visible`.
        """

        def of(part: Part) -> list[mi.Float]:
            root = integer(seed, "bounce", "direct", part.first)
            return [*visibility(self.tracer, part.gbuffer, lighting, estimation, root)]

        found = _of_parts(parts(self.tracer), len(self.tracer.scene), of)
        return self._lending.lent(found) if lent else found

    @cached_property
    def _lending(self) -> Lending:
        return Lending.among(self.tracer.scene)

    def bounced(
        self, direct: Sequence[mi.Color3f], estimation: Estimation = FINAL, bounces: int | None = None
    ) -> BouncedLight:
        """:meth:`bake` of direct light at all faces, differentiable in it and in the materials."""
        bounces = estimation.bounces if bounces is None else bounces
        albedo = self._of_faces(self.albedo(estimation.brdf))
        indirect = self._indirect(direct, albedo, bounces)
        emitted = self.tracer.emission
        if emitted is not None:  # few rays of a surfel meet a glowing one: of 32 a tenth
            indirect[0] = mi.Color3f(*self._lending.lent([*indirect[0]]))
        outgoing = _sent(albedo, direct, indirect, emitted)
        behind = albedo[0] * indirect[0]
        if self.undersides is not None:
            place = self.undersides.place
            own = place != NOTHING
            behind = dr.select(own, dr.gather(mi.Color3f, outgoing[1], place, own), behind)
        baked = BouncedLight(
            direct[0], indirect[0], outgoing[0], behind, self.openness(), None, tuple(direct), emitted
        )
        dr.eval(baked)
        return baked


def at_surfels(estimation: Estimation) -> Estimation:
    """Estimation of direct light at surfels, for frames with ``estimation``."""
    return estimation.model_copy(update={"rays": DIRECT.rays, "filtered": DIRECT.filtered})


def _visible_behind(behind: Undersides, lighting: Lighting, estimation: Estimation, seed: int) -> mi.Color3f:
    """(B,) :meth:`BounceTransport.visible` for undersides."""

    def of(part: Part) -> mi.Color3f:
        root = integer(seed, "bounce", "direct", "undersides", part.first)
        return visibility(behind.tracer, part.gbuffer, lighting, estimation, root)

    return mi.Color3f(*_of_parts(behind.parts(), dr.width(behind.surfel), of))


def _of_parts(every: Iterable[Part], count: int, of: Callable[[Part], Iterable[mi.Float]]) -> list[mi.Float]:
    """Three numbers of each of ``count`` faces, found part after part."""
    found = [dr.zeros(mi.Float, count) for _ in range(3)]
    for part in every:
        for target, value in zip(found, of(part), strict=True):
            dr.scatter(target, value, part.surfel, part.gbuffer.opacity > 0)
        dr.eval(found)
    return found


def _sent(
    albedo: Sequence[mi.Color3f],
    direct: Sequence[mi.Color3f],
    indirect: Sequence[mi.Color3f],
    emitted: mi.Color3f | None,
) -> list[mi.Color3f]:
    """Radiance of all faces, fronts first; only fronts emit."""
    front, *backs = [a * (e + i) for a, e, i in zip(albedo, direct, indirect, strict=True)]
    return [front if emitted is None else front + emitted, *backs]


def _packed(colors: Sequence[mi.Color3f]) -> mi.Float:
    """Four floats a lane, one array after the other, so that one read fetches a colour."""
    counts = [dr.width(color) for color in colors]
    packed = dr.zeros(mi.Float, 4 * sum(counts))
    for k, color in enumerate(colors):
        place = dr.arange(mi.UInt32, counts[k]) + dr.opaque(mi.UInt32, sum(counts[:k]))
        dr.scatter(packed, mi.Vector4f(*color, mi.Float(0)), place)
    dr.eval(packed)
    return packed


@dr.syntax
def _gathered(
    met: mi.UInt32, sent: mi.Float, place: mi.UInt32, fronts: mi.UInt32, over: mi.UInt32, rays: int
) -> mi.Color3f:
    """Mean over each face's rays of the radiance they meet, by channel; ``sent``: of all faces, packed.

    Args:
        met: of those faces; ``over`` is 1 where its sides are exchanged, else 0.
        place: of each surfel's underside, which come after the ``fronts``, or ``NOTHING``.
    """
    face, faces = dr.arange(mi.UInt32, dr.width(met) // rays), dr.opaque(mi.UInt32, dr.width(met) // rays)
    ray, end, total = mi.UInt32(0), dr.opaque(mi.UInt32, rays), mi.Color3f(0)
    while dr.hint(ray < end, max_iterations=-1):
        code = dr.gather(mi.UInt32, met, ray * faces + face)
        there, surfel, back = code != NOTHING, surfel_met(code), (code & 1) != over
        own = there & ((code & OWN) != 0)
        behind = dr.gather(mi.UInt32, place, surfel, there & back)
        there &= own | ~back | (behind != NOTHING)
        met_face = dr.select(back, behind + fronts, surfel)
        value = dr.gather(mi.Vector4f, sent, dr.select(own, face + over * fronts, met_face), there)
        total += mi.Color3f(value.x, value.y, value.z)
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


# A back face stands for a real side of a surface, and its light differs from the front's: a sheet in the sun
# is dark from below. So each surfel that rays meet from behind gets a second face, whose rays are traced as
# if the scene were turned over. Backs met by a single ray are left out and stay dark: such rays have slipped
# through the last hundredths of transmittance of something closed. Backs that only other backs meet are
# inside, and dark too.
# Floors under a sheet of 1 x 1, 0.3 to 1.2 above them, have 0.95 to 1.08 of the light that path tracing gives
# their shadow.


@dataclass
class Undersides:
    """The B surfels that are met from behind.

    Attributes:
        surfel: mi.UInt32 (B,), in the hierarchy's order.
        place: mi.UInt32 (M,), where a surfel is among them, or ``NOTHING``.
        tracer: of the scene turned over.
        met: mi.UInt32 (rays x B), what stops the rays of their backs, as ``SurfelRays.met`` has it, by the
            sides that surfels have when turned over.
    """

    surfel: mi.UInt32
    place: mi.UInt32
    tracer: SurfelTracer
    met: mi.UInt32

    @classmethod
    def of(cls, rays: SurfelRays) -> Undersides | None:
        """Trace as many rays from each back that ``rays`` meet; None where they meet none."""
        count = len(rays.tracer.scene)
        behind = (rays.met != NOTHING) & ((rays.met & 1) == 1) & ((rays.met & OWN) == 0)
        times = dr.zeros(mi.UInt32, count)
        # By default Dr.Jit makes copies for each thread, in a kernel for each number of surfels.
        direct = dr.ReduceMode.Direct
        dr.scatter_reduce(dr.ReduceOp.Add, times, mi.UInt32(1), surfel_met(rays.met), behind, direct)
        order = rays.tracer.bvh.order
        which = dr.compress(dr.gather(mi.UInt32, times, order) >= FEWEST)
        if dr.width(which) == 0:
            return None
        surfel = dr.gather(mi.UInt32, order, which)
        place = dr.full(mi.UInt32, NOTHING, count)
        dr.scatter(place, dr.arange(mi.UInt32, dr.width(surfel)), surfel)
        dr.eval(surfel, place)
        tracer = rays.tracer.turned_over()
        return cls(surfel, place, tracer, rays.of_some(tracer, surfel))

    def normals(self) -> mi.Vector3f:
        """(B,) unit, world."""
        return mi.Vector3f(centres(self.tracer.records, self.surfel).normal)

    def parts(self) -> Iterator[Part]:
        """All of them in parts; ``surfel`` is the number among them."""
        for part in parts(self.tracer, self.surfel):
            place = dr.gather(mi.UInt32, self.place, part.surfel, part.gbuffer.opacity > 0)
            yield replace(part, surfel=place)
