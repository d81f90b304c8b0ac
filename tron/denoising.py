"""Intel's Open Image Denoise: a linear picture without its noise, by a network that nobody here trained.

The filter is that of path tracers' pictures (``RT``, high dynamic range), led by base color
(https://www.openimagedenoise.org/documentation.html). It is not given normals: those of surfels have an error
of some degrees, and once a pixel they keep the steps of edges, 0.9 dB in previews (dev/LOG.md, 2026-11-26).
Its weights come with pyoidn: ``pip install 'tron-relight[oidn]'``.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np

from tron.errors import TronError

log = logging.getLogger(__name__)

LEAST_SIDE = 16
"""Pixels that a side is mirrored to. Of even grey with noise the filter changes a single pixel by 90 %, 4 x 4
by 3 %, 8 x 8 by 1.5 %, and from 12 x 12 on the mean by 1 % at most, of any size."""


def require_oidn(what: str) -> Callable[..., np.ndarray]:
    """``pyoidn.denoise``.

    Args:
        what: setting that needs it, for the message.

    Raises:
        TronError: it is not installed, or its library cannot be loaded here.
    """
    try:
        from pyoidn import denoise  # pyright: ignore
    except ModuleNotFoundError as error:
        raise TronError(f"{what} needs pyoidn", mend="pip install 'tron-relight[oidn]'") from error
    except OSError as error:
        raise TronError(f"{what}: Open Image Denoise cannot be loaded: {error}") from error
    return denoise


def denoised(radiance: np.ndarray, albedo: np.ndarray) -> np.ndarray:
    """A linear picture without its noise, the same each time; its unit plays no part.

    Values that are NaN or infinite count as 0, with a warning: the filter would spread an infinite one.

    Args:
        radiance: (H, W, 3), not below 0.
        albedo: (H, W, 3) in [0, 1], a mean over each pixel and without noise: its edges stay.

    Returns:
        (H, W, 3) float32.

    Raises:
        TronError: pyoidn is not there.
    """
    denoise = require_oidn("denoising")
    if unknown := int((~np.isfinite(radiance)).sum()):
        log.warning("%d values of a picture are NaN or infinite: the denoiser is given 0", unknown)
    (height, width), more = radiance.shape[:2], [max(LEAST_SIDE - side, 0) for side in radiance.shape[:2]]
    around = [(each // 2, each - each // 2) for each in more]
    given = [np.pad(_finite(image), (*around, (0, 0)), "symmetric") for image in (radiance, albedo)]
    (top, _), (left, _) = around
    return np.ascontiguousarray(denoise(*given, hdr=True)[top : top + height, left : left + width])


def _finite(image: np.ndarray) -> np.ndarray:
    return np.nan_to_num(np.asarray(image, np.float32), nan=0.0, posinf=0.0, neginf=0.0)
