"""Training with weights, gradients and optimiser state in shards (strategy=fsdp), each process holding one.

torch's FSDP2 shards every tensor along its first axis, block by block, on GPUs and, by gloo, on the CPU. A
stage trains a sharded copy of the renderer; the whole one stays on the CPU of each process and takes the
weights over at the stage's end. Validation gathers all weights for as long as it lasts. Checkpoints are the
same whole files as DDP's, which one process reads.
"""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.core.optimizer import LightningOptimizer
from lightning.pytorch.strategies import ModelParallelStrategy
from torch import nn
from torch.distributed.checkpoint.state_dict import (
    StateDictOptions,
    get_model_state_dict,
    get_optimizer_state_dict,
    set_model_state_dict,
    set_optimizer_state_dict,
)
from torch.distributed.fsdp import FSDPModule, fully_shard

from train.checkpoints import AtomicCheckpoints
from train.module import RendererModule
from train.processes import Processes
from train.settings import Settings
from train.transformer_options import apply_options, transformer_blocks
from tron.errors import TronError
from tron.neural.protocols import Renderer

WHOLE = StateDictOptions(full_state_dict=True)
ON_FIRST = StateDictOptions(full_state_dict=True, cpu_offload=True)
"""Whole tensors, in the first process alone."""


def require_shardable(settings: Settings, processes: Processes) -> None:
    """TronError where the run cannot be sharded."""
    if settings.strategy != "fsdp":
        return
    if processes.count == 1:
        raise TronError(
            "strategy=fsdp shares the weights out among processes, and this run has one",
            mend="give devices=2 or more, or strategy=auto",
        )
    if settings.precision not in ("32-true", "bf16-mixed"):
        raise TronError(
            f"strategy=fsdp with precision={settings.precision}", mend="give 32-true or bf16-mixed"
        )


class ShardedModule(RendererModule):
    """A RendererModule whose renderer is sharded over the processes once they are joined."""

    def __init__(self, whole: RendererModule, settings: Settings):
        super().__init__(_copied(whole.renderer), whole.loss, whole.settings)
        self._options = settings
        self._sharded = False

    def configure_model(self) -> None:
        """Shard the transformer's blocks one by one, then what is left; Lightning calls it more than once."""
        if self._sharded:
            return
        mesh = self.device_mesh
        assert mesh is not None
        for block in transformer_blocks(self.renderer):
            fully_shard(block, mesh=mesh["data_parallel"])
        fully_shard(self.renderer, mesh=mesh["data_parallel"])
        apply_options(self.renderer, self._options)
        self._sharded = True

    def on_validation_epoch_start(self) -> None:
        """Have all weights in every process: clips are shared out unevenly, and gathering takes everybody."""
        super().on_validation_epoch_start()
        for part in self._parts():
            part.set_reshard_after_forward(False, recurse=False)
            part.unshard()

    def on_validation_epoch_end(self) -> None:
        """Go back to shards."""
        for part in self._parts():
            part.reshard()
            part.set_reshard_after_forward(part is not self.renderer, recurse=False)
        super().on_validation_epoch_end()

    def _parts(self) -> list[FSDPModule]:
        return [part for part in self.renderer.modules() if isinstance(part, FSDPModule)]

    def give_weights_to(self, whole: RendererModule) -> None:
        """Gather the weights into a module that is whole, in every process."""
        state: dict[str, Any] = get_model_state_dict(self, options=WHOLE)
        whole.load_state_dict({name: tensor.cpu() for name, tensor in state.items()})


def _copied(renderer: Renderer) -> Renderer:
    # A frozen codec that is no module (the WAN VAE, half a gigabyte) is shared.
    codec = getattr(renderer, "codec", None)
    shared = {} if codec is None or isinstance(codec, nn.Module) else {id(codec): codec}
    return copy.deepcopy(renderer, shared)


class ShardedStrategy(ModelParallelStrategy):
    """Lightning's strategy for FSDP2, with checkpoints in the form of every other strategy's."""

    def __init__(self, processes: Processes):
        super().__init__(
            data_parallel_size=processes.count, tensor_parallel_size=1, save_distributed_checkpoint=False
        )

    def optimizer_state(self, optimizer: torch.optim.Optimizer) -> dict[str, Any]:
        """The optimiser's whole state in the first process, by the number of each weight; empty in others.

        Lightning's own numbers count frozen weights too, which no optimiser elsewhere does.
        """
        if isinstance(optimizer, LightningOptimizer):
            optimizer = optimizer._optimizer
        assert self.model is not None
        state: dict[str, Any] = get_optimizer_state_dict(self.model, optimizer, options=ON_FIRST)
        if not state:
            return {}
        names = [name for group in state["param_groups"] for name in group["params"]]
        numbers = {name: number for number, name in enumerate(names)}
        return {
            "state": {numbers[name]: value for name, value in state["state"].items()},
            "param_groups": [
                group | {"params": [numbers[name] for name in group["params"]]}
                for group in state["param_groups"]
            ],
        }

    def load_checkpoint(self, checkpoint_path: Any, weights_only: bool | None = None) -> dict[str, Any]:
        """Each process reads the whole file and keeps its shard; the rest of the checkpoint is returned."""
        del weights_only
        assert self.model is not None
        checkpoint = AtomicCheckpoints().load_checkpoint(Path(checkpoint_path))
        set_model_state_dict(self.model, checkpoint.pop("state_dict"), options=WHOLE)
        for optimizer, state in zip(self.optimizers, checkpoint["optimizer_states"], strict=True):
            named = self._by_name(optimizer, state)
            set_optimizer_state_dict(self.model, optimizer, optim_state_dict=named, options=WHOLE)
        return checkpoint

    def _by_name(self, optimizer: torch.optim.Optimizer, state: dict[str, Any]) -> dict[str, Any]:
        assert self.model is not None
        names = {id(parameter): name for name, parameter in self.model.named_parameters()}
        order = [names[id(p)] for group in optimizer.param_groups for p in group["params"]]
        return {
            "state": {order[number]: value for number, value in state["state"].items()},
            "param_groups": [
                group | {"params": [order[number] for number in group["params"]]}
                for group in state["param_groups"]
            ],
        }
