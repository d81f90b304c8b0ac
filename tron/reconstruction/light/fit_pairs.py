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
import torch
from pydantic import Field
from scipy.sparse import csr_array
from scipy.spatial import KDTree
from torch import Tensor

from tron.captures.view import FLOOR
from tron.errors import TronError
from tron.reconstruction.light.sky_visibility import PhotographedSky, cube_texels
from tron.reconstruction.settings import Settings
from tron.runtime import torch_device
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
    def __init__(
        self,
        points: Points,
        settings: LightSettings,
        seed: int,
        sky: PhotographedSky | None,
        begin: Light | None,
    ) -> None:
        device = torch_device()

        def tensor(values: np.ndarray) -> Tensor:
            return torch.tensor(np.ascontiguousarray(values), dtype=torch.float32, device=device)

        self.settings, self.seed, self.tensor = settings, seed, tensor
        self.transport, self.bounced = tensor(points.transport), tensor(points.bounced)
        self.log_color = tensor(np.log(np.maximum(points.color, FLOOR)))
        self.lobe = None if points.lobe is None else tensor(points.lobe)[:, None]
        finest = settings.resolution
        levels = [m for m in (1, 2, 4, 8, 16) if m < finest] + [finest]
        self.ups = [tensor(_spread(finest, m)) for m in levels[:-1]]
        sizes = [6 * m * m for m in levels]
        self.grey = [torch.zeros(n, 1, device=device, requires_grad=True) for n in sizes]
        self.chroma = [torch.zeros(n, 2, device=device, requires_grad=True) for n in sizes]
        with torch.no_grad():  # as bright as the mean point asks for
            self.grey[0] += float(self.log_color.mean()) + 1.0
        first = (
            np.full(3, 0.3 * float(np.exp(self.log_color.mean().cpu().numpy())))
            if begin is None
            else begin.sun
        )
        self.sun = tensor(np.log(np.maximum(first, 1e-6))).requires_grad_(True)
        groups = [
            {"params": [*self.grey, self.sun], "lr": _RATE},
            {"params": self.chroma, "lr": 0.4 * _RATE},
        ]
        self.adam = torch.optim.Adam(groups)
        size = np.ptp(points.position, axis=0).max()
        place = np.concatenate([points.position / size, _TURN * points.normal], 1)
        self.near = np.asarray(KDTree(place).query(place, k=min(_NEARBY, len(place)))[1])
        facing = KDTree(points.normal).query_ball_point(points.normal, 0.3, return_length=True)
        self.rare = 1 / np.sqrt(facing)
        # How much of the points' light could come from a direction, against an open sphere of points: 1/4.
        _, solid = cube_texels(settings.resolution)
        share = points.transport.mean(0) / (solid / np.pi)
        self.unseen = tensor(np.exp(-share / 0.02))
        self.sky = None
        if sky is not None and sky.trust.any():
            self.sky = tensor(np.log(np.maximum(sky.radiance, FLOOR))), tensor(sky.trust)
        self.loss = float("nan")

    def log_light(self) -> Tensor:
        """(D, 3) log radiance."""
        grey, chroma = (_composed(levels, self.ups) for levels in (self.grey, self.chroma))
        return torch.cat([grey + chroma[:, :1], grey, grey + chroma[:, 1:]], 1)

    def log_base_color(self) -> Tensor:
        """(P, 3) of the current light."""
        received = self.transport @ torch.exp(self.log_light()) + self.bounced
        if self.lobe is not None:
            received = received + self.lobe * torch.exp(self.sun)
        return self.log_color - torch.log(received.clamp(min=1e-5))

    def draw_pairs(self, number: int) -> None:
        """Draw partners of all points by the current base color."""
        draw = generator(self.seed, "joint light", "pairs", number)
        with torch.no_grad():
            base = self.log_base_color().cpu().numpy()
        chroma = base[:, [0, 2]] - base[:, 1:2]
        count = len(base)
        alike = np.asarray(KDTree(chroma).query(chroma, k=min(_SIMILAR, count))[1])
        i = np.repeat(np.arange(count), _PARTNERS)
        partners = [table[i, draw.integers(1, table.shape[1], len(i))] for table in (self.near, alike)]
        i, j = np.tile(i, 2), np.concatenate(partners)
        weight = np.repeat([1.0, 0.5], len(i) // 2) * (self.rare[i] + self.rare[j])
        weight *= np.exp(-(((chroma[i] - chroma[j]) / ALIKE) ** 2).sum(1))
        # By point: the first of a pair then needs no gather, whose adjoint is the slowest part of a step.
        shape = (2, count, _PARTNERS)
        j, weight = (np.moveaxis(values.reshape(shape), 0, 1).reshape(count, -1) for values in (j, weight))
        self.partner = torch.from_numpy(j.ravel()).to(self.log_color.device)
        self.weight = self.tensor(weight / weight.sum())[..., None] / 3

    def step(self) -> None:
        """Take one step of Adam."""
        light, base = self.log_light(), self.log_base_color()
        off = (base[:, None] - base.index_select(0, self.partner).view(*self.weight.shape[:2], 3)).abs()
        loss = (self.weight * ROBUST * torch.log1p(off / ROBUST)).sum()
        loss = loss + _SMOOTH * sum((z**2).mean() * 2.0**k for k, z in enumerate(self.grey[1:]))
        loss = loss + self.settings.grey * sum(_coloured(z) for z in self.chroma[1:])
        loss = loss + self.settings.grey * 0.05 * _coloured(self.chroma[0])
        bright = torch.quantile(base.amax(1), _PERCENTILE / 100)
        loss = loss + self.settings.scale * (bright - float(np.log(self.settings.brightest))) ** 2
        brightness = light.mean(1)
        mean = torch.log(torch.exp(brightness).mean()).detach()
        above = (brightness - mean - float(np.log(_DARKNESS))) ** 2
        loss = loss + _DARK * (self.unseen * above).mean()
        if self.sky is not None:
            shown, trust = self.sky
            loss = loss + _SKY * (trust[:, None] * torch.log1p((light - shown).abs())).mean()
        self.adam.zero_grad()
        loss.backward()
        self.loss = float(loss.detach())
        if not np.isfinite(self.loss):
            raise TronError(f"the loss of the light is {self.loss}")
        self.adam.step()

    def result(self) -> Light:
        with torch.no_grad():
            texels = torch.exp(self.log_light()).cpu().numpy()
            sun = torch.exp(self.sun).cpu().numpy() if self.lobe is not None else np.zeros(3, np.float32)
        return Light(texels, sun, self.loss)


def _coloured(chroma: Tensor) -> Tensor:
    """Mean square of log colours (N, 2), those off the line of black bodies counted more."""
    off = chroma @ chroma.new_tensor([-_WARM[1], _WARM[0]])
    return (chroma**2).mean() + 0.5 * (_OFF_WARM**2 - 1) * (off**2).mean()


def _composed(levels: list[Tensor], ups: list[Tensor]) -> Tensor:
    total = levels[-1]
    for up, level in zip(ups, levels[:-1], strict=True):
        total = total + up @ level
    return total


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
