"""Sky from the photos themselves: where nothing stands in the way, a pixel shows the environment's radiance.

Pixels of the views' sky masks, and those without surfels of views without masks (behind a masked subject
nobody knows what there is), are brought to one exposure and gathered on a cubemap's texels, each the median
of its pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from tron.aligned import aligned
from tron.captures import View
from tron.priors import Track, untracked
from tron.priors.linear_light import ToneCurve, linear_light
from tron.reconstruction.evidence import grouped_median
from tron.reconstruction.surface_points import SKY
from tron.seeds import generator
from tron.shading.cubemap import direction_face
from tron.shading.guidance import ViewTracer

_EMPTY = 0.05  # opacity below which a pixel shows what lies behind the scene
_PER_VIEW = 20_000
_BELIEVED = 20.0  # pixels that a texel needs to be half believed


@dataclass(frozen=True)
class PhotographedSky:
    """Radiance of D texels of a cubemap, as photos show it.

    Attributes:
        radiance: (D, 3) linear, in the unit of the photos; 0 where none shows it.
        trust: (D,) in [0, 1].
    """

    radiance: np.ndarray
    trust: np.ndarray


def photographed_sky(
    tracer: ViewTracer,
    views: Sequence[View],
    gains: np.ndarray,
    exposure: float,
    curve: ToneCurve,
    resolution: int,
    seed: int,
    track: Track = untracked,
) -> PhotographedSky:
    """Gather the sky of photos.

    Args:
        tracer: the surfels.
        views: the photos. gains: (V, 3) exposure of each.
        exposure: of linear images. curve: of display images.
        resolution: texels along a face edge.
        seed: root of the choice among a view's pixels.
        track: wraps the loop over the views.
    """
    texels, colors = [np.zeros(0, int)], [np.zeros((0, 3))]
    for view, gain in zip(track(views, "sky"), gains, strict=True):
        if view.has("sky_mask"):
            open_sky = view.read("sky_mask") >= SKY
        elif view.has("mask"):
            continue
        else:
            open_sky = tracer.gbuffer(view.camera).numpy()["opacity"] < _EMPTY
        empty = np.flatnonzero(open_sky & view.believed())
        draw = generator(seed, "photographed sky", view.name)
        empty = draw.permutation(empty)[:_PER_VIEW]
        texels.append(_texel(view.camera.rays().reshape(-1, 3)[empty], resolution))
        colors.append(linear_light(view, exposure, curve).reshape(-1, 3)[empty] / gain)
    texel, color = np.concatenate(texels), np.concatenate(colors)
    order = np.argsort(texel, kind="stable")
    count = np.bincount(texel, minlength=6 * resolution**2)
    radiance = grouped_median(color[order], texel[order], 6 * resolution**2)
    return PhotographedSky(radiance, count / (count + _BELIEVED))


def _texel(directions: np.ndarray, resolution: int) -> np.ndarray:
    """(N,) numbers of the texels that unit world directions (N, 3) lie in."""
    if not len(directions):
        return np.zeros(0, int)
    lanes = mi.Vector3f(*[mi.Float(aligned(column.astype(np.float32))) for column in directions.T])
    face, u, v = (np.array(value) for value in direction_face(lanes))
    column, row = (np.clip(((value + 1) / 2 * resolution).astype(int), 0, resolution - 1) for value in (u, v))
    return (face.astype(int) * resolution + row) * resolution + column
