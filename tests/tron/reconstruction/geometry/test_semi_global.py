"""Semi-global matching against the equation, evaluated pixel by pixel."""

from __future__ import annotations

import numpy as np
import torch

from tron.reconstruction.geometry.stereo import semi_global_cost
from tron.seeds import generator

P1, P2 = 0.05, 0.3


def by_equation(cost: np.ndarray, grey: np.ndarray) -> np.ndarray:
    """Mean over eight directions of the path costs, one pixel after the other."""
    planes, height, width = cost.shape
    total = np.zeros_like(cost)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            if dy == dx == 0:
                continue
            path = np.zeros_like(cost)
            rows = range(height) if dy >= 0 else range(height - 1, -1, -1)
            columns = range(width) if dx >= 0 else range(width - 1, -1, -1)
            for y in rows:
                for x in columns:
                    # Nothing lies before the first row or column; beside the last the nearest pixel stands.
                    py, px = y - dy, x - dx
                    if not 0 <= py < height or (dy == 0 and not 0 <= px < width):
                        path[:, y, x] = cost[:, y, x]
                        continue
                    px = min(max(px, 0), width - 1)
                    before = path[:, py, px]
                    jump = max(P2 * np.exp(-abs(grey[y, x] - grey[py, px]) / 0.1), P1)
                    for d in range(planes):
                        near = [before[d], before.min() + jump]
                        near += [before[d + s] + P1 for s in (-1, 1) if 0 <= d + s < planes]
                        path[d, y, x] = cost[d, y, x] + min(near) - before.min()
            total += path
    return total / 8


def test_path_costs_follow_the_equation() -> None:
    random = generator(0, "semi-global")
    cost, grey = random.random((5, 6, 7)), random.random((6, 7))
    found = semi_global_cost(torch.from_numpy(cost), torch.from_numpy(grey), P1, P2)
    np.testing.assert_allclose(found.numpy(), by_equation(cost, grey), atol=1e-9)


def test_a_pixel_that_says_nothing_follows_its_neighbours() -> None:
    cost = torch.ones(8, 9, 9)
    cost[3] = 0.2
    cost[:, 4, 4] = 0.5
    assert (semi_global_cost(cost, torch.zeros(9, 9), P1, P2).argmin(0) == 3).all()
