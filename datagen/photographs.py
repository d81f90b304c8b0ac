"""Photographs of path-traced light: photos with an exposure, a white balance and noise of their own.

A phone meters each photo anew, so that one surface has other values in the next; its sensor counts electrons.
Training views are photographed so. Held-out views stay as the path tracer made them: nobody can know how a
photo that was not taken would have been exposed, so reconstructions are judged by the light itself, to which
the drifts of the training photos are centred.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from datagen.capture_settings import SensorSettings
from tron.seeds import generator


@dataclass(frozen=True)
class Photograph:
    """Circumstances of one photo.

    Attributes:
        exposure_stops: power of two on the light that the sensor collects.
        white_balance: (3,) gains on what it counted; that of green is 1.
    """

    exposure_stops: float
    white_balance: tuple[float, float, float]

    def take(self, exposed: np.ndarray, settings: SensorSettings, rng: np.random.Generator) -> np.ndarray:
        """Linear values (H, W, 3), 1 for as many electrons as the settings say -> those of the photo.

        The variance of counted electrons is their number (shot noise), and reading them adds the same
        everywhere (Janesick 2007, "Photon Transfer"). Values may be a little negative in the dark.
        """
        light = np.asarray(exposed, np.float64) * 2.0**self.exposure_stops
        variance = np.maximum(light, 0) / settings.electrons + (settings.read_noise / settings.electrons) ** 2
        counted = light + np.sqrt(variance) * rng.standard_normal(light.shape)
        return (counted * self.white_balance).astype(np.float32)


def drift(count: int, settings: SensorSettings, seed: int, *names: str | int) -> list[Photograph]:
    """Drifts of so many photos of a capture: drawn from normal laws, and centred, in the logarithm.

    Args:
        count: of photos.
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
    """Plain values for a file beside the photos: name of a view -> how it was taken."""
    return {
        name: {
            "exposure_stops": round(taken.exposure_stops, 6),
            "white_balance": [round(gain, 6) for gain in taken.white_balance],
        }
        for name, taken in photographs
    }


def _centred(values: np.ndarray) -> np.ndarray:
    return values - values.mean()
