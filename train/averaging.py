"""Exponential moving average of the weights."""

from __future__ import annotations

from lightning.pytorch.callbacks import WeightAveraging
from torch.optim.swa_utils import get_ema_multi_avg_fn


class AveragedWeights(WeightAveraging):
    """Average a of the weights w, after every step a + (1 - d) (w - a) with decay d.

    Validation sees the averages, and a stage ends with them: its file holds them and the next stage starts
    from them. A checkpoint holds both. Buffers, such as a codec's normalisation, are constants and are not
    averaged. Frozen weights stay as they are, which Lightning's own d a + (1 - d) w does not grant: rounding
    moves them.
    """

    def __init__(self, decay: float):
        super().__init__(use_buffers=False, multi_avg_fn=get_ema_multi_avg_fn(decay))
