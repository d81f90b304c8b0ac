"""What each method shows for a clip: the seven baselines and the neural renderer, as displayed images."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from eval.relighting.baselines import (
    AffineBlend,
    AffineFit,
    ScaleFit,
    over_environment,
    product_terms,
    shadow_ratio,
)
from tron.color import to_display
from tron.errors import TronError
from tron.seeds import generator
from tron.shards.schema import Clip

Region = Literal["foreground", "frame"]
REGIONS: tuple[Region, Region] = ("foreground", "frame")
SURFACES = ("affine", "affine_ratio", "pixel_mlp")
"""Methods that know surfaces alone, and get pbr's sky on full frames."""
MEMBERS = ("pbr", "irradiance", "rgb", "unshadowed", "shadowed", "mask", "foreground")
"""Members of a clip that predictions and their scores need."""


@dataclass(frozen=True)
class Fits:
    """What the fitted baselines learned from the foreground of training frames."""

    scale: float
    affine: AffineBlend
    affine_ratio: AffineBlend
    n_frames: int


def displayed_truth(clip: Clip) -> np.ndarray:
    """The clip's rgb as displayed, (K, H, W, 3) in [0, 1]; captured photos are display-referred already."""
    rgb = clip.frames["rgb"]
    if clip.meta.color_space.get("rgb", "linear") == "display":
        return rgb
    return to_display(rgb, clip.meta.exposure)


def region_mask(clip: Clip, region: Region) -> np.ndarray:
    """Pixels of a region, (K, H, W) bool: the ground-truth foreground, or the whole frame."""
    foreground = clip.frames["foreground"][..., 0] > 0.5
    return foreground if region == "foreground" else np.ones_like(foreground)


def fit_baselines(clips: Iterable[Clip], seed: int, scale_pixels: int = 512) -> Fits:
    """Fit s and the two affine blends on the foreground of training clips.

    Args:
        clips: the training split, read once, one clip in memory at a time.
        seed: of the choice of pixels for s.
        scale_pixels: pixels of a frame that s is fitted on; the blends use the whole foreground.

    Raises:
        TronError: there are no training clips.
    """
    scale, affine, affine_ratio, n_frames = ScaleFit(), AffineFit(2), AffineFit(3), 0
    for clip in clips:
        truth, frames, exposure = displayed_truth(clip), clip.frames, clip.meta.exposure
        pbr, irradiance = (to_display(frames[name], exposure) for name in ("pbr", "irradiance"))
        ratio = to_display(
            shadow_ratio(frames["pbr"], frames["irradiance"], frames["unshadowed"], exposure), exposure
        )
        terms = product_terms(frames["pbr"], frames["irradiance"], frames["mask"], exposure)
        n_frames += len(truth)
        inside = region_mask(clip, "foreground")
        affine.add([pbr[inside], irradiance[inside]], truth[inside])
        affine_ratio.add([pbr[inside], irradiance[inside], ratio[inside]], truth[inside])
        pixels = _some(inside, scale_pixels * len(truth), generator(seed, "eval", "scale", clip.meta.key))
        scale.add(terms.at(pixels), truth[pixels])
    if not n_frames:
        raise TronError(
            "no training clips to fit the baselines on", mend="the data set needs a training split"
        )
    return Fits(scale.solve(), affine.solve(), affine_ratio.solve(), n_frames)


def _some(inside: np.ndarray, count: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Indices of at most ``count`` of the True pixels of a (K, H, W) mask, without repetition."""
    indices = np.flatnonzero(inside)
    if len(indices) > count:
        indices = np.sort(rng.choice(indices, count, replace=False))
    return np.unravel_index(indices, inside.shape)


Render = Callable[[np.ndarray, np.ndarray, float], np.ndarray]
"""(pbr, irradiance, exposure) -> displayed image: linear (K, H, W, 3) in, [0, 1] of the same shape out."""


@dataclass(frozen=True)
class Predictor:
    """Shows clips by every method there is; ``networks`` holds ``neural`` and ``pixel_mlp``, if given."""

    fits: Fits
    networks: Mapping[str, Render] = field(default_factory=dict)

    def shown(self, clip: Clip) -> dict[Region, dict[str, np.ndarray]]:
        """Method name -> (K, H, W, 3) display float32 in [0, 1], for each region.

        The images differ between regions only for SURFACES, which full frames show over the environment.
        """
        frames, exposure = clip.frames, clip.meta.exposure
        pbr, irradiance, mask = frames["pbr"], frames["irradiance"], frames["mask"]
        displayed = [to_display(image, exposure) for image in (pbr, irradiance)]
        ratio = to_display(shadow_ratio(pbr, irradiance, frames["unshadowed"], exposure), exposure)
        foreground = {
            "pbr": displayed[0],
            "shadow_ratio": ratio,
            "shadowed": to_display(frames["shadowed"], exposure),
            "pbr_x_irradiance": product_terms(pbr, irradiance, mask, exposure).displayed(self.fits.scale),
            "affine": self.fits.affine.displayed(displayed),
            "affine_ratio": self.fits.affine_ratio.displayed([*displayed, ratio]),
            **{name: network(pbr, irradiance, exposure) for name, network in self.networks.items()},
        }
        frame = {
            name: over_environment(image, displayed[0], mask) if name in SURFACES else image
            for name, image in foreground.items()
        }
        return {"foreground": foreground, "frame": frame}
