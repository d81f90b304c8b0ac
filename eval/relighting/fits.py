"""Least-squares fits of the baselines, streamed over the training data in float64.

The error is that of displayed values, which PSNR measures. Float32 sums over millions of pixels were several
dB off.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, NamedTuple, Protocol

import numpy as np
import scipy.optimize

from eval.relighting.buffers import Buffers
from tron.color import agx

Show = Callable[[Buffers], np.ndarray]
"""Buffers of any pixels -> display values in [0, 1], (..., 3) float32."""


class Fitted(NamedTuple):
    """A method, and the numbers that were found for it.

    Attributes:
        show: the method.
        weights: float64, of the fit's own shape.
    """

    show: Show
    weights: np.ndarray


class Fit(Protocol):
    """Collects training pixels, one clip after another, and finds a method's weights."""

    sampled: ClassVar[bool]
    """Whether some of the foreground's pixels are enough, chosen at random; otherwise it is given all."""

    def add(self, buffers: Buffers, truth: np.ndarray) -> None:
        """Take n pixels with their displayed truth (n, 3)."""

    def solve(self) -> Fitted:
        """The method with the least squared error on the pixels that were added."""
        ...


def product_terms(buffers: Buffers) -> tuple[np.ndarray, np.ndarray]:
    """Split e (o s B e E + (1 - o) B) into what s multiplies and the rest, (..., 3) exposed linear each."""
    exposed = buffers["pbr"] * buffers.exposure
    lit = buffers["mask"] * exposed * (buffers["irradiance"] * buffers.exposure)
    return lit, (1 - buffers["mask"]) * exposed


def show_product(buffers: Buffers, scale: float) -> np.ndarray:
    """AgX of ``scale * product + rest``: (..., 3) in [0, 1]."""
    product, rest = product_terms(buffers)
    return agx(scale * product + rest)


class ProductFit:
    """Keeps pixels and finds s in [1e-3, 1e3]: a scan of its logarithm, then Brent's method."""

    sampled: ClassVar[bool] = True

    def __init__(self):
        self._pixels: list[np.ndarray] = []

    def add(self, buffers: Buffers, truth: np.ndarray) -> None:
        """Keep these pixels with their displayed truth (n, 3)."""
        self._pixels.append(np.stack([*product_terms(buffers), truth]).astype(np.float64))

    def solve(self) -> Fitted:
        """The scale, (1,), with the least displayed squared error."""
        product, rest, truth = np.concatenate(self._pixels, axis=1)

        def error(log_scale: float) -> float:
            return float(np.mean((agx(np.exp(log_scale) * product + rest) - truth) ** 2))

        scan = np.linspace(np.log(1e-3), np.log(1e3), 43)
        best = int(np.argmin([error(x) for x in scan]))
        low, high = scan[max(best - 1, 0)], scan[min(best + 1, len(scan) - 1)]
        found = scipy.optimize.minimize_scalar(
            error, bounds=(low, high), method="bounded", options={"xatol": 1e-6}
        )
        scale = float(np.exp(found.x))  # type: ignore[attr-defined]
        return Fitted(lambda buffers: show_product(buffers, scale), np.array([scale]))


class AffineFit:
    """A blend of displayed ``inputs`` and a constant, of its own for each output channel, clipped to [0, 1].

    Its normal equations are summed over any number of pixels.
    """

    RIDGE = 1e-9
    """Share of the diagonal added to it: equal inputs (an unshadowed data set) still have a solution."""
    sampled: ClassVar[bool] = False

    def __init__(self, *inputs: Show):
        self.inputs = inputs
        self._gram = np.zeros((3, len(inputs) + 1, len(inputs) + 1))
        self._moment = np.zeros((3, len(inputs) + 1))

    def add(self, buffers: Buffers, truth: np.ndarray) -> None:
        """Add n pixels with their displayed truth (n, 3)."""
        columns = np.stack([*self._images(buffers), np.ones(truth.shape)], axis=-1)
        by_channel = columns.transpose(1, 2, 0)  # (3, inputs + 1, n)
        self._gram += by_channel @ columns.transpose(1, 0, 2)
        self._moment += (by_channel @ np.asarray(truth, np.float64).T[:, :, None])[..., 0]

    def solve(self) -> Fitted:
        """The least-squares weights, (3 output channels, inputs + 1); the last column is the constant."""
        diagonal = np.einsum("cii->ci", self._gram)
        ridge = np.eye(self._gram.shape[-1]) * (self.RIDGE * diagonal)[:, None, :]
        weights = np.linalg.solve(self._gram + ridge, self._moment[..., None])[..., 0]

        def show(buffers: Buffers) -> np.ndarray:
            blend = weights[:, -1] + sum(w * image for w, image in zip(weights.T, self._images(buffers)))
            return np.clip(blend, 0, 1).astype(np.float32)

        return Fitted(show, weights)

    def _images(self, buffers: Buffers) -> list[np.ndarray]:
        return [np.asarray(show(buffers), np.float64) for show in self.inputs]
