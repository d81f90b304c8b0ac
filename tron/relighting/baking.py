"""The light of a relit scene as spherical harmonics, which every 3DGS viewer draws.

Each surfel is shaded at its centre towards directions of the hemisphere before it, by the formula of frames
(:mod:`tron.shading.composition`): what reaches it of the environment, shadows included, what has bounced, and
the split-sum lobe with the share of it that leaves the scene. The pictures' exposure and AgX make display
values of that, which are what 3DGS stores, and harmonics of degree 3 are fitted to them by least squares.

Directions stand in the frame of each surfel's normal, so that one matrix fits all surfels; its coefficients
are turned into the world. Weights are cosines, the areas of surfels in pictures. No camera of ours sees the
back of a surfel, but other viewers draw it at silhouettes: there the fit is drawn, with a small weight, to
what the mirrored direction shows.

Degree 3 tells lobes of some 60 degrees apart: reflections of a rough metal stay, those of a mirror are lost.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.color import Look, to_display
from tron.errors import TronError
from tron.gaussians.harmonics import SH_COUNT, rotate_sh, sh_matrix, spread_directions
from tron.gaussians.scene import GaussianScene
from tron.relighting.relighter import Illumination
from tron.seeds import integer
from tron.shading.bounces.bounce import EVEN, at_surfels
from tron.shading.burley import terms_of_mean
from tron.shading.composition import Response, evenly_bounced
from tron.tracing.surface import Surface

DIRECTIONS = 64
"""Directions of the hemisphere that a surfel is shaded towards."""
RAYS = 256
"""Shadow rays of a surfel, which lends none: a mean of neighbours blurs what is no sharper than surfels."""
BACK_WEIGHT = 0.01
"""Of what the back shows, beside the cosine of the front."""
_TURNED_AT_ONCE = 8192


def baked(
    light: Illumination,
    exposure: float,
    look: Look = "photograph",
    track: Callable[[range], Iterable[int]] = iter,
) -> GaussianScene:
    """The scene of a relighter with a light's radiance as its harmonics; all else stays as it is.

    Args:
        light: the scene under a light that bounces.
        exposure: factor on linear radiance before AgX.
        look: of the picture.
        track: wraps the loop over directions, to show progress.

    Raises:
        TronError: nothing bounces in the estimation of ``light``.
    """
    surface, share, mean = _arriving(light)
    local = mi.Frame3f(mi.Vector3f(surface.normal))
    dr.eval(local)
    directions, fit = _fit()
    scene = light.relighter.scene
    sh = np.zeros((len(scene), SH_COUNT, 3), np.float32)
    for number in track(range(len(directions))):
        along = mi.Vector3f(*(float(axis) for axis in directions[number]))
        dr.make_opaque(along)
        surface.direction = local.to_world(along)
        radiance = _radiance(light, surface, share, mean)
        display = np.asarray(to_display(radiance, np.float32(exposure), look=look))
        sh += fit[:, number, None] * (display[:, None] - np.float32(0.5))
    frames = np.stack([np.array(axis).T for axis in (local.s, local.t, local.n)], axis=-1)
    for start in range(0, len(scene), _TURNED_AT_ONCE):
        part = slice(start, start + _TURNED_AT_ONCE)
        sh[part] = rotate_sh(sh[part], frames[part])
    return replace(scene, sh=sh)


def _arriving(light: Illumination) -> tuple[Surface, mi.Color3f, mi.Vector3f]:
    """The surfels with what has bounced, the share of the light that reaches each, and its mean direction."""
    bounced = light.bounced
    if bounced is None:
        raise TronError("a light that does not bounce cannot be baked", mend="give bounces=1 or more")
    estimation = at_surfels(light.estimation).model_copy(update={"rays": RAYS})
    seed = integer(light.seed, "baking")
    reaching = light.relighter.transport.reaching(light.lighting, estimation, seed, lent=False)
    surface = light.relighter.surfels([*bounced.indirect, bounced.openness, *reaching])
    *share, x, y, z = surface.values[EVEN:]
    dr.eval(surface)
    return surface, mi.Color3f(*share), mi.Vector3f(x, y, z)


def _radiance(light: Illumination, surface: Surface, share: mi.Color3f, mean: mi.Vector3f) -> np.ndarray:
    """(M, 3) linear radiance of the surfels along ``surface.direction``, as frames without rays have it."""
    diffuse, normal = light.estimation.diffuse, mi.Vector3f(surface.normal)
    terms = None if diffuse == "lambert" else terms_of_mean(normal, surface.direction, mean)
    response = Response.of(surface, light.lighting.split_sum, diffuse, terms)
    bounced = evenly_bounced(
        mi.Color3f(*surface.values[:3]), surface.values[EVEN - 1], share, surface.roughness
    )
    radiance = response.lit(response.unshadowed * share, bounced)
    dr.eval(radiance)
    return np.array(radiance).T


@cache
def _fit() -> tuple[np.ndarray, np.ndarray]:
    """Directions (K, 3), normal +z, that look at a surfel, and the (16, K) float32 fit of what they see."""
    spread = spread_directions(2 * DIRECTIONS)
    front = spread[spread[:, 2] < 0]
    seen, mirrored = sh_matrix(front), sh_matrix(front * (1, 1, -1))
    weight = -front[:, 2:]
    gram = seen.T @ (weight * seen) + BACK_WEIGHT * mirrored.T @ mirrored
    return front, np.linalg.solve(gram, (weight * seen + BACK_WEIGHT * mirrored).T).astype(np.float32)
