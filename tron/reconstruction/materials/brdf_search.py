"""Material of each surfel from its colours over many views, in known light.

For a roughness r and a metallic m of 0 or 1, a surfel's radiance towards a camera grows with its base color
b (:mod:`tron.shading.composition`, with E + I received, o S + I mirrored by the lobe of r):

    m = 0    c = b (1 - k) (E + I) + k (o S + I)        k = G g(F_glass), of :mod:`tron.brdf.reflectance`
    m = 1    c = (b A + B) g(F_b) (o S + I)

so each photo of the surfel gives a b for each candidate (r, m). The median of these is the candidate's base
color, and the candidate that explains all photos best is chosen. A highlight that moves with the camera is
explained only by a lobe of its width. A surfel without highlight is explained by all candidates equally;
then its neighbours of similar colour decide, because losses are summed over them. If these do not decide
either, the material is a dielectric of ``prior_roughness``.

A dark glossy dielectric looks like a dark mirror, but no metal is dark: iron, among the darkest, reflects
0.56. So a metal must be bright, in the unit in which mean irradiance over the seen surfels is 1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import KDTree

from tron.brdf.reflectance import compensation, glass_fresnel, lobe_parts, mean_fresnel
from tron.brdf.table import BrdfTable
from tron.captures.view import FLOOR
from tron.color import luminance
from tron.gaussians import GaussianScene
from tron.reconstruction.light.surfel_colors import Observations, SurfelColors, grouped_median
from tron.runtime import aligned, lanes
from tron.shading.lighting import Lighting

ROUGHNESSES = np.array([0.15, 0.25, 0.35, 0.5, 0.7, 0.95])
"""Candidate roughnesses."""
_ROBUST = 0.1  # log difference beyond which an observation is doubted
_DARK = 0.1  # share of the mean colour that is added before logarithms: the dark is noise
_LIKE = 24  # neighbours that decide together
_CHROMA = 0.3  # log colour that counts as one spacing between neighbours
_CERTAIN = 0.02  # mean loss by which a material must be better to be e times as likely
_PRIOR = 0.02  # loss of a roughness at 1 from the prior's
_METAL_LOSS = 0.06  # loss of a polished metal: few things are one
_ROUGH_METAL_LOSS = 5.0
"""Additional loss of a metal of roughness 1 over a polished one: it looks like paint, and in slightly wrong
light fur looks like it."""
_METAL_LUMINANCE = 0.2  # a stop and a half below iron: cameras do not expose exactly
_HALVINGS = 12
_METAL_COLOR = 0.7
_DARK_METAL_LOSS = 0.3
"""Loss of a metal e times darker than that; it grows with the square of the logarithm."""


@dataclass(frozen=True)
class Received:
    """Light at M surfels, linear, / pi, in the unit of the observations.

    Attributes:
        direct: (M, 3) shadowed irradiance of the environment.
        unshadowed: (M, 3) unshadowed irradiance of the environment.
        bounced: (M, 3) irradiance of bounced light.
        openness: (M,) share of directions in which no surfel is met.
    """

    direct: np.ndarray
    unshadowed: np.ndarray
    bounced: np.ndarray
    openness: np.ndarray

    @property
    def total(self) -> np.ndarray:
        """(M, 3) direct and bounced irradiance."""
        return self.direct + self.bounced

    def balanced(self, balance: np.ndarray) -> Received:
        """The light of an environment divided by ``balance`` (3,); bounced light is unchanged."""
        return replace(self, direct=self.direct / balance, unshadowed=self.unshadowed / balance)


@dataclass(frozen=True)
class Materials:
    """Materials of M surfels.

    Attributes:
        base_color: (M, 3) float32, linear, not limited to 1.
        roughness, metallic: (M,) float32 in [0, 1].
        confidence: (M,) float32 in [0, 1]: how far the photos, not priors, decided roughness and metallic.
    """

    base_color: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray
    confidence: np.ndarray


def materials_of(
    scene: GaussianScene,
    found: Observations,
    colors: SurfelColors,
    lighting: Lighting,
    received: Received,
    prior_roughness: float,
) -> Materials:
    """Choose each surfel's material; surfels without photo follow their neighbours.

    Args:
        scene: geometry.
        found: observations of its surfels.
        colors: mean colours of its surfels.
        lighting: the light, in the observations' unit.
        received: its light at the surfels.
        prior_roughness: roughness if photos decide nothing.
    """
    color = found.color / colors.gain[found.view]
    dark = _DARK * float(color.mean())
    surfel, count = found.surfel, found.surfels
    total = received.total[surfel]
    share = np.clip(received.direct / np.maximum(received.unshadowed, 1e-6), 0, 1)
    normal = scene.normals()[surfel]
    cosine = np.einsum("nc,nc->n", normal, found.to_camera)
    bases, losses = [], []
    for metal in (False, True):
        for roughness in ROUGHNESSES:
            scale, bias, glass, whole = _table(roughness, cosine)
            open_ = received.openness[:, None] * (1 - roughness) + roughness * share
            lobe = (
                open_[surfel] * _reflected(lighting, normal, found.to_camera, roughness, metal)
                + received.bounced[surfel]
            )
            lobe = np.maximum(lobe, 1e-5)
            if metal:
                each = _metal_of(color / lobe, scale[:, None], bias[:, None], whole[:, None])
            else:
                coat = glass * compensation(np.array(glass_fresnel()), scale + bias, whole)
                each = (color - coat[:, None] * lobe) / np.maximum((1 - coat[:, None]) * total, 1e-5)
            base = np.clip(grouped_median(each, surfel, count), 0, 2)
            of = base[surfel]
            if metal:
                wanted = _metal(of, scale[:, None], bias[:, None], whole[:, None]) * lobe
            else:
                wanted = of * (1 - coat[:, None]) * total + coat[:, None] * lobe
            off = np.abs(np.log((color + dark) / (wanted + dark))).mean(1)
            loss = np.bincount(surfel, np.log1p(off / _ROBUST), count)
            bases.append(base)
            losses.append(loss)
    white = received.total[colors.seen].mean(0)
    return choose(scene, colors, np.stack(bases), np.stack(losses), prior_roughness, white)


def choose(
    scene: GaussianScene,
    colors: SurfelColors,
    bases: np.ndarray,
    losses: np.ndarray,
    prior_roughness: float,
    white: np.ndarray,
) -> Materials:
    """The materials of M surfels among K candidates, dielectrics of all roughnesses before metals.

    Args:
        scene: geometry.
        colors: of its surfels.
        bases: (K, M, 3) base color of each candidate.
        losses: (K, M) loss of each, summed over the surfel's photos.
        prior_roughness: roughness if photos decide nothing.
        white: (3,) mean irradiance / pi over the seen surfels.
    """
    seen = np.flatnonzero(colors.seen)
    log = np.log(np.maximum(colors.color, FLOOR))
    place = np.concatenate([scene.means / scene.spacing, log / _CHROMA], 1)
    # Surfels without photo have no colour: only place determines their neighbours.
    like = _nearest(place[seen], place)
    blind = np.flatnonzero(~colors.seen)
    if len(blind):
        like[blind] = _nearest(scene.means[seen], scene.means[blind])
    like = seen[like]
    count = np.maximum(colors.count[like].sum(1), 1)
    mean = losses[:, like].sum(-1) / count
    roughness = np.tile(ROUGHNESSES, 2)
    metallic = np.repeat([0.0, 1.0], len(ROUGHNESSES))
    prior = _PRIOR * (roughness - prior_roughness) ** 2
    prior = prior + _METAL_LOSS * (1 + _ROUGH_METAL_LOSS * roughness**2) * metallic
    bright = luminance(np.maximum(bases[metallic > 0] * white, FLOOR))[:, like].mean(-1)
    dark = np.maximum(np.log(_METAL_LUMINANCE / bright), 0)
    score = mean + prior[:, None]
    score[metallic > 0] += _DARK_METAL_LOSS * dark**2
    weight = np.exp(-(score - score.min(0)) / _CERTAIN)
    weight /= weight.sum(0)
    own = np.exp(-(prior - prior.min()) / _CERTAIN)
    own /= own.sum()
    told = 0.5 * np.abs(weight - own[:, None]).sum(0)
    # Base color is the surfel's own; without photo, its neighbours'.
    base = np.einsum("km,kmc->mc", weight, bases)
    if len(blind):
        base[blind] = base[like[blind]].mean(1)
    return Materials(
        base.astype(np.float32),
        (roughness @ weight).astype(np.float32),
        (metallic @ weight).astype(np.float32),
        told.astype(np.float32),
    )


def _metal(base: np.ndarray, scale: np.ndarray, bias: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Albedo of metal, with base color clamped below 1 for the compensation."""
    fresnel = mean_fresnel(np.clip(base, 0, 1))
    return (base * scale + bias) * compensation(fresnel, scale + bias, whole)


