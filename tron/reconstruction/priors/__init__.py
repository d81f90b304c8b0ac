"""Priors: strategies that find a capture's materials and light, one a file, each built from plain values.

:mod:`tron.reconstruction.priors.prior` says what they have in common.
"""

from tron.reconstruction.priors.ground_truth import GroundTruth
from tron.reconstruction.priors.joint import Joint
from tron.reconstruction.priors.precomputed import Precomputed
from tron.reconstruction.priors.prior import FIELDS, MapPrior, Prior, apply_prior
from tron.reconstruction.priors.rgbx import RgbX

__all__ = ["FIELDS", "GroundTruth", "Joint", "MapPrior", "Precomputed", "Prior", "RgbX", "apply_prior"]
