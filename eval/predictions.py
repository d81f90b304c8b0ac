"""What each method shows for a clip: the seven baselines and the neural renderer, as displayed images."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from eval.baselines import AffineBlend, AffineFit, ScaleFit, product_terms, shadow_ratio
from tron.color import to_display
from tron.errors import TronError
from tron.seeds import generator
from tron.shards.schema import Clip

Region = Literal["foreground", "frame"]
REGIONS: tuple[Region, Region] = ("foreground", "frame")
MEMBERS = ("pbr", "irr", "rgb", "unshadowed", "shadowed", "mask", "foreground")
"""Members of a clip that predictions and their scores need."""


@dataclass(frozen=True)
class Fits:
    """What the fitted baselines learned from training pixels of one region."""

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


def fit_baselines(clips: Iterable[Clip], seed: int, scale_pixels: int = 512) -> dict[Region, Fits]:
    """Fit s and the two affine blends on training clips, once for each region they will be judged on.

    A blend fitted on whole frames would be a weaker baseline on the foreground, and the other way round.

    Args:
        clips: the training split, read once, one clip in memory at a time.
        seed: of the choice of pixels for s.
        scale_pixels: pixels of a frame and region that s is fitted on; the blends use every pixel.

    Raises:
        TronError: there are no training clips.
    """
    scale = {region: ScaleFit() for region in REGIONS}
    affine = {region: AffineFit(2) for region in REGIONS}
    affine_ratio = {region: AffineFit(3) for region in REGIONS}
    n_frames = 0
    for clip in clips:
        truth, frames, exposure = displayed_truth(clip), clip.frames, clip.meta.exposure
        pbr, irradiance = (to_display(frames[name], exposure) for name in ("pbr", "irr"))
        ratio = to_display(
            shadow_ratio(frames["pbr"], frames["irr"], frames["unshadowed"], exposure), exposure
        )
        terms = product_terms(frames["pbr"], frames["irr"], frames["mask"], exposure)
        n_frames += len(truth)
        for region in REGIONS:
            inside = region_mask(clip, region)
            affine[region].add([pbr[inside], irradiance[inside]], truth[inside])
            affine_ratio[region].add([pbr[inside], irradiance[inside], ratio[inside]], truth[inside])
            rng = generator(seed, "eval", "scale", clip.meta.key, region)
            pixels = _some(inside, scale_pixels * len(truth), rng)
            scale[region].add(terms.at(pixels), truth[pixels])
    if not n_frames:
        raise TronError(
            "no training clips to fit the baselines on", mend="the data set needs a training split"
        )
    return {
        region: Fits(scale[region].solve(), affine[region].solve(), affine_ratio[region].solve(), n_frames)
        for region in REGIONS
    }


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

    fits: Mapping[Region, Fits]
    networks: Mapping[str, Render] = field(default_factory=dict)

    def shown(self, clip: Clip) -> dict[Region, dict[str, np.ndarray]]:
        """Method name -> (K, H, W, 3) display float32 in [0, 1], for each region.

        The images differ between regions only for the fitted baselines, whose weights do.
        """
        frames, exposure = clip.frames, clip.meta.exposure
        pbr, irradiance, mask = frames["pbr"], frames["irr"], frames["mask"]
        displayed = [to_display(image, exposure) for image in (pbr, irradiance)]
        ratio = to_display(shadow_ratio(pbr, irradiance, frames["unshadowed"], exposure), exposure)
        same = {
            "pbr": displayed[0],
            "shadow_ratio": ratio,
            "shadowed": to_display(frames["shadowed"], exposure),
        }
        same |= {name: network(pbr, irradiance, exposure) for name, network in self.networks.items()}
        terms = product_terms(pbr, irradiance, mask, exposure)
        return {
            region: {
                **same,
                "pbr_x_irradiance": terms.displayed(fits.scale),
                "affine": fits.affine.displayed(displayed),
                "affine_ratio": fits.affine_ratio.displayed([*displayed, ratio]),
            }
            for region, fits in self.fits.items()
        }
