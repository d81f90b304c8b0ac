"""Denoisers of linear pictures: a row each. Settings, viewer and benchmarks know no denoiser but by its row.

Intel's is the filter of path tracers' pictures (``RT``, high dynamic range), led by base color
(https://www.openimagedenoise.org/documentation.html). It is not given normals: those of surfels have an error
of some degrees, and once a pixel they keep the steps of edges, 0.9 dB in previews (dev/LOG.md, 2026-11-26).
Its weights come with pyoidn.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator

from tron.errors import TronError

log = logging.getLogger(__name__)

LEAST_SIDE = 16
"""Pixels that a side is mirrored to. Of even grey with noise Intel's filter changes a single pixel by 90 %,
4 x 4 by 3 %, 8 x 8 by 1.5 %, and from 12 x 12 on the mean by 1 % at most, of any size."""


@dataclass(frozen=True)
class Denoiser:
    """A row.

    Attributes:
        title: in tables and in lines of the log.
        what: it is, in a few words.
        wants: pictures (H, W, 3) without noise that lead it: ``albedo``, base color in [0, 1] times opacity,
            a mean over each pixel, and ``normal``, of unit length in the world, 0 where no surface is.
        library: that it is called through.
        mend: what installs that.
        load: imports it and gives its filter: radiance (H, W, 3) float32, finite and not below 0, and what
            it wants, in this order -> (H, W, 3).
    """

    title: str
    what: str
    wants: tuple[Literal["albedo", "normal"], ...]
    library: str
    mend: str
    load: Callable[[], Callable[..., np.ndarray]]


def _load_oidn() -> Callable[..., np.ndarray]:
    from pyoidn import denoise  # pyright: ignore

    return partial(denoise, hdr=True)


DENOISERS: dict[str, Denoiser] = {
    "oidn": Denoiser(
        "Open Image Denoise", "Intel's denoiser, led by base color", ("albedo",),
        "pyoidn", "pip install 'tron-relight[oidn]'", _load_oidn,
    ),
}  # fmt: skip
"""Name, as in ``denoise=NAME`` -> row. ``checkpoint=auto`` takes one whose gains are known
(:mod:`tron.neural.network_gains`)."""


def _known(name: str) -> str:
    if name not in DENOISERS:
        raise ValueError(f"true, false or a denoiser: {', '.join(DENOISERS)}")
    return name


DenoiserName = Annotated[str, AfterValidator(_known)]
"""Setting of a denoiser."""


def installed() -> list[str]:
    """Names of the denoisers whose library is there; none is imported."""
    return [name for name, row in DENOISERS.items() if find_spec(row.library)]


def row_of(name: str) -> Denoiser:
    """The row of a denoiser.

    Raises:
        TronError: there is none of that name.
    """
    if name not in DENOISERS:
        raise TronError(f"no denoiser is called {name}", mend=f"give one of {', '.join(DENOISERS)}")
    return DENOISERS[name]


def lacking(name: str, what: str) -> TronError | None:
    """Why a denoiser does not run here, None: it does; ``what``: the setting that needs it, to be named."""
    row = row_of(name)
    try:
        row.load()
    except ModuleNotFoundError:
        return TronError(f"{what} needs {row.library}", mend=row.mend)
    except OSError as error:
        return TronError(f"{what}: {row.title} cannot be loaded: {error}")
    return None


def require(name: str, what: str) -> None:
    """Raise TronError where :func:`lacking` says why."""
    if (error := lacking(name, what)) is not None:
        raise error


def denoised(name: str, radiance: np.ndarray, guides: Mapping[str, np.ndarray]) -> np.ndarray:
    """A linear picture without its noise, the same each time; its unit plays no part.

    Values that are NaN or infinite count as 0, with a warning: the filter would spread an infinite one.

    Args:
        name: of the denoiser.
        radiance: (H, W, 3), not below 0.
        guides: what it wants among others, (H, W, 3) each, without noise: their edges stay.

    Returns:
        (H, W, 3) float32.

    Raises:
        TronError: its library is not there.
    """
    require(name, "denoising")
    if unknown := int((~np.isfinite(radiance)).sum()):
        log.warning("%d values of a picture are NaN or infinite: the denoiser is given 0", unknown)
    (height, width), more = radiance.shape[:2], [max(LEAST_SIDE - side, 0) for side in radiance.shape[:2]]
    around, row = [(each // 2, each - each // 2) for each in more], DENOISERS[name]
    images = [np.asarray(each, np.float32) for each in (radiance, *(guides[guide] for guide in row.wants))]
    finite = [np.nan_to_num(image, nan=0.0, posinf=0.0, neginf=0.0) for image in images]
    given = [np.pad(image, (*around, (0, 0)), "symmetric") for image in finite]
    (top, _), (left, _) = around
    return np.ascontiguousarray(row.load()(*given)[top : top + height, left : left + width])
