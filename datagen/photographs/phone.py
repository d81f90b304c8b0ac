"""A phone camera: lens, sensor and tone curve, and their state in each photo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import convolve
from scipy.special import erf

from datagen.settings.captures import PseudoCaptureSettings, SensorSettings
from tron.captures.view import ToneCurve
from tron.color import linear_to_srgb, to_display
from tron.seeds import generator


@dataclass(frozen=True)
class Phone:
    """Lens, sensor and curve of one capture: values shared by all photos, and values per photo.

    Attributes:
        curve: from linear light to display values: "agx", or "srgb", clipped at white.
        vignetting: share of light lost in the corners.
        photographs: name of a photo -> its exposure and white balance.
        blurs: name of a photo -> its blur.
    """

    curve: ToneCurve
    vignetting: float
    photographs: dict[str, Photograph]
    blurs: dict[str, Blur]

    def photo(
        self, name: str, exposed: np.ndarray, settings: PseudoCaptureSettings, rng: np.random.Generator
    ) -> np.ndarray:
        """Take a photo: linear light (H, W, 3) times the capture's exposure -> display values in [0, 1].

        Args:
            name: name of the photo.
            exposed: the exposed light, surroundings included.
            settings: of the sensor.
            rng: stream of the noise.
        """
        height, width = exposed.shape[:2]
        arrived = self.blurs[name].on(exposed) * vignette(width, height, self.vignetting)
        counted = self.photographs[name].take(arrived, settings.sensor, rng)
        if self.curve == "agx":
            return to_display(counted, 1.0)
        return np.clip(linear_to_srgb(np.maximum(counted, 0.0)), 0.0, 1.0)

    def described(self) -> dict[str, Any]:
        """Return the hidden state as plain values for a file."""
        photos = described(list(self.photographs.items()))
        for name, blur in self.blurs.items():
            photos[name] |= {
                "spread_pixels": round(blur.spread, 6),
                "motion_pixels": round(blur.motion, 6),
                "motion_deg": round(blur.motion_deg, 6),
            }
        return {"tone_curve": self.curve, "vignetting": round(self.vignetting, 6), "photos": photos}


def draw_phone(settings: PseudoCaptureSettings, names: Sequence[str], seed: int, *path: str | int) -> Phone:
    """Draw the phone of a capture and the state of each photo.

    Args:
        settings: distributions.
        names: names of the photos.
        seed, path: root and path of the random streams.
    """
    lens = settings.lens
    rng = generator(seed, *path, "phone")
    filmic, spread, corner = rng.random() < settings.filmic_share, rng.random(), rng.random()
    rng = generator(seed, *path, "shake")
    shakes = np.abs(rng.normal(0.0, lens.motion, len(names))), rng.uniform(0.0, 180.0, len(names))
    spread = float(np.interp(spread, (0, 1), lens.spread))
    return Phone(
        "agx" if filmic else "srgb",
        float(np.interp(corner, (0, 1), lens.vignetting)),
        dict(zip(names, drift(len(names), settings.sensor, seed, *path))),
        {name: Blur(spread, float(way), float(angle)) for name, way, angle in zip(names, *shakes)},
    )


STEPS = 33
"""Places along the way of a shake that a kernel is the mean of."""

REACH = 4.0
"""Standard deviations at which a point spread ends."""


@dataclass(frozen=True)
class Blur:
    """Blur of one photo.

    Attributes:
        spread: standard deviation of the Gaussian point spread, pixels.
        motion: length of the image's straight motion during exposure, pixels.
        motion_deg: direction of the motion in the image, from x towards y.
    """

    spread: float = 0.0
    motion: float = 0.0
    motion_deg: float = 0.0

    def kernel(self) -> np.ndarray:
        """(2 r + 1, 2 r + 1) float64 weights of sum 1, none negative, point-symmetric.

        Each weight is the Gaussian's integral over its pixel: samples at pixel centres would ignore a spread
        of a third of a pixel.
        """
        radius = int(np.ceil(0.5 * self.motion + REACH * self.spread))
        way = 0.5 * self.motion * np.linspace(-1.0, 1.0, STEPS)
        angle = np.radians(self.motion_deg)
        across = _pixel_integrals(way * np.cos(angle), self.spread, radius)
        down = _pixel_integrals(way * np.sin(angle), self.spread, radius)
        weights = down.T @ across
        weights = 0.5 * (weights + weights[::-1, ::-1])
        return weights / weights.sum()

    def on(self, light: np.ndarray) -> np.ndarray:
        """Blur linear light (H, W, 3), float32; the border is replicated."""
        kernel = self.kernel()
        if kernel.size == 1:
            return light.astype(np.float32)
        return convolve(light.astype(np.float32), kernel[..., None], mode="nearest")


def vignette(width: int, height: int, corner: float) -> np.ndarray:
    """Return the transmitted share of light (H, W, 1) float32: 1 at the centre, 1 - ``corner`` in corners."""
    x = (np.arange(width) + 0.5) / width * 2 - 1
    y = (np.arange(height) + 0.5) / height * 2 - 1
    diagonal = width**2 + height**2
    squared = ((x * width) ** 2 + (y * height)[:, None] ** 2) / diagonal
    return (1.0 - corner * squared).astype(np.float32)[..., None]


def _pixel_integrals(centres: np.ndarray, spread: float, radius: int) -> np.ndarray:
    """Integrate Gaussians at ``centres`` (N,) over pixels -r to r: (N, 2 r + 1)."""
    edges = np.arange(-radius, radius + 2) - 0.5
    # A point is a Gaussian much narrower than any step between places.
    below = 0.5 * (1 + erf((edges - centres[:, None]) / (np.sqrt(2) * max(spread, 1e-6))))
    return np.diff(below, axis=1)


@dataclass(frozen=True)
class Photograph:
    """Exposure and white balance of one photo.

    Attributes:
        exposure_stops: power of two on the collected light.
        white_balance: (3,) gains on the counts; green has gain 1.
    """

    exposure_stops: float
    white_balance: tuple[float, float, float]

    def take(self, exposed: np.ndarray, settings: SensorSettings, rng: np.random.Generator) -> np.ndarray:
        """Apply exposure, noise and white balance to linear values (H, W, 3); 1 is the full electron count.

        The variance of counted electrons is their number (shot noise), and reading them adds the same
        everywhere (Janesick 2007, "Photon Transfer"). Values may be a little negative in the dark.
        """
        light = np.asarray(exposed, np.float64) * 2.0**self.exposure_stops
        variance = np.maximum(light, 0) / settings.electrons + (settings.read_noise / settings.electrons) ** 2
        counted = light + np.sqrt(variance) * rng.standard_normal(light.shape)
        return (counted * self.white_balance).astype(np.float32)


def drift(count: int, settings: SensorSettings, seed: int, *names: str | int) -> list[Photograph]:
    """Draw the drift of exposure and white balance over photos: normal in the logarithm, and centred.

    Args:
        count: number of photos.
        settings: standard deviations.
        seed, names: root and path of the random stream.
    """
    rng = generator(seed, *names, "drift")
    stops = _centred(rng.normal(0, settings.exposure_stops, count))
    red, blue = (_centred(rng.normal(0, settings.white_balance, count)) for _ in range(2))
    return [
        Photograph(float(stop), (float(np.exp(warm)), 1.0, float(np.exp(cold))))
        for stop, warm, cold in zip(stops, red, blue)
    ]


def described(photographs: Sequence[tuple[str, Photograph]]) -> dict[str, dict[str, object]]:
    """Return plain values for a file beside the photos: name of a view -> its state."""
    return {
        name: {
            "exposure_stops": round(taken.exposure_stops, 6),
            "white_balance": [round(gain, 6) for gain in taken.white_balance],
        }
        for name, taken in photographs
    }


def _centred(values: np.ndarray) -> np.ndarray:
    return values - values.mean()
