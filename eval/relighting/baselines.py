"""Baselines that a neural renderer must beat: products in linear light, and least-squares blends.

Definitions (conventions.md, 12). With B = pbr, E = irradiance, E0 = unshadowed irradiance (all linear, E
over pi), e the clip's exposure, o the surfels' opacity and D = AgX(e ·) the displayed image:

- ``pbr``: D(B).
- ``pbr_x_irradiance``: D(o s B e E + (1 - o) B), one scalar s, fitted. Irradiance is exposed too, as
  everywhere else, so that s means the same under dim and bright lights; where no surfel is, both buffers
  hold the environment, which must not be squared.
- ``shadow_ratio``: D(B E / E0), the ratio being clamped (see :func:`shadow_ratio`).
- ``shadowed``: kd E + split-sum specular, stored with the data.
- ``affine``: w0 + w1 D(B) + w2 D(E), clipped to [0, 1]; weights of their own for each output channel.
- ``affine_ratio``: the same with D(B E / E0) as a third input.
- ``lit``: D(L), L being shadowed and the light that bounced between the surfels.
- ``affine_lit``: affine_ratio with D(L) as a fourth input.
- ``lit_filtered``: D(L) filtered by a Gaussian, whose deviation is fitted: L is sampled once in a pixel, the
  truth is a mean over it.
- ``lit_remodulated``: D(A G(L / A)), G a Gaussian whose deviation is fitted, A the surfels' base color as
  a mean over sub-pixels: ``albedo``.
- ``lit_detailed``: an affine blend of G(D(L)), G(S(A)) and S(A), S being the sRGB curve.
- ``lit_bilateral``: D(L) by a cross-bilateral filter (:mod:`eval.relighting.bilateral`).
- ``lit_blended``: an affine blend of G(D(L)), G(D(B)), G(D(E)), G(S(A)) and S(A), weights and deviation by
  the mean PSNR of training frames (`PsnrAffineFit`).
- ``lit_NAME``, such as ``lit_oidn``: D of L through each denoiser that is installed (:mod:`tron.denoising`).
- ``affine_filtered``, ``affine_ratio_filtered``, ``affine_lit_filtered``: these blends of filtered images.
- ``pixel_mlp``, ``pixel_mlp_lit``: 1x1 convolutions on D(B) and D(E), or on these and D(L).

Baselines with lit in their names use bounced light; the others use direct light from the environment.
``lit.supersampled`` and ``lit.reflections`` are ``lit`` at a higher cost per frame: with 2 x 2 sub-pixels,
and with reflection rays as well. Networks and blends do not see them, so they are no baselines; their rows
show the best picture without a network.

Blends and s are fitted on the foreground of training data (:mod:`eval.relighting.fits`). A blend fitted to
surfaces is wrong for the sky. On full frames, blends and pixel networks are therefore composited over pbr,
which shows the environment: o x blend + (1 - o) D(B). The other methods show the environment by themselves.

A new baseline is one more entry of BASELINES: scores, tables and pictures iterate over it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, MutableMapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from eval.relighting.bilateral import BilateralFit
from eval.relighting.buffers import Buffers, Region, region_mask
from eval.relighting.fits import (
    AffineFit,
    FilteredAffineFit,
    Fit,
    Fitted,
    GaussianFit,
    ProductFit,
    PsnrAffineFit,
    Show,
    filtered,
    remodulated,
)
from tron.color import to_display
from tron.denoising import DENOISERS, denoised, installed
from tron.errors import TronError
from tron.seeds import generator
from tron.shards.schema import Clip, guidance_members

RATIO_FLOOR = 1e-4
"""Exposed unshadowed irradiance under which no ratio is formed: AgX is black below 2e-4."""
SAMPLED_PIXELS = 512
"""Foreground pixels of a frame, on average, for fits that are content with some."""


def shadow_ratio(buffers: Buffers) -> np.ndarray:
    """Return pbr times the visible share of irradiance per channel: (..., 3) float32, linear, in pbr's unit.

    The share is irradiance / unshadowed clamped to [0, 1]: visibility only removes light, and what exceeds 1
    is Monte Carlo noise. Where ``exposure * unshadowed`` is under RATIO_FLOOR there is no light to lose and
    the share is 1. Where nothing is shadowed the result is pbr itself.
    """
    unshadowed = buffers["unshadowed"]
    lit = unshadowed * buffers.exposure > RATIO_FLOOR
    share = np.where(lit, buffers["irradiance"] / np.where(lit, unshadowed, 1), 1)
    return (buffers["pbr"] * np.clip(share, 0, 1)).astype(np.float32)


def show_pbr(buffers: Buffers) -> np.ndarray:
    """Return D(B), (..., 3) in [0, 1]."""
    return buffers.displayed("pbr")


def show_irradiance(buffers: Buffers) -> np.ndarray:
    """Return D(E), (..., 3) in [0, 1]."""
    return buffers.displayed("irradiance")


def show_lit(buffers: Buffers) -> np.ndarray:
    """Return D(L), (..., 3) in [0, 1]."""
    return buffers.displayed("lit")


def show_albedo(buffers: Buffers) -> np.ndarray:
    """Return the surfels' base color after the sRGB curve."""
    return buffers.displayed("albedo")


