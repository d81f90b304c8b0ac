"""Semi-global matching: the costs of each pixel's hypotheses, together with those of the pixels around it.

From "Stereo Processing by Semiglobal Matching and Mutual Information" (Hirschmueller 2008), eq. 13. Along
each of eight directions through the image, with q the pixel before p,

    L(p, d) = C(p, d) + min(L(q, d), L(q, d +- 1) + P1, min_i L(q, i) + P2) - min_i L(q, i)

and the sum over the directions is what a pixel is decided by. A small step of depth costs P1, any other P2,
less where the picture has an edge.
"""

from __future__ import annotations

import torch
from torch import Tensor

_SHIFTS = (-1, 0, 1)
_EDGE = 0.1  # difference of grey at which a jump costs 1/e


def semi_global_cost(cost: Tensor, grey: Tensor, small: float, large: float) -> Tensor:
    """Mean of the directions' path costs, (K, H, W).

    Args:
        cost: (K, H, W) of hypotheses that are ordered, as planes of a sweep are.
        grey: (H, W) the picture, display values.
        small, large: P1 and P2.
    """
    total = torch.zeros_like(cost)
    for flipped in (False, True):  # left to right and back
        for transposed in (False, True):  # down, and along the rows
            volume, picture = cost.movedim(1, 2) if transposed else cost, grey.T if transposed else grey
            if flipped:
                volume, picture = volume.flip(1), picture.flip(0)
            # Diagonals belong to two sweeps: they are taken going down and up.
            paths = _sweep(volume, picture, small, large, (0,) if transposed else _SHIFTS)
            if flipped:
                paths = paths.flip(1)
            total += paths.movedim(1, 2) if transposed else paths
    return total / 8


def _sweep(cost: Tensor, grey: Tensor, small: float, large: float, shifts: tuple[int, ...]) -> Tensor:
    """Sum over the shifts of the path costs down the rows, each row from the last one moved by the shift."""
    rows = torch.empty_like(cost)
    last = torch.stack([cost[:, 0]] * len(shifts))  # (S, K, W)
    rows[:, 0] = last.sum(0)
    for row in range(1, cost.shape[1]):
        before = torch.stack([_moved(paths, shift) for paths, shift in zip(last, shifts)])
        edge = torch.stack([(grey[row] - _moved(grey[row - 1], shift)).abs() for shift in shifts])
        jump = (large * torch.exp(-edge / _EDGE)).clamp(min=small)[:, None]
        least = before.amin(1, keepdim=True)
        step = before.clone()
        step[:, 1:] = torch.minimum(step[:, 1:], before[:, :-1] + small)
        step[:, :-1] = torch.minimum(step[:, :-1], before[:, 1:] + small)
        last = cost[:, row] + torch.minimum(step, least + jump) - least
        rows[:, row] = last.sum(0)
    return rows


def _moved(values: Tensor, shift: int) -> Tensor:
    """Values (..., W) moved to the right by ``shift``; at the border the nearest."""
    if shift == 0:
        return values
    if shift > 0:
        return torch.cat([values[..., :1], values[..., :-1]], -1)
    return torch.cat([values[..., 1:], values[..., -1:]], -1)
