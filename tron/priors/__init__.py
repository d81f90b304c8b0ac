"""Per-view priors: maps of normals, materials and light that a capture's photos do not hold themselves.

One protocol (:mod:`tron.priors.prior`), one provider a file, each built from plain values. None of them loads
torch before it needs it.
"""

from tron.priors.classical import Classical
from tron.priors.ground_truth import GroundTruth
from tron.priors.precomputed import Precomputed
from tron.priors.prior import FIELDS, Prior, Track, apply_prior, untracked
from tron.priors.rgbx import RgbX

__all__ = [
    "FIELDS",
    "Classical",
    "GroundTruth",
    "Precomputed",
    "Prior",
    "RgbX",
    "Track",
    "apply_prior",
    "untracked",
]
