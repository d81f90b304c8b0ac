"""Exposure as a photographer with an incident meter sets it.

The meter reads the light that falls on a card before the subject which faces the camera: a card of 18 %
grey comes out as middle grey, whatever the subject is made of, and black leather stays black. A subject that
is very dark or very bright in the picture is then helped by a part of a stop: the card still looks grey.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from tron.color import Look, luminance, to_display
from tron.errors import TronError

MOST_BRIGHTER, MOST_DARKER = 0.25, 0.6
"""Stops of help at the most. Middle grey of 127 of 255 then stays between 100 and 140 in both looks."""

DARK, BRIGHT = 75 / 255, 150 / 255
"""Mean luma of the subject, on screen, below and above which it is helped."""

WHITE, WHITE_SHARE = 250 / 255, 0.02
"""A subject of which a larger share has a channel above WHITE is darkened, and is not brightened."""

OPEN = 0.9
"""Quantile, over the subject, of the share of light that arrives: what the card before it gets."""

_STEP = 0.05


class Frame(Protocol):
    """Linear buffers by name, (H, W, C): :class:`tron.shading.guidance.Guidance`."""

    def __getitem__(self, name: str, /) -> np.ndarray: ...


def incident_exposure(frame: Frame, card: np.ndarray, look: Look = "none") -> float:
    """The factor on linear values before AgX that a frame asks for.

    Args:
        frame: with ``irradiance``, ``unshadowed``, ``indirect``, ``lit`` (:mod:`tron.shading.guidance`), and
            ``mask``, which is above a half where the subject is.
        card: (3,) radiance of a white diffuse card that faces the camera, nothing in the way, E / pi
            (:meth:`tron.shading.environments.environment.EnvironmentMap.unoccluded`).
        look: of the picture.

    Raises:
        TronError: no light falls on the subject and none on the card, and nothing of it glows.
    """
    subject = frame["mask"][..., 0] > 0.5
    arriving, bounced, share = float(luminance(card)), 0.0, 1.0
    if subject.any():
        direct, unshadowed, indirect = (
            np.asarray(luminance(frame[name][subject]), np.float64)
            for name in ("irradiance", "unshadowed", "indirect")
        )
        share = float(np.quantile(direct / np.maximum(unshadowed, 1e-12), OPEN))
        bounced = float(indirect.mean())
        # Where the camera looks into the light its card is black, but the rims of things are not.
        arriving = max(arriving * min(share, 1.0), 0.25 * float(direct.mean()))
    light = arriving + bounced
    if not light > 0 and subject.any():  # what glows in the dark shows itself
        light = float(luminance(frame["lit"][subject]).mean())
    if not light > 0:
        raise TronError("no light falls on the subject", mend="give exposure=NUMBER, or another map")
    exposure = 1.0 / light
    if not subject.any():
        return exposure
    return exposure * 2.0 ** _help(frame["lit"][subject] * np.float32(exposure), look)


def _help(subject: np.ndarray, look: Look) -> float:
    """Stops that pixels (N, 3) of exposed light are helped by."""
    stops = 0.0

    def judged(stops: float) -> tuple[float, float]:
        display = np.asarray(to_display(subject, np.float32(2.0**stops), look=look))
        return float(luminance(display).mean()), float((display.max(axis=-1) > WHITE).mean())

    while stops > -MOST_DARKER and (judged(stops)[0] > BRIGHT or judged(stops)[1] > WHITE_SHARE):
        stops -= _STEP
    while 0 <= stops < MOST_BRIGHTER and judged(stops)[0] < DARK:
        if judged(stops + _STEP)[1] > WHITE_SHARE:
            break
        stops += _STEP
    return stops
