"""A phone that photographs a scene: its lens, its sensor, its tone curve, and how they were at each photo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from datagen.lens import Blur, vignette
from datagen.photographs import Photograph, described, drift
from datagen.pseudo_capture_settings import PseudoCaptureSettings
from tron.captures.view import ToneCurve
from tron.color import linear_to_srgb, to_display
from tron.seeds import generator


@dataclass(frozen=True)
class Phone:
    """Lens, sensor and curve of one capture: what all photos share and what is each one's own.

    Attributes:
        curve: from linear light to display values: "agx", or "srgb", clipped at white.
        vignetting: share of light that corners lack.
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
        """Display values (H, W, 3) in [0, 1] of linear light (H, W, 3) times the capture's exposure.

        Args:
            name: of the photo.
            exposed: the light, its surroundings included.
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
        """Plain values for a file: what nobody who has the photos alone knows."""
        photos = described(list(self.photographs.items()))
        for name, blur in self.blurs.items():
            photos[name] |= {
                "spread_pixels": round(blur.spread, 6),
                "motion_pixels": round(blur.motion, 6),
                "motion_deg": round(blur.motion_deg, 6),
            }
        return {"tone_curve": self.curve, "vignetting": round(self.vignetting, 6), "photos": photos}


def draw_phone(settings: PseudoCaptureSettings, names: Sequence[str], seed: int, *path: str | int) -> Phone:
    """Draw the phone of a capture and the circumstances of its photos.

    Args:
        settings: laws that they are drawn from.
        names: of the photos.
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
