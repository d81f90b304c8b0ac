"""Share of what lies behind surfels that is seen through them, by their transmittance T.

    share(T) = 0                                            T <= 0.01
               T / (1 + exp(1/s - 1/(1 - s)))               s = (T - 0.01) / (0.25 - 0.01)
               T                                            T >= 0.25

Surfels that make up a solid leave a few thousandths of the light, a hundredth of all rays more than two
hundredths. That is invisible until a sun stands behind: its radiance may be 10^4 times exposed white. So a
transmittance below 0.01 counts as none, as it does for shadow rays, and the rest comes back by the smooth
transition function, which is flat to every order at both ends: at T = 0.026 it lets through 10^-8. The share
is smooth and monotone. What is shaded has the weight 1 - share, so that opaque surfels are not dimmed either.
Opacity itself, which is the mask, stays 1 - T.
"""

from __future__ import annotations

from typing import TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from tron.tracing.transmittance import OPAQUE_TRANSMITTANCE

CLEAR_TRANSMITTANCE = 0.25
"""From here on what lies behind is seen with its full share."""
_END = 1 / 64
"""The transition is 0 and 1 in float32 this near its ends, where its terms would overflow."""

Array = TypeVar("Array")


def background_share(transmittance: Array) -> Array:
    """Weight in [0, 1] of the radiance behind surfels; theirs is one minus it.

    Args:
        transmittance: 1 - opacity of the surfels along a ray, any shape, in [0, 1]; differentiable if it is
            of Dr.Jit's.
    """
    arrays, choose = (np, np.where) if isinstance(transmittance, np.ndarray) else (dr, dr.select)
    along = (transmittance - OPAQUE_TRANSMITTANCE) / (CLEAR_TRANSMITTANCE - OPAQUE_TRANSMITTANCE)
    along = arrays.clip(along, _END, 1 - _END)
    transition = 1 / (1 + arrays.exp(1 / along - 1 / (1 - along)))
    return choose(transmittance > OPAQUE_TRANSMITTANCE, transmittance * transition, 0)


def over_background(shaded: mi.Color3f, behind: mi.Color3f, opacity: mi.Float) -> mi.Color3f:
    """Linear radiance of surfels of this ``opacity`` in front of ``behind``; of none, ``behind`` alone."""
    return dr.select(opacity > 0, dr.lerp(shaded, behind, background_share(1 - opacity)), behind)
