"""The choices of estimating light on surfels, from the paper's to ours."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

Estimator = Literal["ratio", "plain"]
Brdf = Literal["conserving", "lambert"]
MATERIAL = "conserving"
"""The material of path tracing, which datasets and scenes name (:mod:`tron.brdf`)."""


def require_bounces(bounces: int, reflections: int) -> None:
    """Raise ValueError where reflections are asked for that have nothing to show."""
    if reflections and not bounces:
        raise ValueError(
            f"reflections={reflections} would show light that bounces, and there is none with bounces=0 "
            "(which fidelity=paper sets): give bounces too, such as bounces=4, or leave reflections out"
        )


class Estimation(BaseModel):
    """Choices in estimating light (conventions.md, 10); by default 64 rays a pixel, unfiltered.

    The paper's are ``Estimation(estimator="plain", two_sided=False, bounces=0, brdf="lambert")``. Costs of
    each choice, on 10,000 to 20,000 surfels of scenes that no benchmark uses:

    * ``rays``: time grows with them. Their noise is below the bias of surfels from 16 on; 64 are converged.
      Of 0 shadows are as sharp as the surfels; where nothing bounces, and so nothing is baked, they are 2.
    * ``estimator="plain"``: the noise of the light stays in. Of 64 rays under a sun the relative error is
      0.13 instead of 0.04, and open surfaces are not exactly as bright as unshadowed ones. No time is saved.
    * ``two_sided=False``: light leaks through undersides that no camera saw, 16 to 18 % of the pixels in
      shadow; against path-traced irradiance 26.7 dB instead of 28.4 under a sun, 23.8 instead of 26.6 in a
      studio. It saves no time to speak of.
    * ``bounces``: 1 / 2 / 4 / 6 are 0.76 / 0.93 / 0.99 / 0.998 of what bounces in scenes like the demo's;
      each takes 2 ms. Data are path-traced with 4.
    * ``filtered=True``: six passes over the image. It takes the error of 2 rays from 0.081 to 0.030 under a
      sun, from 0.171 to 0.038 in soft light. From 16 rays on it is another, which changes what is noisy alone
      (:mod:`tron.shading.direct.noise`).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    rays: int = Field(
        default=64,
        ge=0,
        multiple_of=2,
        description="shadow rays per pixel, even; 0: use the visibility that was baked at the surfels",
    )
    estimator: Estimator = Field(
        default="ratio",
        description="ratio: unshadowed irradiance, which has no noise, times the share of it that arrives; "
        "plain: the Monte Carlo mean, as in the paper",
    )
    two_sided: bool = Field(
        default=True,
        description="back faces block shadow rays beyond two spacings; false: never, as in the paper",
    )
    filtered: bool = Field(default=False, description="edge-avoiding filter over the image")
    brdf: Brdf = Field(
        default="conserving",
        description="conserving: the energy-conserving material with which data are path-traced; "
        "lambert: diffuse base color below a split sum, as in the paper",
    )
    bounces: int = Field(
        default=4,
        ge=0,
        le=16,
        description="number of bounces of light between surfels; 0: direct light alone",
    )
    reflections: int = Field(
        default=0,
        ge=0,
        description="reflection rays per pixel for glossy surfaces; 0: bounced light around them instead, "
        "and one ray for metals if filtered",
    )
    supersample: Literal[1, 2] = Field(
        default=1, description="2: 2 x 2 sub-pixels with a quarter of the rays each, averaged"
    )

    @model_validator(mode="after")
    def _reflects_something(self) -> Estimation:
        require_bounces(self.bounces, self.reflections)
        return self

    def of_sub_pixel(self) -> Estimation:
        """Return the estimation for one sub-pixel: the rays of a pixel are divided among its sub-pixels."""
        parts = self.supersample**2
        if parts == 1:
            return self
        rays, reflections = self.rays // parts // 2 * 2, -(-self.reflections // parts)
        rays = max(2, rays) if self.rays else 0
        return self.model_copy(update={"rays": rays, "reflections": reflections, "supersample": 1})

    def of_pixels(self) -> Estimation:
        """Return an estimation that needs no baked visibility: two rays per pixel instead of none."""
        return self if self.rays else self.model_copy(update={"rays": 2})


FINAL = Estimation()
"""Estimation of a frame with one sample per pixel; settings of the commands have its defaults."""
PREVIEW = Estimation(rays=0, filtered=True)
"""``quality=preview`` of tron-relight, its default."""
FINEST = Estimation(filtered=True, reflections=4, supersample=2)
"""``quality=final`` of tron-relight."""
QUALITY = {"preview": PREVIEW, "final": FINEST}
"""Estimation by the name that ``quality=`` takes."""

OCTAVES = (-8.0, 4.0)
"""Range of log2(pixel footprint / surfel spacing) that ``sampling`` encodes."""
MOST_RAYS = 10.0
"""log2 of the number of shadow rays per pixel that ``sampling`` encodes as 1."""