def show_shadow_ratio(buffers: Buffers) -> np.ndarray:
    """Return D(B E / E0), (..., 3) in [0, 1]."""
    return to_display(shadow_ratio(buffers), buffers.exposure)


def show_denoised(buffers: Buffers, name: str) -> np.ndarray:
    """Return displayed ``lit`` of whole clips (K, H, W, 3), denoised frame by frame."""
    guides = {each: buffers[each] for each in DENOISERS[name].wants}
    frames = [
        denoised(name, lit, {each: images[k] for each, images in guides.items()})
        for k, lit in enumerate(buffers["lit"])
    ]
    return to_display(np.stack(frames), buffers.exposure)


@dataclass(frozen=True)
class Method:
    """A method that makes the picture from the guidance.

    Attributes:
        name: name in rows of results.json: ``NAME.psnr``.
        title: title in tables and under pictures.
        what: short description.
    """

    name: str
    title: str
    what: str


SIMPLE, DIRECT, ON_LIT = "best_simple_baseline", "best_direct_baseline", "best_fit_on_lit"
"""Groups of baselines: simple ones; those of direct light alone; those that fit what lit lacks."""


@dataclass(frozen=True)
class Baseline(Method):
    """A baseline of the neural renderer.

    Attributes:
        show: the method; None if it is fitted, or is a network with given weights.
        fit: starts a fit of the method on training data.
        surfaces: whether it shows surfaces only; full frames composite it over pbr.
        groups: groups of baselines; gains over the best of each group are reported.
        optional: whether the best of a group is defined without it.
        pictured: whether the report shows its pictures.
        needs: member of reference clips that it shows.
    """

    show: Show | None = None
    fit: Callable[[], Fit] | None = None
    surfaces: bool = False
    groups: tuple[str, ...] = ()
    optional: bool = False
    pictured: bool = True
    needs: str | None = None


