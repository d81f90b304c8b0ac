"""Numbers that are not stored as 3DGS stores them, known by what is impossible.

3DGS keeps logarithms of lengths and logits of opacities; exporters forget one or the other. (Formats that
keep lengths are given logarithms: :func:`tron.gaussians.formats.splats.logarithms`.) What tells them: a
length is never negative; splats are about as wide as the distances between them; an opacity lies in [0, 1],
and no scan has only splats whose logits do.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree
from scipy.special import logit

from tron.errors import TronError
from tron.gaussians.fields import FIELDS
from tron.gaussians.harmonics import rgb_to_dc

log = logging.getLogger(__name__)

_FEWEST = 50
"""Splats of which a file tells how it was stored."""
_QUERIES = 2_000
_FAR_WIDER = 8.0
"""Widths over distances that no scan has: in ours they are 2 to 3."""
_BLUR = 30.0
"""The same, from which hundreds of splats cover each point: minutes and gigabytes for a blur."""
_BRIGHTEST = 8.0
"""Coefficients beyond which colours, 0.5 + 0.28 f_dc, are bytes: twice as bright as white, and more."""


def as_3dgs_stores(
    columns: Mapping[str, np.ndarray], scales: Sequence[str], path: Path
) -> dict[str, np.ndarray]:
    """The columns with logarithmic scales, logits of opacities and harmonics; a line says what was not.

    Args:
        columns: by the names of 3DGS, (M,) each.
        scales: names of its scales.
        path: the file, for the line.

    Raises:
        TronError: splats are far wider than their distances however they are read.
    """
    found = dict(columns)
    count = len(found["x"])
    if count < _FEWEST:
        return found
    said = []
    stored = np.stack([np.asarray(found[name], np.float64) for name in scales])
    known = stored[np.isfinite(stored)]  # a few are broken, and flat splats have a logarithm of -infinity
    wide = np.where(np.isfinite(stored), stored, -np.inf).max(axis=0)
    largest = float(np.median(wide[np.isfinite(wide)].clip(max=80))) if np.isfinite(wide).any() else -np.inf
    apart, width = _apart(found), float(np.exp(largest))
    if apart > 0 and width > _FAR_WIDER * apart:
        lengths = known.min() >= 0 and largest <= _FAR_WIDER * apart
        if not lengths and width > _BLUR * apart:
            what = f"its splats are {width:.2g} wide and {apart:.2g} apart: all is one blur"
            mend = "are its scales natural logarithms of standard deviations, in the units of its positions?"
            raise TronError(what, path, mend)
        if lengths:
            with np.errstate(divide="ignore"):
                found |= dict(zip(scales, np.log(stored)))
            said.append("scales are lengths")
    if (opacities := _opacities(found["opacity"], bool(said))) is not None:
        found["opacity"] = opacities
        said.append("opacities lie in [0, 1]")
    dc = np.stack([np.asarray(found[name], np.float64) for name in FIELDS["sh"].properties])
    if np.nanmin(dc) >= 0 and np.nanmax(dc) <= 255 and np.nanmedian(dc) > _BRIGHTEST:
        found |= dict(zip(FIELDS["sh"].properties, rgb_to_dc(dc / 255)))
        found = {name: values for name, values in found.items() if not name.startswith("f_rest_")}
        said.append("colours are bytes")
    if said:
        log.warning("%s: %s, not as 3DGS stores them: they are read as that", path, ", ".join(said))
    return found


def _opacities(stored: np.ndarray, others: bool) -> np.ndarray | None:
    """Logits of opacities that are stored as they are; None of logits.

    Between logits of 0 and 1 opacities are 0.5 to 0.73: nothing is opaque, nothing nearly gone. Equal ones
    may be meant, unless ``others``, the scales, are not as 3DGS stores them either.
    """
    stored = np.asarray(stored, np.float64)
    finite = stored[np.isfinite(stored)]
    if not len(finite) or np.isinf(stored).any() or finite.min() < 0 or finite.max() > 1:
        return None
    if not others and not (finite.max() > 0.9 and finite.min() < 0.5):
        return None
    with np.errstate(divide="ignore"):
        return logit(stored)


def _apart(columns: Mapping[str, np.ndarray]) -> float:
    """Median distance of splats to the third nearest other; 0 where they stand in one place."""
    places = np.stack([np.asarray(columns[axis], np.float64) for axis in FIELDS["means"].properties], axis=-1)
    places = places[np.isfinite(places).all(1)]
    if len(places) < _FEWEST:
        return 0.0
    stride = -(-len(places) // _QUERIES)
    return float(np.median(KDTree(places).query(places[::stride], k=4)[0][:, 3]))
