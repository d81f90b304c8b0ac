"""Training with weights, gradients and optimiser state in shards (strategy=fsdp), each process holding one.

torch's FSDP2 shards every tensor along its first axis, block by block, on GPUs and, by gloo, on the CPU. A
stage trains a sharded copy of the renderer; the unsharded one stays on the CPU of each process and receives
the weights at the stage's end. During validation every process holds all weights.
"""

from __future__ import annotations

import copy
from typing import Any

from lightning.pytorch.strategies import ModelParallelStrategy
from torch import nn
from torch.distributed.checkpoint.state_dict import StateDictOptions, get_model_state_dict
from torch.distributed.fsdp import FSDPModule, fully_shard

from train.checkpoints import damage_told
from train.module import RendererModule
from train.processes import Processes
from train.settings import Settings
from train.transformer_options import apply_options, transformer_blocks
from tron.errors import TronError
from tron.neural.protocols import Renderer

WHOLE = StateDictOptions(full_state_dict=True)


def require_shardable(settings: Settings, processes: Processes) -> None:
    """Raise TronError if the run cannot be sharded."""
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
        """Shard each block of the transformer, then all other weights; Lightning calls it more than once."""
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
        """Gather all weights in every process now: gathering needs all, and their clip counts differ."""
        super().on_validation_epoch_start()
        for part in self._parts():
            part.set_reshard_after_forward(False, recurse=False)
            part.unshard()

    def on_validation_epoch_end(self) -> None:
        """Shard the weights again."""
        for part in self._parts():
            part.reshard()
            part.set_reshard_after_forward(part is not self.renderer, recurse=False)
        super().on_validation_epoch_end()

    def _parts(self) -> list[FSDPModule]:
        return [part for part in self.renderer.modules() if isinstance(part, FSDPModule)]

    def give_weights_to(self, whole: RendererModule) -> None:
        """Gather the weights into an unsharded module, in every process."""
        state: dict[str, Any] = get_model_state_dict(self, options=WHOLE)
        whole.load_state_dict({name: tensor.cpu() for name, tensor in state.items()})


def _copied(renderer: Renderer) -> Renderer:
    # A frozen codec that is not a module (the WAN VAE, half a gigabyte) is shared.
    codec = getattr(renderer, "codec", None)
    shared = {} if codec is None or isinstance(codec, nn.Module) else {id(codec): codec}
    return copy.deepcopy(renderer, shared)


class ShardedStrategy(ModelParallelStrategy):
    """Lightning's strategy for FSDP2, with unsharded checkpoints, read without unpickling."""

    def __init__(self, processes: Processes):
        super().__init__(
            data_parallel_size=processes.count, tensor_parallel_size=1, save_distributed_checkpoint=False
        )

    def load_checkpoint(self, checkpoint_path: Any, weights_only: bool | None = None) -> dict[str, Any]:
        """Read the whole file, keep this process's shard, and return the rest of the checkpoint."""
        del weights_only
        with damage_told(checkpoint_path):
            return super().load_checkpoint(checkpoint_path, weights_only=True)
