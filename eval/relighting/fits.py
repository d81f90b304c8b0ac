"""Least-squares fits of the baselines, streamed over the training data in float64.

The error is in display values, as for PSNR. Float32 sums over millions of pixels were several dB off.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
import scipy.ndimage
import scipy.optimize

from eval.relighting.buffers import Buffers
from tron.color import agx, to_display

Show = Callable[[Buffers], np.ndarray]
"""Buffers of any pixels (whole frames where neighbours count) -> display in [0, 1], (..., 3) float32."""
DEVIATIONS = (0.3, 0.4, 0.5, 0.6, 0.7, 0.85, 1.0, 1.3, 1.6, 2.0, 2.5, 3.0)
"""Of the Gaussians that fits choose from, in pixels; at 512 x 512 the best is 1.6 to 2."""
FAINTEST = 0.02
"""Base color that light is divided by at least: no common material reflects less."""


class Fitted(NamedTuple):
    """A method, and its fitted weights.

    Attributes:
        show: the method.
        weights: float64, of the fit's own shape.
    """

    show: Show
    weights: np.ndarray


class Fit(Protocol):
    """Fit of a method's weights to training pixels, which are added clip by clip."""

    sampled: ClassVar[bool]
    """Whether some of the foreground's pixels are enough, chosen at random; otherwise it is given all."""

    def add(self, buffers: Buffers, truth: np.ndarray, inside: Any = ...) -> None:
        """Add the pixels ``inside`` of a clip: buffers and displayed truth, (..., 3)."""

    def solve(self) -> Fitted:
        """Return the method with the least squared error on the added pixels."""
        ...


def product_terms(buffers: Buffers) -> tuple[np.ndarray, np.ndarray]:
    """Split e (o s B e E + (1 - o) B) into the factor of s and the rest, (..., 3) exposed linear each."""
    exposed = buffers["pbr"] * buffers.exposure
    lit = buffers["mask"] * exposed * (buffers["irradiance"] * buffers.exposure)
    return lit, (1 - buffers["mask"]) * exposed


def show_product(buffers: Buffers, scale: float) -> np.ndarray:
    """Return AgX of ``scale * product + rest``: (..., 3) in [0, 1]."""
    product, rest = product_terms(buffers)
    return agx(scale * product + rest)


class ProductFit:
    """Keeps pixels and finds s in [1e-3, 1e3]: a scan of its logarithm, then Brent's method."""

    sampled: ClassVar[bool] = True

    def __init__(self):
        self._pixels: list[np.ndarray] = []

    def add(self, buffers: Buffers, truth: np.ndarray, inside: Any = ...) -> None:
        """As Fit.add; the pixels are kept."""
        self._pixels.append(np.stack([*product_terms(buffers.at(inside)), truth[inside]]).astype(np.float64))

    def solve(self) -> Fitted:
        """Return the scale, (1,), with the least squared error in display values."""
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
    """An affine blend of displayed ``inputs`` with weights per output channel, clipped to [0, 1].

    Its normal equations are summed over any number of pixels.
    """

    RIDGE = 1e-9
    """Share of the diagonal added to it: equal inputs (an unshadowed data set) still have a solution."""
    sampled: ClassVar[bool] = False

    def __init__(self, *inputs: Show):
        self.inputs = inputs
        self._gram = np.zeros((3, len(inputs) + 1, len(inputs) + 1))
        self._moment = np.zeros((3, len(inputs) + 1))
        self._square = np.zeros(3)

    def add(self, buffers: Buffers, truth: np.ndarray, inside: Any = ...) -> None:
        """As Fit.add; sums over the pixels are kept."""
        target = np.asarray(truth[inside], np.float64)
        columns = np.stack(
            [*(image[inside] for image in self._images(buffers)), np.ones(target.shape)], axis=-1
        )
        by_channel = columns.transpose(1, 2, 0)  # (3, inputs + 1, n)
        self._gram += by_channel @ columns.transpose(1, 0, 2)
        self._moment += (by_channel @ target.T[:, :, None])[..., 0]
        self._square += (target**2).sum(0)

    def solve(self) -> Fitted:
        """Return the least-squares weights, (3 output channels, inputs + 1); the constant is last."""
        weights = self.weights()
        return Fitted(self.shown_by(weights), weights)

    def shown_by(self, weights: np.ndarray) -> Show:
        """Return the method that blends the inputs by weights (3, inputs + 1)."""

        def show(buffers: Buffers) -> np.ndarray:
            blend = weights[:, -1] + sum(w * image for w, image in zip(weights.T, self._images(buffers)))
            return np.clip(blend, 0, 1).astype(np.float32)

        return show

    def join(self, other: AffineFit, share: float) -> None:
        """Add the pixels of another fit of the same inputs, ``share`` times each."""
        self._gram += share * other._gram
        self._moment += share * other._moment
        self._square += share * other._square

    def error(self) -> float:
        """Return the sum of squared errors of the solution, before clipping."""
        return self.error_of(self.weights())

    def error_of(self, weights: np.ndarray) -> float:
        """Return the sum of squared errors of any weights (3, inputs + 1), before clipping."""
        explained = 2 * (weights * self._moment).sum(1) - np.einsum(
            "ci,cij,cj->c", weights, self._gram, weights
        )
        return float((self._square - explained).sum())

    def weights(self) -> np.ndarray:
        """Return the least-squares weights."""
        diagonal = np.einsum("cii->ci", self._gram)
        ridge = np.eye(self._gram.shape[-1]) * (self.RIDGE * diagonal)[:, None, :]
        return np.linalg.solve(self._gram + ridge, self._moment[..., None])[..., 0]

    def _images(self, buffers: Buffers) -> list[np.ndarray]:
        return [np.asarray(show(buffers), np.float64) for show in self.inputs]