NEURAL_LIT = Method("neural_lit", "neural renderer", "filters lit and adds what is missing")
NEURAL = Method("neural", "neural renderer of two buffers", "the same of pbr and irradiance alone")
NETWORKS = (NEURAL_LIT, NEURAL)
DENOISED = {
    name: Baseline(
        f"lit_{name}",
        f"lit, {row.title}",
        f"{row.what}, on linear lit",
        partial(show_denoised, name=name),
        groups=(ON_LIT,),
        optional="normal" in row.wants,
        pictured=False,
        needs="normal" if "normal" in row.wants else None,
    )
    for name, row in DENOISERS.items()
}
"""Denoiser -> its baseline, which is among the others where it is installed."""
BASELINES = (
    Baseline("pbr", "pbr", "split-sum shading of the surfels, no shadows", show_pbr, groups=(SIMPLE, DIRECT)),
    Baseline(
        "pbr_x_irradiance",
        "pbr × irradiance",
        "pbr times irradiance times one fitted number",
        fit=ProductFit,
        groups=(DIRECT,),
        pictured=False,
    ),
    Baseline(
        "shadow_ratio",
        "shadow ratio",
        "pbr times the share of light that arrives",
        show_shadow_ratio,
        groups=(SIMPLE, DIRECT),
    ),
    Baseline(
        "shadowed",
        "shadowed shading",
        "shadowed diffuse light plus split-sum specular",
        lambda buffers: buffers.displayed("shadowed"),
        groups=(DIRECT,),
        pictured=False,
    ),
    Baseline(
        "affine",
        "affine blend",
        "fitted blend of pbr, irradiance and a constant",
        fit=lambda: AffineFit(show_pbr, show_irradiance),
        surfaces=True,
        groups=(SIMPLE, DIRECT),
        pictured=False,
    ),
    Baseline(
        "affine_filtered",
        "filtered affine blend",
        "the same of images that one fitted Gaussian filters",
        fit=lambda: FilteredAffineFit(show_pbr, show_irradiance),
        surfaces=True,
        groups=(DIRECT,),
        pictured=False,
    ),
    Baseline(
        "affine_ratio",
        "affine blend with shadow ratio",
        "fitted blend of pbr, irradiance, shadow ratio and a constant",
        fit=lambda: AffineFit(show_pbr, show_irradiance, show_shadow_ratio),
        surfaces=True,
        groups=(DIRECT,),
    ),
    Baseline(
        "affine_ratio_filtered",
        "filtered affine blend with shadow ratio",
        "the same of images that one fitted Gaussian filters",
        fit=lambda: FilteredAffineFit(show_pbr, show_irradiance, show_shadow_ratio),
        surfaces=True,
        groups=(DIRECT,),
        pictured=False,
    ),
    Baseline(
        "pixel_mlp",
        "per-pixel network of two buffers",
        "a network that sees pbr and irradiance of one pixel at a time",
        surfaces=True,
        groups=(DIRECT,),
        optional=True,
        pictured=False,
    ),
    Baseline(
        "lit",
        "lit",
        "shadowed shading and light that bounced between the surfels",
        show_lit,
    ),
    Baseline(
        "lit_filtered",
        "lit, filtered",
        "lit filtered by one Gaussian, whose deviation is fitted",
        fit=lambda: GaussianFit(partial(filtered, show_lit)),
        groups=(ON_LIT,),
    ),
    Baseline(
        "lit_remodulated",
        "lit, filtered without its texture",
        "lit over base color, filtered by one fitted Gaussian, times base color",
        fit=lambda: GaussianFit(remodulated),
        groups=(ON_LIT,),
        pictured=False,
    ),
    Baseline(
        "lit_detailed",
        "lit, filtered, with the detail of albedo",
        "fitted blend of lit and albedo, both filtered by one fitted Gaussian, and of albedo as it is",
        fit=lambda: FilteredAffineFit(show_lit, sharp=[show_albedo]),
        surfaces=True,
        groups=(ON_LIT,),
        pictured=False,
    ),
    Baseline(
        "lit_bilateral",
        "lit, cross-bilateral filter",
        "lit filtered among pixels alike in base color, surface and filtered lit; two numbers fitted by PSNR",
        fit=BilateralFit,
        groups=(ON_LIT,),
        pictured=False,
    ),
    Baseline(
        "lit_blended",
        "lit, filtered, with the detail of albedo, fitted by PSNR",
        "lit_detailed with pbr and irradiance besides, by the mean PSNR of frames instead of squared error",
        fit=lambda: PsnrAffineFit(show_lit, show_pbr, show_irradiance, sharp=[show_albedo]),
        surfaces=True,
        groups=(ON_LIT,),
        pictured=False,
    ),
    *(DENOISED[name] for name in installed()),
    Baseline(
        "affine_lit",
        "affine blend with lit",
        "fitted blend of pbr, irradiance, shadow ratio, lit and a constant",
        fit=lambda: AffineFit(show_pbr, show_irradiance, show_shadow_ratio, show_lit),
        surfaces=True,
        groups=(ON_LIT,),
        pictured=False,
    ),
    Baseline(
        "affine_lit_filtered",
        "filtered affine blend with lit",
        "the same of images that one fitted Gaussian filters",
        fit=lambda: FilteredAffineFit(show_pbr, show_irradiance, show_shadow_ratio, show_lit),
        surfaces=True,
        groups=(ON_LIT,),
        pictured=False,
    ),
    Baseline(
        "pixel_mlp_lit",
        "per-pixel network",
        "a network that sees all buffers of one pixel at a time",
        surfaces=True,
        groups=(ON_LIT,),
    ),
)
FINER = (
    Baseline(
        "lit.supersampled",
        "lit, 2 × 2 sub-pixels",
        "four times the pixels, a quarter of the rays each",
        lambda buffers: buffers.displayed("lit_supersampled"),
        needs="lit_supersampled",
    ),
    Baseline(
        "lit.reflections",
        "lit, 2 × 2 sub-pixels, reflections",
        "the same with rays to what surfaces mirror",
        lambda buffers: buffers.displayed("lit_reflections"),
        needs="lit_reflections",
    ),
)
"""``lit`` at a higher price a frame, in clips with reference members."""
METHODS: tuple[Method, ...] = (*NETWORKS, *BASELINES, *FINER)


