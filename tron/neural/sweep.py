"""Sweep of the weights of pbr and irradiance: how much a picture depends on each."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch

from tron.errors import TronError
from tron.neural.configs import PAPER_GUIDANCE
from tron.neural.renderer import NeuralRenderer, to_display_array, to_tensor

SWEEP = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Weights that each of the two buffers takes."""


@torch.no_grad()
def weight_sweep(renderer: NeuralRenderer, displayed: Mapping[str, np.ndarray]) -> np.ndarray:
    """Render one frame with each pair of weights (w_pbr, w_irradiance).

    Other buffers keep their weight (1 / n of n where the configuration says nothing). With (0, 0) and no
    other buffer the backbone is given zeros: what stands there is what the network makes of nothing, on top
    of the start, which no weight scales unless it is the mean.

    Args:
        renderer: what renders; in evaluation.
        displayed: its guidance by name, (K, H, W, 3) display values in [0, 1], K as the renderer takes them.

    Returns:
        (5, 5, H, W, 3) display values in [0, 1], float32, of the clip's last frame: rows are w_pbr and
        columns w_irradiance, each as SWEEP has them.

    Raises:
        TronError: the renderer is not given both buffers, or the clip does not fit it.
    """
    names = renderer.config.guidance
    if not set(PAPER_GUIDANCE) <= set(names):
        raise TronError(
            f"a sweep needs the buffers {' and '.join(PAPER_GUIDANCE)}", mend="take another renderer"
        )
    weights = renderer.config.weights or dict.fromkeys(names, 1 / len(names))
    device = next(renderer.parameters()).device
    buffers = {name: to_tensor(displayed[name]).to(device) for name in names if name in displayed}
    rows = []
    for pbr in SWEEP:
        for irradiance in SWEEP:
            drawn = renderer(buffers, weights={**weights, "pbr": pbr, "irradiance": irradiance})
            rows.append(to_display_array(drawn)[-1])
    return np.stack(rows).reshape(len(SWEEP), len(SWEEP), *rows[0].shape)
