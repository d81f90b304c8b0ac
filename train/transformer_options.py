"""Options of a transformer's blocks: activation checkpointing and compilation."""

from __future__ import annotations

import torch
from diffusers.models.transformers.transformer_cosmos import CosmosTransformer3DModel
from torch import nn

from train.settings import Settings
from tron.errors import TronError


def transformers(module: nn.Module) -> list[CosmosTransformer3DModel]:
    """The transformers anywhere inside a module."""
    return [each for each in module.modules() if isinstance(each, CosmosTransformer3DModel)]


def transformer_blocks(module: nn.Module) -> list[nn.Module]:
    """The blocks of its transformers, each recomputed, compiled and sharded by itself."""
    return [block for each in transformers(module) for block in each.transformer_blocks]


def require_compiler(settings: Settings) -> None:
    """Raise TronError if `compile` is set and torch.compile fails on the training device.

    An installed compiler may still fail, so a small function is compiled first, which takes seconds.
    """
    if not settings.compile:
        return
    device = "cpu" if settings.accelerator == "cpu" or not torch.cuda.is_available() else "cuda"
    try:
        torch.compile(_trial)(torch.ones(2, device=device))
    except Exception as error:  # Dynamo, Inductor, Triton and the compiler each raise their own
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise TronError(
            f"torch.compile does not work on this machine's {device}: {reason}",
            mend="install a C++ compiler (g++) or, on a GPU, Triton; or leave compile out",
        ) from error


def _trial(x: torch.Tensor) -> torch.Tensor:
    return x * 2 + 1


def apply_options(renderer: nn.Module, settings: Settings) -> None:
    """Recompute and compile the blocks of the renderer's transformer, as the settings say.

    Raises:
        TronError: the renderer has no transformer.
    """
    asked = [
        name
        for name, on in (
            ("memory.checkpoint_activations", settings.memory.checkpoint_activations),
            ("compile", settings.compile),
        )
        if on
    ]
    if not asked:
        return
    found = transformers(renderer)
    if not found:
        raise TronError(
            f"{' and '.join(asked)} need a transformer, and this renderer has none",
            mend="leave them out, or train renderer=tiny or renderer=cosmos",
        )
    for transformer in found:
        if settings.memory.checkpoint_activations:
            transformer.enable_gradient_checkpointing()
        if settings.compile:
            for block in transformer.transformer_blocks:
                block.compile()  # in place: names of weights stay
