"""Time and memory of the paper's renderer: one frame of Cosmos 0.6B with random weights, and a projection.

Measured are passes of the full architecture over small frames, on this machine's CPU; projected is a clip of
1024 x 576, K = 5, on the same processor. Time follows `a + b n + c n²` in the transformer's tokens n: all but
attention is linear, the codec too. Memory of activations is counted at full size without doing the pass
(eval.renderer.live_memory); it is linear in tokens, for attention never holds the square matrix.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

from eval.renderer.live_memory import LiveMemory
from eval.results import Row
from tron.errors import TronError
from tron.neural.backbone import Backbone
from tron.neural.configs import COSMOS_0_6B, BackboneConfig, CosmosConfig
from tron.neural.renderer import NeuralRenderer
from tron.neural.wan import WanCodec

PAPER_SIZE = (1024, 576, 5)
"""Width, height and frames of the paper's third stage."""
SIZES = ((64, 64, 1), (128, 128, 1), (192, 192, 1))
"""Width, height, frames that a law is fitted to."""
GIGABYTE = 1e9


@dataclass(frozen=True)
class Shape:
    """A clip that goes through the network."""

    width: int
    height: int
    frames: int = 1

    @property
    def tokens(self) -> int:
        """Tokens of the transformer: 2 x 2 latents of 8 x 8 pixels, 1 + n latent frames of 1 + 4n."""
        return (self.width // 16) * (self.height // 16) * self.latent_frames

    @property
    def latent_frames(self) -> int:
        """Latent frames."""
        return 1 + (self.frames - 1) // 4


def measure_cosmos(
    sizes: Sequence[tuple[int, int, int]] = SIZES, threads: int = 1, bf16: bool = False
) -> list[Row]:
    """Measure one 256 x 256 frame on the CPU, fit the law to small clips, and project the paper's clip.

    Each is done in a process of its own, whose largest resident set is the memory (2.4 GB of weights in
    float32, half in bf16, beside the VAE's 0.5).

    Args:
        sizes: (width, height, frames) of the small clips, three or more token counts; multiples of 16 pixels.
        threads: of torch.
        bf16: weights and activations in bfloat16 (slow on processors without it).

    Returns:
        Rows `cosmos.frame_seconds.256`, `cosmos.frame_memory_gb.256`, and `cosmos.projected.*`.

    Raises:
        TronError: sizes that do not fit, or a process that failed (for want of memory, say).
    """
    shapes = [_checked(*size) for size in sizes]
    if len({shape.tokens for shape in shapes}) < 3:
        raise TronError("a law of three terms from fewer sizes", mend="give three or more")
    frame = _apart({"shapes": [(256, 256, 1)], "threads": threads, "bf16": bf16, "backward": False})
    small = _apart({"shapes": list(map(_triple, shapes)), "threads": threads, "bf16": bf16, "backward": True})
    return [
        _row("frame_seconds.256", frame["forward"][0], "s"),
        _row("frame_memory_gb.256", frame["peak_gb"], "GB"),
        *projected(shapes, small, Shape(*PAPER_SIZE)),
    ]


def projected(shapes: Sequence[Shape], measured: Mapping[str, Any], target: Shape) -> list[Row]:
    """Rows of the projection: seconds of a pass and of a training step by the law, memory by counting.

    Args:
        shapes: what was measured.
        measured: seconds of each, "forward" and "step" (with recomputed blocks), as `measure` gives.
        target: the clip to project to.
    """
    rows = []
    for name in ("forward", "step"):
        law = fit(shapes, measured[name])
        rows.append(_row(f"projected.{name}_seconds", law(target), "s"))
        worst = max(abs(law(s) - seconds) / seconds for s, seconds in zip(shapes, measured[name]))
        rows.append(_row(f"projected.{name}_misfit", worst, "fraction", len(shapes)))
    for name, checkpointed, training in (
        ("inference_activations_gb", False, False),
        ("step_activations_gb", True, True),
        ("step_activations_without_checkpoints_gb", False, True),
    ):
        size = transformer_activations(COSMOS_0_6B, target, checkpointed, training)
        rows.append(_row(f"projected.{name}", size / GIGABYTE, "GB"))
    weights = sum(p.numel() for p in _on_meta().parameters())
    trained = sum(p.numel() for p in _on_meta().parameters() if p.requires_grad)
    # float32 weights, and of the trained ones a gradient and AdamW's two moments
    rows.append(_row("projected.step_weights_gb", 4 * (weights + 3 * trained) / GIGABYTE, "GB"))
    return rows


class Law:
    """Seconds of a clip: a constant, a term linear in tokens, and attention's square."""

    def __init__(self, coefficients: np.ndarray):
        self.coefficients = coefficients

    def __call__(self, shape: Shape) -> float:
        """Seconds."""
        return float(_terms(shape) @ self.coefficients)


def fit(shapes: Sequence[Shape], seconds: Sequence[float]) -> Law:
    """The law with non-negative terms whose relative errors are least.

    Raises:
        ValueError: fewer than three clips.
    """
    from scipy.optimize import nnls

    if len(shapes) < 3:
        raise ValueError("three terms need three clips")
    times = np.asarray(seconds, float)
    terms = np.stack([_terms(shape) for shape in shapes]) / times[:, None]
    return Law(nnls(terms, np.ones(len(times)))[0])


def _terms(shape: Shape) -> np.ndarray:
    return np.array([1.0, shape.tokens, float(shape.tokens) ** 2])


def transformer_activations(config: BackboneConfig, shape: Shape, checkpointed: bool, training: bool) -> int:
    """Bytes of the transformer's activations in float32 alive at once, counted without doing the pass.

    Args:
        config: the backbone.
        shape: the clip.
        checkpointed: with recomputed blocks.
        training: forward and backward, gradients of the weights left out; else forward alone.
    """
    few = [_counted(config, layers, shape, checkpointed, training) for layers in (2, 3)]
    return few[0] + (config.layers - 2) * (few[1] - few[0])  # every further layer keeps as much


def _counted(config: BackboneConfig, layers: int, shape: Shape, checkpointed: bool, training: bool) -> int:
    with FakeTensorMode():  # shapes and lifetimes, no numbers
        backbone = Backbone(config.model_copy(update={"layers": layers}), 16, 16).requires_grad_(False)
        if checkpointed:
            backbone.transformer.enable_gradient_checkpointing()
        latent = torch.zeros(1, 16, shape.latent_frames, shape.height // 8, shape.width // 8)
        latent.requires_grad_(training)
        with torch.set_grad_enabled(training), LiveMemory() as memory:
            shown = backbone(latent, 0.2)
            if training:
                shown.square().mean().backward()
    return memory.peak


def measure(
    shapes: Sequence[tuple[int, int, int]], threads: int, bf16: bool, backward: bool
) -> dict[str, Any]:
    """Seconds of a pass, and of a training step, for each clip; the peak of this process's memory.

    Random weights of the full architecture, codec included.
    """
    from diffusers.models.autoencoders.autoencoder_kl_wan import AutoencoderKLWan

    torch.set_num_threads(threads)
    torch.manual_seed(0)
    dtype = torch.bfloat16 if bf16 else torch.float32
    renderer = NeuralRenderer(CosmosConfig(window=1), WanCodec(AutoencoderKLWan())).to(dtype)
    assert isinstance(renderer.backbone, Backbone)
    transformer = renderer.backbone.transformer
    seconds: dict[str, list[float]] = {"forward": [], "step": []}
    for width, height, frames in shapes:
        video = torch.rand(1, 3, frames, height, width, dtype=dtype) * 2 - 1
        buffers = dict.fromkeys(renderer.config.guidance, video)
        with torch.no_grad():
            seconds["forward"].append(_seconds(lambda given=buffers: renderer(given)))
        if backward:
            transformer.enable_gradient_checkpointing()
            seconds["step"].append(_seconds(lambda given=buffers: renderer(given).square().mean().backward()))
            transformer.disable_gradient_checkpointing()
            renderer.zero_grad()
    return {**seconds, "peak_gb": _peak_bytes() / GIGABYTE}


def _seconds(work: Any) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def _peak_bytes() -> int:
    status = Path("/proc/self/status").read_text()
    line = next(line for line in status.splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) * 1024


def _apart(request: dict[str, Any]) -> dict[str, Any]:
    """Measure in a process of its own, so that its peak is its own."""
    command = [sys.executable, "-m", "eval.renderer.cosmos_cost", json.dumps(request)]
    # Ours come first, whatever stands on the path of the user.
    root = Path(__file__).resolve().parents[2]
    path = os.pathsep.join(filter(None, [str(root), os.environ.get("PYTHONPATH")]))
    environment = os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": str(request["threads"])}
    result = subprocess.run(command, capture_output=True, text=True, cwd=root, env=environment)
    if result.returncode != 0:
        said = result.stderr.strip()[-300:] or f"it ended with {result.returncode}, for want of memory?"
        raise TronError(f"measuring Cosmos failed: {said}")
    return json.loads(result.stdout.splitlines()[-1])


def _on_meta() -> Backbone:
    with torch.device("meta"):
        return Backbone(COSMOS_0_6B, 16, 16)


def _checked(width: int, height: int, frames: int) -> Shape:
    if width % 16 or height % 16 or (frames - 1) % 4:
        raise TronError(f"a clip of {width} x {height}, K = {frames}", mend="sides of 16n and 1 + 4n frames")
    return Shape(width, height, frames)


def _triple(shape: Shape) -> tuple[int, int, int]:
    return shape.width, shape.height, shape.frames


def _row(name: str, value: float, unit: str, n: int = 1) -> Row:
    return Row(metric=f"cosmos.{name}", value=value, unit=unit, n=n)


if __name__ == "__main__":
    print(json.dumps(measure(**json.loads(sys.argv[1]))))
