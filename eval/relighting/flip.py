"""NVIDIA's FLIP: visible difference of two pictures shown in turn; needs flip-evaluator."""

from __future__ import annotations

import importlib.util
from typing import Literal

import numpy as np

INSTALLED = importlib.util.find_spec("flip_evaluator") is not None
"""Whether ``pip install 'tron-relight[flip]'`` was done."""


def flip(
    image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None, kind: Literal["LDR", "HDR"] = "LDR"
) -> float:
    """Return the mean FLIP over the mask at 67 pixels per degree; HDR uses tone mapper ACES; 0 is identical.

    Args:
        image, truth: (H, W, 3), display values in [0, 1], or exposed radiance for HDR.
        mask: (H, W) bool; None: all pixels.
    """
    import flip_evaluator

    reference, test = (np.ascontiguousarray(each, np.float32) for each in (truth, image))
    error, _, _ = flip_evaluator.evaluate(reference, test, kind, kind == "LDR", False, False, {})
    error = error[..., 0]
    return float(error[mask].mean() if mask is not None else error.mean())
