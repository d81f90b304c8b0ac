"""The optimiser: AdamW, and Muon for the matrices between hidden layers where a recipe asks for it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from train.settings import OptimizerSettings
from tron.neural.protocols import Renderer


def make_optimizer(renderer: Renderer, settings: OptimizerSettings) -> torch.optim.Optimizer:
    """Make the optimiser of all weights that are not frozen.

    With muon_learning_rate, the renderer's `hidden_matrices` use Muon (orthogonalised momentum, K. Jordan
    2024) and all other weights AdamW.
    """
    trained = [parameter for parameter in renderer.parameters() if parameter.requires_grad]
    if settings.muon_learning_rate is None:
        return _adamw(trained, settings)
    hidden = [matrix for matrix in renderer.hidden_matrices() if matrix.requires_grad]
    if not hidden:
        return _adamw(trained, settings)
    chosen = {id(matrix) for matrix in hidden}
    muon = Muon(
        hidden,
        lr=settings.muon_learning_rate,
        weight_decay=settings.weight_decay,
        adjust_lr_fn="original",
    )
    return CombinedOptimizer([muon, _adamw([p for p in trained if id(p) not in chosen], settings)])


def _adamw(parameters: list[nn.Parameter], settings: OptimizerSettings) -> torch.optim.AdamW:
    return torch.optim.AdamW(
        parameters,
        lr=settings.learning_rate,
        betas=settings.betas,
        weight_decay=settings.weight_decay,
    )


class CombinedOptimizer(torch.optim.Optimizer):
    """Several optimisers that step as one: schedules, clipping and checkpoints see a single optimiser."""

    def __init__(self, parts: Sequence[torch.optim.Optimizer]):
        self.parts = list(parts)
        super().__init__(
            [{"params": [p for part in parts for g in part.param_groups for p in g["params"]]}], {}
        )
        self._share_groups()

    def _share_groups(self) -> None:
        # The parts' own dicts, so that a schedule's writes reach their optimiser.
        self.param_groups = [group for part in self.parts for group in part.param_groups]
        self.state = defaultdict(dict)  # each part keeps its own

    def step(self, closure: Callable[[], Any] | None = None) -> Any:  # type: ignore[override]
        """Evaluate the closure once, then step every part."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for part in self.parts:
            part.step()
        return loss

    def state_dict(self) -> dict[str, Any]:
        """The parts' states, in order."""
        return {"parts": [part.state_dict() for part in self.parts]}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the parts' states."""
        for part, state in zip(self.parts, state_dict["parts"], strict=True):
            part.load_state_dict(state)
        self._share_groups()


class Muon(torch.optim.Muon):
    """torch.optim.Muon (K. Jordan 2024), made fast on CPUs without bf16 arithmetic.

    torch's own orthogonalises in bf16, which such a CPU emulates: 2 to 12 times the time of float32, three
    quarters of a training step (dev/LOG.md). Here the same iteration runs in float32, on all matrices of one
    shape at once. On a GPU torch's own is used. Options and state are torch's; the rate is adjusted to a
    matrix's shape as by torch's "original".
    """

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:  # type: ignore[override]
        """Evaluate the closure, if given, update the weights, and return the closure's loss."""
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
        """Update matrices of one shape, each given with its gradient."""
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
    """Orthogonalise (N, rows, columns): the same singular vectors, singular values near 1.

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
