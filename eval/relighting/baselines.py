"""The baselines that a neural renderer must beat: products in linear light, and least-squares blends.

Definitions (docs: facts, section 9). With B = pbr, E = irradiance, E0 = unshadowed irradiance (all linear, E
over pi), e the clip's exposure, o the surfels' opacity and D = AgX(e ·) the displayed image:

- ``pbr``: D(B).
- ``pbr_x_irradiance``: D(o s B e E + (1 - o) B), one scalar s, fitted. Irradiance is exposed too, as
  everywhere else, so that s means the same under a dim and a bright light; where no surfel is, both buffers
  hold the environment, whose square would be a straw man.
- ``shadow_ratio``: D(B E / E0), the ratio being clamped (see :func:`shadow_ratio`).
- ``shadowed``: base color (1 - metallic) E + split-sum specular, stored with the data.
- ``affine``: w0 + w1 D(B) + w2 D(E), clipped to [0, 1]; weights of their own for each output channel.
- ``affine_ratio``: the same with D(B E / E0) as a third input.
- ``pixel_mlp``: 1x1 convolutions on D(B) and D(E), trained on the same data for the same time.

Blends and s are fitted on the foreground of training data against the displayed truth, with the squared error
that PSNR measures, in float64 (float32 sums over millions of pixels were several dB off).

A blend of surfaces is wrong for the sky, which both buffers show as it is. On full frames the blends and
``pixel_mlp`` are therefore laid over pbr, whose sky is the displayed environment: o x blend + (1 - o) D(B),
clipped (:func:`over_environment`). The other methods show the environment by themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy.optimize

from tron.color import agx

THREE = ("pbr", "shadow_ratio", "affine")
SEVEN = ("pbr", "pbr_x_irradiance", "shadow_ratio", "shadowed", "affine", "affine_ratio", "pixel_mlp")

RATIO_FLOOR = 1e-4
"""Exposed unshadowed irradiance under which no ratio is formed: AgX is black below 2e-4."""


def shadow_ratio(
    pbr: np.ndarray, irradiance: np.ndarray, unshadowed: np.ndarray, exposure: float
) -> np.ndarray:
    """pbr times the share of irradiance that arrives, per channel.

    The share is irradiance / unshadowed clamped to [0, 1]: visibility only removes light, and what exceeds 1
    is Monte Carlo noise. Where ``exposure * unshadowed`` is under RATIO_FLOOR there is no light to lose and
    the share is 1. Where nothing is shadowed the result is pbr itself.

    Args:
        pbr, irradiance, unshadowed: (..., 3) linear radiance and irradiance over pi, in the same unit.
        exposure: the clip's scalar, for the floor alone.

    Returns:
        (..., 3) float32, linear, in pbr's unit.
    """
    lit = unshadowed * exposure > RATIO_FLOOR
    share = np.where(lit, irradiance / np.where(lit, unshadowed, 1), 1)
    return (pbr * np.clip(share, 0, 1)).astype(np.float32)


def over_environment(shown: np.ndarray, pbr: np.ndarray, opacity: np.ndarray) -> np.ndarray:
    """A method's surfaces before pbr's sky: o x shown + (1 - o) D(B).

    Args:
        shown, pbr: (..., 3) display values in [0, 1].
        opacity: (..., 1) of the surfels, [0, 1].
    """
    return opacity * shown + (1 - opacity) * pbr


@dataclass(frozen=True)
class ProductTerms:
    """The two images that pbr_x_irradiance blends: exposed linear (..., 3), ``scale * product + rest``."""

    product: np.ndarray
    rest: np.ndarray

    def at(self, pixels: tuple[np.ndarray, ...]) -> ProductTerms:
        """The terms of some pixels, (n, 3) each; ``pixels`` index all axes but the last."""
        return ProductTerms(self.product[pixels], self.rest[pixels])

    def displayed(self, scale: float) -> np.ndarray:
        """AgX of the blend: (..., 3) display values in [0, 1]."""
        return agx(scale * self.product + self.rest)


def product_terms(
    pbr: np.ndarray, irradiance: np.ndarray, opacity: np.ndarray, exposure: float
) -> ProductTerms:
    """Split e (o s B e E + (1 - o) B) into what s multiplies and what it does not.

    Args:
        pbr, irradiance: (..., 3) linear.
        opacity: (..., 1) of the surfels, [0, 1].
        exposure: the clip's scalar.
    """
    exposed = pbr * exposure
    return ProductTerms(opacity * exposed * (irradiance * exposure), (1 - opacity) * exposed)


@dataclass
class ScaleFit:
    """Collects pixels of the training data and finds the s with the least displayed squared error."""

    _products: list[np.ndarray] = field(default_factory=list)
    _rests: list[np.ndarray] = field(default_factory=list)
    _truths: list[np.ndarray] = field(default_factory=list)

    def add(self, terms: ProductTerms, truth: np.ndarray) -> None:
        """Keep these pixels: ``terms`` and displayed ``truth``, each (n, 3)."""
        self._products.append(np.asarray(terms.product, np.float64))
        self._rests.append(np.asarray(terms.rest, np.float64))
        self._truths.append(np.asarray(truth, np.float64))

    def solve(self) -> float:
        """The scale, in [1e-3, 1e3]: a scan of its logarithm, then Brent's method around the best point.

        Raises:
            ValueError: no pixels were added.
        """
        if not self._products or not sum(map(len, self._products)):
            raise ValueError("no training pixels to fit the scale on")
        terms = ProductTerms(np.concatenate(self._products), np.concatenate(self._rests))
        truth = np.concatenate(self._truths)

        def error(log_scale: float) -> float:
            return float(np.mean((terms.displayed(np.exp(log_scale)) - truth) ** 2))

        scan = np.linspace(np.log(1e-3), np.log(1e3), 43)
        best = int(np.argmin([error(x) for x in scan]))
        low, high = scan[max(best - 1, 0)], scan[min(best + 1, len(scan) - 1)]
        found = scipy.optimize.minimize_scalar(
            error, bounds=(low, high), method="bounded", options={"xatol": 1e-6}
        )
        return float(np.exp(found.x))  # type: ignore[attr-defined]


@dataclass(frozen=True)
class AffineBlend:
    """weights (3 output channels, inputs + 1) float64; the last column is the constant."""

    weights: np.ndarray

    def displayed(self, inputs: Sequence[np.ndarray]) -> np.ndarray:
        """Blend displayed images: inputs of (..., 3) each -> (..., 3) float32 in [0, 1]."""
        if len(inputs) + 1 != self.weights.shape[1]:
            raise ValueError(f"the blend has {self.weights.shape[1] - 1} inputs, {len(inputs)} given")
        blend = self.weights[:, -1] + sum(
            weight * np.asarray(image, np.float64) for weight, image in zip(self.weights.T, inputs)
        )
        return np.clip(blend, 0, 1).astype(np.float32)


class AffineFit:
    """Float64 normal equations of an :class:`AffineBlend`, summed over any number of images."""

    RIDGE = 1e-9
    """Share of the diagonal added to it, so that equal inputs (an unshadowed data set) still have a
    solution.
    """

    def __init__(self, n_inputs: int):
        self._gram = np.zeros((3, n_inputs + 1, n_inputs + 1))
        self._moment = np.zeros((3, n_inputs + 1))
        self.n_pixels = 0

    def add(self, inputs: Sequence[np.ndarray], truth: np.ndarray) -> None:
        """Add pixels: displayed inputs and truth, (n, 3) each."""
        columns = np.stack([*(np.asarray(x, np.float64) for x in inputs), np.ones(truth.shape)], axis=-1)
        by_channel = columns.transpose(1, 2, 0)  # (3, inputs + 1, n)
        self._gram += by_channel @ columns.transpose(1, 0, 2)
        self._moment += (by_channel @ np.asarray(truth, np.float64).T[:, :, None])[..., 0]
        self.n_pixels += len(truth)

    def solve(self) -> AffineBlend:
        """The least-squares weights of each channel; ValueError if no pixels were added."""
        if not self.n_pixels:
            raise ValueError("no training pixels to fit the blend on")
        diagonal = np.einsum("cii->ci", self._gram)
        ridge = np.eye(self._gram.shape[-1]) * (self.RIDGE * diagonal)[:, None, :]
        return AffineBlend(np.linalg.solve(self._gram + ridge, self._moment[..., None])[..., 0])
