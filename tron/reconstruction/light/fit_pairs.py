"""Light and base color together, from photos and frozen geometry alone: base color is eliminated.

A diffuse point p of base color rho shows (all linear, / pi)

    C_p = rho_p (E_p(L) + I_p),     E_p(L) = sum_j T_pj L_j + a_p s

T is traced once (:mod:`tron.reconstruction.light.sky_visibility`), a_p the share of a sun's light that
arrives, cosine included, s its strength. I is light that bounced. It needs no unknown: surfels send out what
the photos show of them, so I is gathered from the photos' colours along the rays of
:class:`tron.shading.bounces.bounce.BounceTransport`. Two points of like material then tell of the light
alone:

    min over L, s of    sum_pq w_pq h log(1 + |log C_p / C_q - log (E + I)_p / (E + I)_q| / h)

Pairs are near in space, or near in the chromaticity of the *current* rho; w falls with the difference of that
chromaticity, and with how many points face the same way. They are drawn anew after each round. Base color is
never a variable, so there is nothing to alternate.

log L is a sum of cubemaps of 1, 2, 4, ... texels a face edge, luminance and two chromas apart. Priors, each
with its weight: the 95th percentile of base color is ``brightest``, as few surfaces reflect more (``scale``;
what bounces says it too, but weakly); fine levels are small, colours grey (``grey``), directions that no
point looks into dark, and those that photos show are as they show them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from pydantic import Field
from scipy.sparse import csr_array
from scipy.spatial import KDTree

from tron.captures.view import FLOOR
from tron.errors import TronError
from tron.reconstruction.light.sky_visibility import PhotographedSky, cube_texels
from tron.reconstruction.settings import Settings
from tron.seeds import generator

_NEARBY, _SIMILAR = 60, 200
"""Neighbours in space and in chromaticity that partners are drawn from."""
_PARTNERS = 8  # of each point, of either kind
_RATE = 0.05  # of Adam, in log radiance
PATCH = 3.5
"""Radius of the patches that are compared, in spacings of surfels."""
ROBUST = 0.2
"""Log difference beyond which a pair is doubted."""
ALIKE = 0.12
"""Log chromaticity that like materials differ by."""
_SMOOTH, _DARK, _SKY = 3e-3, 0.02, 0.5
"""Weights of other priors: small fine levels, dark unseen directions, and the sky as the photos show it."""
_DARKNESS = 0.3  # radiance of unseen directions, as a share of the mean
_PERCENTILE = 95
_TURN = 0.01  # share of the scene's size that opposite normals count in the distance between points
_MOST = 40  # points of a patch
_FACING = 0.6  # least cosine between normals of one patch
_WARM = (0.5, -0.87)
"""Unit direction of black bodies of 3,000 to 15,000 K in log R / G and log B / G, linear BT.709."""
_OFF_WARM = 3.0  # how much more a colour away from their line costs: light is warm or cool, rarely green
_ACROSS = np.array([-_WARM[1], _WARM[0]])
_OFF_GREY = (0.5 * np.eye(2) + 0.5 * (_OFF_WARM**2 - 1) * np.outer(_ACROSS, _ACROSS)).astype(np.float32)
"""(2, 2) quadratic form of log R / G and log B / G: what a colour costs."""
_TO_LOG_RGB = np.array([[1, 1, 1], [1, 0, 0], [0, 0, 1]], np.float32)
"""From rows of log luminance, log R / G and log B / G."""
_LEAST = 1e-5  # irradiance / pi that is divided by
_FORGET = 0.9, 0.999  # of Adam's moments, Kingma and Ba 2015


class TooFewSeen(TronError):
    """The photos show too few of the surfels to say anything of light and materials."""


class LightSettings(Settings):
    """Fit of the light to pairs of points."""

    resolution: int = Field(default=8, ge=2, le=32, description="Texels along a face edge of the cubemap.")
    points: int = Field(default=5000, ge=100, description="Maximum number of surfels that are compared.")
    rounds: int = Field(default=2, ge=1, description="Times that the pairs are drawn.")
    steps: int = Field(default=150, ge=1, description="Steps of Adam a round.")
    brightest: float = Field(
        default=0.8, gt=0, le=1, description="Base color of the 95th percentile, largest channel."
    )
    scale: float = Field(default=0.05, ge=0, description="Weight of base color being as bright as that.")
    grey: float = Field(default=0.05, ge=0, description="Weight of the light being grey.")


@dataclass(frozen=True)
class Points:
    """P surface points: what the photos show of them, and what they see.

    Attributes:
        position, normal: (P, 3) world, normals unit.
        color: (P, 3) linear light that leaves them.
        bounced: (P, 3) irradiance / pi of light that met the scene, in the unit of ``color``.
        transport: (P, D) to the texels of a cubemap.
        lobe: (P,) transport of the sun; None without.
    """

    position: np.ndarray
    normal: np.ndarray
    color: np.ndarray
    bounced: np.ndarray
    transport: np.ndarray
    lobe: np.ndarray | None = None

    def taken(self, which: slice) -> Points:
        """Some of them."""
        arrays = {name: value if value is None else value[which] for name, value in vars(self).items()}
        return Points(**arrays)

    def patches(self, radius: float) -> Patches:
        """Patches of the points; ``radius`` in world units."""
        return Patches.of(self.position, self.normal, np.maximum(self.color, FLOOR), radius)

    def averaged(self, patches: Patches) -> Points:
        """Points of what patches show and see, means over each; of colours the geometric one."""
        color = np.exp(patches.mean(np.log(np.maximum(self.color, FLOOR))))
        lobe = None if self.lobe is None else patches.mean(self.lobe)
        return Points(
            self.position, self.normal, color, patches.mean(self.bounced), patches.mean(self.transport), lobe
        )


@dataclass(frozen=True)
class Light:
    """A fitted light, in the unit of the points' colours.

    Attributes:
        texels: (D, 3) float32 radiance of the cubemap.
        sun: (3,) float32 irradiance / pi of the sun on a surface that faces it; 0 without.
        loss: of the last step.
    """

    texels: np.ndarray
    sun: np.ndarray
    loss: float

    def irradiance(self, points: Points) -> np.ndarray:
        """(P, 3) float32 irradiance / pi of direct light at the points."""
        direct = points.transport @ self.texels
        return direct if points.lobe is None else direct + points.lobe[:, None] * self.sun


def fit_light(
    points: Points,
    settings: LightSettings,
    seed: int,
    sky: PhotographedSky | None = None,
    begin: Light | None = None,
) -> Light:
    """Fit the light of points.

    Args:
        points: at least ten, all of them seen.
        settings: sizes, steps, and the weights that are chosen.
        seed: root of the pairs.
        sky: radiance of the cubemap's directions as the photos show it; None: they show none.
        begin: light whose sun to begin with.

    Raises:
        TooFewSeen: too few points.
        TronError: the loss is not finite.
    """
    if len(points.position) < 10:
        raise TooFewSeen(
            f"{len(points.position)} surfels are seen by two photos or more, too few to find the light",
            mend="check cameras and masks",
        )
    fit = _Fit(points, settings, seed, sky, begin)
    for number in range(settings.rounds):
        fit.draw_pairs(number)
        for _ in range(settings.steps):
            fit.step()
    return fit.result()


class _Fit:
    """Adam with derivatives by hand: the problem is small, and autograd was most of a step.

    Unknowns are rows of three: of each texel of each level log luminance and the chromas log R / G and
    log B / G; the last row is the log of the sun, (R, G, B). Arrays are float32.
    """

    def __init__(
        self,
        points: Points,
        settings: LightSettings,
        seed: int,
        sky: PhotographedSky | None,
        begin: Light | None,
    ) -> None:
        self.settings, self.seed = settings, seed
        self.transport, self.bounced = _single(points.transport), _single(points.bounced)
        self.log_color = _single(np.log(np.maximum(points.color, FLOOR)))
        self.lobe = None if points.lobe is None else _single(points.lobe)[:, None]
        finest = settings.resolution
        levels = [m for m in (1, 2, 4, 8, 16) if m < finest] + [finest]
        texels = 6 * finest * finest
        self.spread = _single(
            np.concatenate([np.zeros((texels, 0)), *(_spread(finest, m) for m in levels[:-1])], 1)
        )
        sizes = [6 * m * m for m in levels]
        self.fine = _single(np.repeat([_SMOOTH * 2.0**k / n for k, n in enumerate(sizes, -1)], sizes))
        self.fine[: sizes[0]] = 0
        self.grey = _single(settings.grey / np.repeat(sizes, sizes))[:, None]
        self.grey[: sizes[0]] *= 0.05
        self.values: np.ndarray = np.zeros((len(self.fine) + 1, 3), np.float32)
        mean = float(self.log_color.mean())
        self.values[: sizes[0], 0] = mean + 1.0  # as bright as the mean point asks for
        first = np.full(3, 0.3 * np.exp(mean)) if begin is None else begin.sun
        self.values[-1] = np.log(np.maximum(first, 1e-6))
        self.rates = np.full_like(self.values, _RATE)
        self.rates[:-1, 1:] *= 0.4
        self.moments = np.zeros((2, *self.values.shape), np.float32)
        self.count = 0
        size = np.ptp(points.position, axis=0).max()
        place = np.concatenate([points.position / size, _TURN * points.normal], 1)
        self.near = np.asarray(KDTree(place).query(place, k=min(_NEARBY, len(place)))[1])
        facing = KDTree(points.normal).query_ball_point(points.normal, 0.3, return_length=True)
        self.rare = 1 / np.sqrt(facing)
        # How much of the points' light could come from a direction, against an open sphere of points: 1/4.
        _, solid = cube_texels(settings.resolution)
        share = points.transport.mean(0) / (solid / np.pi)
        self.unseen = _single(np.exp(-share / 0.02))
        self.sky = None
        if sky is not None and sky.trust.any():
            self.sky = _single(np.log(np.maximum(sky.radiance, FLOOR))), _single(sky.trust)[:, None]
        self.loss = float("nan")

    def log_light(self) -> np.ndarray:
        """(D, 3) log radiance."""
        coarse, finest = np.split(self.values[:-1] @ _TO_LOG_RGB, [self.spread.shape[1]])
        return self.spread @ coarse + finest

    def received(self) -> np.ndarray:
        """(P, 3) irradiance / pi under the current light."""
        received = self.transport @ np.exp(self.log_light()) + self.bounced
        return received if self.lobe is None else received + self.lobe * np.exp(self.values[-1])

    def log_base_color(self, received: np.ndarray) -> np.ndarray:
        """(P, 3) of points that receive that."""
        return self.log_color - np.log(np.maximum(received, _LEAST))

    def draw_pairs(self, number: int) -> None:
        """Draw partners of all points by the current base color."""
        draw = generator(self.seed, "joint light", "pairs", number)
        base = self.log_base_color(self.received())
        chroma = base[:, [0, 2]] - base[:, 1:2]
        count = len(base)
        alike = np.asarray(KDTree(chroma).query(chroma, k=min(_SIMILAR, count))[1])
        i = np.repeat(np.arange(count), _PARTNERS)
        partners = [table[i, draw.integers(1, table.shape[1], len(i))] for table in (self.near, alike)]
        i, j = np.tile(i, 2), np.concatenate(partners)
        weight = np.repeat([1.0, 0.5], len(i) // 2) * (self.rare[i] + self.rare[j])
        weight *= np.exp(-(((chroma[i] - chroma[j]) / ALIKE) ** 2).sum(1))
        self.weight = _single(weight / weight.sum())[:, None] / 3
        signs = np.tile(np.array([1, -1], np.float32), len(i))
        both = np.stack([i, j], 1).ravel(), np.arange(0, 2 * len(i) + 1, 2)
        self.apart = csr_array((signs, *both), shape=(len(i), count))  # the first's value less the second's
        self.together = self.apart.T.tocsr()

    def step(self) -> None:
        """Take one step of Adam."""
        self.loss, gradient = self.misfit()
        if not np.isfinite(self.loss):
            raise TronError(f"the loss of the light is {self.loss}")
        self.count += 1
        for moment, power, forget in zip(self.moments, (gradient, gradient**2), _FORGET):
            moment += (1 - forget) * (power - moment)
        mean, square = (each / (1 - forget**self.count) for each, forget in zip(self.moments, _FORGET))
        self.values -= self.rates * mean / (np.sqrt(square) + 1e-8)

    def misfit(self) -> tuple[float, np.ndarray]:
        """The loss, and its derivatives by the unknowns."""
        light, received = self.log_light(), self.received()
        base = self.log_base_color(received)
        off = self.apart @ base
        far = 1 + np.abs(off) / ROBUST
        loss = float((self.weight * ROBUST * np.log(far)).sum())
        by_base = self.together @ (self.weight * np.sign(off) / far)

        brightest = base.max(1)
        place = _PERCENTILE / 100 * (len(base) - 1)
        lower = min(int(place), len(base) - 2)
        ranked = np.argpartition(brightest, (lower, lower + 1))[lower : lower + 2]
        shares = np.array([lower + 1 - place, place - lower], np.float32)
        above = float(shares @ brightest[ranked]) - float(np.log(self.settings.brightest))
        loss += self.settings.scale * above**2
        by_base[ranked, base[ranked].argmax(1)] += 2 * self.settings.scale * above * shares
        by_received = np.where(received > _LEAST, -by_base / np.maximum(received, _LEAST), 0)

        by_light = np.exp(light) * (self.transport.T @ by_received)
        brightness = light.mean(1)
        bright = brightness - np.log(np.exp(brightness).mean()) - np.float32(np.log(_DARKNESS))
        loss += _DARK * float((self.unseen * bright**2).mean())
        by_light += (2 * _DARK / 3 / len(light) * self.unseen * bright)[:, None]  # of a mean that is held
        if self.sky is not None:
            shown, trust = self.sky
            far = 1 + np.abs(light - shown)
            loss += _SKY * float((trust * np.log(far)).mean())
            by_light += _SKY / light.size * trust * np.sign(light - shown) / far

        gradient, levels = np.zeros_like(self.values), self.values[:-1]
        gradient[:-1] = np.concatenate([self.spread.T @ by_light, by_light]) @ _TO_LOG_RGB.T
        coloured = self.grey * (levels[:, 1:] @ _OFF_GREY)
        loss += float((self.fine * levels[:, 0] ** 2).sum() + (coloured * levels[:, 1:]).sum())
        gradient[:-1, 0] += 2 * self.fine * levels[:, 0]
        gradient[:-1, 1:] += 2 * coloured
        if self.lobe is not None:
            gradient[-1] = (self.lobe * by_received).sum(0) * np.exp(self.values[-1])
        return loss, gradient

    def result(self) -> Light:
        sun = np.zeros(3, np.float32) if self.lobe is None else np.exp(self.values[-1])
        return Light(np.exp(self.log_light()), sun, self.loss)


def _single(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, np.float32)


def _spread(fine: int, coarse: int) -> np.ndarray:
    """(6 fine^2, 6 coarse^2): a smooth blend of the coarse texels at each fine one; rows sum to 1."""
    cosine = cube_texels(fine)[0] @ cube_texels(coarse)[0].T
    width = 1.1 * np.sqrt(4 * np.pi / (6 * coarse * coarse))
    weight = np.exp(-((np.arccos(np.clip(cosine, -1, 1)) / width) ** 2))
    return weight / weight.sum(1, keepdims=True)


@dataclass(frozen=True, eq=False)
class Patches:
    """A patch about each of P points: those that lie together, face alike and have like colour.

    Normals of reconstructed surfaces are ten degrees wrong from one surfel to the next, and a light fitted to
    them point by point is flattened. Light that arrives is linear in the normal and in visibility, so its
    mean over a patch keeps what the surfels have in common and loses their noise; so does the mean log
    colour.

    Attributes:
        weights: (P, P) sparse, rows sum to 1.
    """

    weights: csr_array

    @classmethod
    def of(cls, position: np.ndarray, normal: np.ndarray, color: np.ndarray, radius: float) -> Patches:
        """Patches by place, facing and chromaticity, each weighted smoothly.

        Args:
            position, normal: (P, 3) world, normals unit.
            color: (P, 3) linear, positive.
            radius: standard deviation in space, world units; 0 leaves each point alone.
        """
        count = len(position)
        if radius <= 0 or count < 2:
            alone = (np.ones(count, np.float32), (np.arange(count), np.arange(count)))
            return cls(csr_array(alone, shape=(count, count)))
        distance, near = map(np.asarray, KDTree(position).query(position, k=min(_MOST, count)))
        log = np.log(color)
        chroma = log[:, [0, 2]] - log[:, 1:2]
        facing = np.einsum("pkc,pc->pk", normal[near], normal)
        weight = np.exp(-0.5 * (distance / radius) ** 2) * np.clip((facing - _FACING) / (1 - _FACING), 0, 1)
        weight *= np.exp(-((chroma[near] - chroma[:, None]) ** 2).sum(-1) / ALIKE**2)
        weight /= weight.sum(1, keepdims=True)  # each point is its own nearest, and weighs 1
        rows = np.repeat(np.arange(count), near.shape[1])
        entries = (weight.ravel().astype(np.float32), (rows, near.ravel()))
        return cls(csr_array(entries, shape=(count, count)))

    def mean(self, values: np.ndarray) -> np.ndarray:
        """(P, ...) mean of values (P, ...) over the patches."""
        columns = values.reshape(len(values), math.prod(values.shape[1:]))
        return (self.weights @ columns).reshape(values.shape)
