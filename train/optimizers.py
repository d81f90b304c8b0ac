"""The optimiser: AdamW, and Muon for the matrices between hidden layers where a recipe asks for it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Literal

import torch
from torch import nn

from train.muon import Muon
from train.settings import OptimizerSettings
from tron.neural.protocols import Renderer


def make_optimizer(renderer: Renderer, settings: OptimizerSettings) -> torch.optim.Optimizer:
    """Optimise what is not frozen, at the settings' rates.

    With muon_learning_rate, the matrices that the renderer names as `hidden_matrices` follow Muon
    (orthogonalised momentum, K. Jordan 2024) and everything else AdamW.
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


@contextmanager
def learning(renderer: Renderer, which: Literal["all", "temporal"]) -> Iterator[None]:
    """Freeze, for the block, the weights that a stage does not train; `temporal`: all but those paths'."""
    kept = {id(weight) for weight in renderer.temporal_weights().values()}
    frozen = [
        p for p in renderer.parameters() if which == "temporal" and p.requires_grad and id(p) not in kept
    ]
    for parameter in frozen:
        parameter.requires_grad = False
    try:
        yield
    finally:
        for parameter in frozen:
            parameter.requires_grad = True


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
        # The parts' own dicts: what a schedule writes into a group is what its optimiser reads.
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
