"""Muon whose orthogonalisation is computed in float32 on processors."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor


class Muon(torch.optim.Muon):
    """torch.optim.Muon (K. Jordan 2024), as fast on a processor without bf16 arithmetic as on one with it.

    torch's orthogonalises in bf16, which such a processor emulates: 2 to 12 times the time of float32,
    three quarters of a training step (docs/experiments.md). Here the same iteration runs in float32, on all
    matrices of one shape at once. On a GPU torch's own is taken. Options and state are torch's; the rate is
    adjusted to a shape as "original" does it.
    """

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:  # type: ignore[override]
        """Evaluate the closure, where there is one, then change the weights; returns the closure's loss."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        if any(p.is_cuda for group in self.param_groups for p in group["params"]):
            super().step()
            return loss
        for group in self.param_groups:
            by_shape = defaultdict(list)
            for matrix in group["params"]:
                if matrix.grad is not None:
                    by_shape[matrix.shape].append((matrix, matrix.grad))
            for matrices in by_shape.values():
                self._change(matrices, group)
        return loss

    def _change(self, matrices: list[tuple[Tensor, Tensor]], group: dict[str, Any]) -> None:
        """Change matrices of one shape, each given with its gradient."""
        rate, momentum = group["lr"], group["momentum"]
        updates = []
        for matrix, gradient in matrices:
            state = self.state[matrix]
            if "momentum_buffer" not in state:
                state["momentum_buffer"] = torch.zeros_like(matrix)
            mean = state["momentum_buffer"].lerp_(gradient, 1 - momentum)
            updates.append(gradient.lerp(mean, momentum) if group["nesterov"] else mean)
        turned = orthogonalised(
            torch.stack(updates), group["ns_coefficients"], group["ns_steps"], group["eps"]
        )
        rows, columns = turned.shape[1:]
        scale = max(1.0, rows / columns) ** 0.5
        for (matrix, _), update in zip(matrices, turned.unbind()):
            matrix.mul_(1 - rate * group["weight_decay"]).add_(update, alpha=-rate * scale)


def orthogonalised(
    matrices: Tensor,
    coefficients: Sequence[float] = (3.4445, -4.775, 2.0315),
    steps: int = 5,
    eps: float = 1e-7,
) -> Tensor:
    """(N, rows, columns) -> matrices with their singular vectors and singular values near 1.

    The quintic Newton-Schulz iteration of Muon: X <- a X + (b A + c A A) X with A = X X^T, on matrices that
    are scaled to a Frobenius norm of 1.
    """
    a, b, c = coefficients
    tall = matrices.shape[1] > matrices.shape[2]
    x = matrices.mT if tall else matrices
    x = x / x.norm(dim=(1, 2), keepdim=True).clamp(min=eps)
    for _ in range(steps):
        gram = x @ x.mT
        x = torch.baddbmm(x, torch.baddbmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
    return x.mT if tall else x