def fit_baselines(clips: Iterable[Clip], seed: int) -> dict[str, Fitted]:
    """Fit baselines on the foreground of training clips; return name -> method.

    Args:
        clips: the training split, read once, one clip in memory at a time.
        seed: seed of the choice of pixels for fits on a sample.

    Raises:
        TronError: there are no training clips, or they have no foreground.
    """
    fits = {baseline.name: baseline.fit() for baseline in BASELINES if baseline.fit}
    fitted_on = 0
    for clip in clips:
        inside = np.nonzero(region_mask(clip, "foreground"))
        buffers, truth = Buffers.of(clip), clip.displayed("rgb")
        rng = generator(seed, "eval", "scale", clip.meta.key)
        pixels = len(inside[0])
        count = min(SAMPLED_PIXELS * clip.meta.frames, pixels)
        some = np.sort(rng.choice(pixels, count, replace=False)) if count else np.zeros(0, int)
        for fit in fits.values():
            fit.add(buffers, truth, tuple(axis[some] for axis in inside) if fit.sampled else inside)
        fitted_on += pixels
    if not fitted_on:
        raise TronError(
            "no training clips with a foreground to fit the baselines on",
            mend="the data set needs a training split",
        )
    return {name: fit.solve() for name, fit in fits.items()}


def predictions(
    clip: Clip, methods: Mapping[str, Show], seconds: MutableMapping[str, list[float]] | None = None
) -> dict[Region, dict[str, np.ndarray]]:
    """Render a clip by the given ``methods`` and by every method without fit and weights.

    Args:
        clip: with the members MEMBERS.
        methods: name -> fitted baseline or network.
        seconds: method name -> list that receives the seconds per frame, without AgX of the buffers.

    Returns:
        Region -> method name -> (K, H, W, 3) display float32 in [0, 1]. The regions differ only for baselines
        with ``surfaces``, which are composited over the environment in full frames.
    """
    buffers = Buffers.of(clip)
    plain = {
        each.name: each.show
        for each in (*BASELINES, *FINER)
        if each.show and (each.needs is None or each.needs in clip.frames)
    }
    if seconds is not None:
        for name in guidance_members():
            buffers.displayed(name)
    foreground = {}
    for name, show in {**plain, **methods}.items():
        begun = time.perf_counter()
        foreground[name] = show(buffers)
        if seconds is not None:
            seconds.setdefault(name, []).append((time.perf_counter() - begun) / clip.meta.frames)
    surfaces = {baseline.name for baseline in BASELINES if baseline.surfaces}
    opacity, pbr = buffers["mask"], buffers.displayed("pbr")
    frame = {
        name: opacity * image + (1 - opacity) * pbr if name in surfaces else image
        for name, image in foreground.items()
    }
    return {"foreground": foreground, "frame": frame}