def _metal_of(albedo: np.ndarray, scale: np.ndarray, bias: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Base color of metal that has an albedo, by halving: :func:`_metal` grows with it."""
    low, high = np.zeros_like(albedo), np.full_like(albedo, 2.0)
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        below = _metal(middle, scale, bias, whole) < albedo
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return (low + high) / 2


def _nearest(of: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(N, K) indices of the nearest of some places to others."""
    return np.reshape(KDTree(of).query(places, k=min(_LIKE, len(of)))[1], (len(places), -1))


def _table(roughness: float, cosine: np.ndarray) -> list[np.ndarray]:
    """A, B, G and E of :mod:`tron.brdf.table`, (N,) each."""
    table = BrdfTable.load()
    along = mi.Float(aligned(np.clip(cosine, 0, 1).astype(np.float32)))
    return [np.array(value) for value in table(dr.full(mi.Float, float(roughness), len(cosine)), along)]


def _reflected(
    lighting: Lighting, normal: np.ndarray, to_camera: np.ndarray, roughness: float, metal: bool
) -> np.ndarray:
    """(N, 3) mean radiance over lobes; how far they lean hardly depends on a metal's base color."""
    material = SimpleNamespace(
        base_color=mi.Color3f(_METAL_COLOR),
        roughness=dr.opaque(mi.Float, float(roughness)),
        metallic=mi.Float(float(metal)),
    )
    split_sum, ends = lighting.split_sum, (lanes(mi.Vector3f, normal), lanes(mi.Vector3f, to_camera))
    return np.array(split_sum.averaged(lobe_parts(material, split_sum.brdf, *ends))).T