def filtered(show: Show, deviation: float) -> Show:
    """Return a method with its pictures (K, H, W, 3) filtered by a Gaussian; the border is replicated."""

    def shown(buffers: Buffers) -> np.ndarray:
        return scipy.ndimage.gaussian_filter(
            show(buffers), (0, deviation, deviation, 0), mode="nearest", truncate=4
        )

    return shown


def remodulated(deviation: float) -> Show:
    """Divide lit by base color, filter by a Gaussian in linear light, and multiply by base color again.

    The texture of ``albedo`` stays sharp, as in a denoiser. Base colors are at least FAINTEST.
    """

    def shown(buffers: Buffers) -> np.ndarray:
        base = np.maximum(buffers["albedo"], FAINTEST)
        light = scipy.ndimage.gaussian_filter(
            buffers["lit"] / base, (0, deviation, deviation, 0), mode="nearest", truncate=4
        )
        return to_display(light * base, buffers.exposure)

    return shown


class GaussianFit:
    """A method filtered by the Gaussian of DEVIATIONS with the least squared error; needs whole clips."""

    sampled: ClassVar[bool] = False

    def __init__(self, filtered_by: Callable[[float], Show]):
        """filtered_by: deviation -> the method filtered by it."""
        self._shown = {deviation: filtered_by(deviation) for deviation in DEVIATIONS}
        self._errors = dict.fromkeys(DEVIATIONS, 0.0)

    def add(self, buffers: Buffers, truth: np.ndarray, inside: Any = ...) -> None:
        """As Fit.add; sums of squared errors are kept."""
        for deviation, show in self._shown.items():
            self._errors[deviation] += float(
                np.square((show(buffers) - truth)[inside], dtype=np.float64).sum()
            )

    def solve(self) -> Fitted:
        """Return the deviation in pixels, (1,)."""
        best = min(DEVIATIONS, key=self._errors.__getitem__)
        return Fitted(self._shown[best], np.array([best]))


class FilteredAffineFit:
    """An AffineFit of inputs filtered by the best Gaussian of DEVIATIONS; needs whole clips.

    ``sharp`` inputs are used unfiltered too: minus their filtered copies they are detail.
    """

    sampled: ClassVar[bool] = True

    def __init__(self, *inputs: Show, sharp: Sequence[Show] = ()):
        self._fits = {
            deviation: AffineFit(*(filtered(show, deviation) for show in (*inputs, *sharp)), *sharp)
            for deviation in DEVIATIONS
        }

    def add(self, buffers: Buffers, truth: np.ndarray, inside: Any = ...) -> None:
        """As Fit.add, for each deviation."""
        for fit in self._fits.values():
            fit.add(buffers, truth, inside)

    def solve(self) -> Fitted:
        """Return AffineFit's weights for the Gaussian with the least error."""
        return min(self._fits.values(), key=AffineFit.error).solve()


STEPS = 30
LEAST_ERROR = 1e-6
"""Mean squared error under which a frame counts no more: 60 dB."""


class PsnrAffineFit:
    """A FilteredAffineFit that maximises mean PSNR over training frames.

    The worst frames dominate the sum of all squared errors; in the mean of logarithms, a factor on the error
    counts the same in each frame. It is minimised by iteratively reweighted least squares (Lange
    2016, *MM Optimization Algorithms*, majorising the concave logarithm by its tangent): a frame has the
    weight of one over its squared error by the last solution. ``sharp`` inputs are used unfiltered
    too. Needs whole clips.
    """

    sampled: ClassVar[bool] = True

    def __init__(self, *inputs: Show, sharp: Sequence[Show] = ()):
        self._inputs = {
            deviation: (*(filtered(show, deviation) for show in (*inputs, *sharp)), *sharp)
            for deviation in DEVIATIONS
        }
        self._frames: dict[float, list[AffineFit]] = {deviation: [] for deviation in DEVIATIONS}
        self._pixels: list[int] = []

    def add(self, buffers: Buffers, truth: np.ndarray, inside: Any = ...) -> None:
        """As Fit.add; sums of each frame are kept."""
        frames = np.unique(inside[0])
        for frame in frames:
            self._pixels.append(int((inside[0] == frame).sum()))
        for deviation, inputs in self._inputs.items():
            images = [show(buffers) for show in inputs]
            for frame in frames:
                some = tuple(axis[inside[0] == frame] for axis in inside)
                fit = AffineFit(*((lambda _, image=image: image) for image in images))
                fit.add(buffers, truth, some)
                self._frames[deviation].append(fit)

    def solve(self) -> Fitted:
        """Return the weights, (3 output channels, inputs + 1)."""
        counts = np.array(self._pixels, float)
        found = {each: fitted_by_psnr(frames, counts) for each, frames in self._frames.items()}
        best = max(found, key=lambda deviation: found[deviation][1])
        whole = AffineFit(*self._inputs[best])
        return Fitted(whole.shown_by(found[best][0]), found[best][0])


def fitted_by_psnr(frames: Sequence[AffineFit], counts: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the weights with the highest mean PSNR over frames, and this mean in dB."""
    share = np.ones(len(frames))
    weights = np.zeros(0)
    errors = np.ones(len(frames))
    for _ in range(STEPS):
        whole = AffineFit(*frames[0].inputs)
        for fit, each in zip(frames, share):
            whole.join(fit, each)
        weights = whole.weights()
        errors = np.array([fit.error_of(weights) for fit in frames]) / (3 * counts)
        errors = np.maximum(errors, LEAST_ERROR)
        share = 1 / (counts * errors)
    return weights, float(np.mean(-10 * np.log10(errors)))
