"""Frames a second of the checkpoints, rendering and in training, at several sizes."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from eval.renderer.networks import TITLES, Network
from eval.renderer.settings import Kind, ThroughputSettings
from eval.report.charts import line_chart
from eval.results import Row
from tron.report.page import Section, Table, Text
from tron.seeds import generator

if TYPE_CHECKING:
    from tron.neural.protocols import Renderer

Way = str
INFERENCE, TRAINING = "inference", "training"
WAYS = {INFERENCE: "frames_per_second", TRAINING: "training_frames_per_second"}
WARM_UP = 1
"""Rounds that do not count."""


@dataclass(frozen=True)
class Throughput:
    """Findings: (checkpoint, way, width of a frame) -> seconds of each round."""

    seconds: Mapping[tuple[Kind, Way, int], list[float]]
    threads: int

    def rows(self, seed: int) -> Iterator[Row]:  # noqa: ARG002
        """Frames a second by medians; those without a checkpoint's name are of the one with lit."""
        for (kind, way, size), rounds in self.seconds.items():
            start = "renderer" if kind == "lit" else f"renderer.{kind}"
            value = 1 / statistics.median(rounds)
            yield Row(metric=f"{start}.{WAYS[way]}.{size}", value=value, unit="frames/s", n=len(rounds))

    def sections(self, pictures: Path) -> list[Section]:  # noqa: ARG002
        """A table and a chart over sizes."""
        sizes = sorted({size for _, _, size in self.seconds})
        lines = {}
        kinds: list[Kind] = list(dict.fromkeys([kind for kind, _, _ in self.seconds]))
        runs: list[tuple[Kind, Way]] = list(dict.fromkeys([(kind, way) for kind, way, _ in self.seconds]))
        for kind, way in runs:
            points = [(size, 1 / statistics.median(self.seconds[kind, way, size])) for size in sizes]
            lines[f"{kind}, {way}"] = points
        titles = "; ".join(f"{kind}: {TITLES[kind]}" for kind in kinds)
        rows = [[label, *(f"{rate:.2f}" for _, rate in points)] for label, points in lines.items()]
        caption = f"Frames a second on {self.threads} thread(s), single frames, medians of rounds in turns."
        text = Text(
            f"{titles}. Inference is the network alone, guidance given. A training step is forward, backward "
            "and AdamW on whole frames, batch 1: without reading and augmenting data."
        )
        table = Table(caption, ["", *(f"{size}²" for size in sizes)], rows)
        chart = line_chart(
            lines, "width of a frame, pixels", "frames a second", "Throughput.", logarithmic=True
        )
        return [Section("throughput", "Frames a second", [text, table, chart])]


def measure_throughput(
    settings: ThroughputSettings, networks: Mapping[Kind, Network], threads: int, seed: int
) -> Throughput:
    """Time every checkpoint at every size; within a round all take turns."""
    seconds: dict[tuple[Kind, Way, int], list[float]] = {}
    for size in settings.sizes:
        runs: dict[tuple[Kind, Way], Callable[[], None]] = {}
        for kind, network in networks.items():
            runs[kind, INFERENCE] = _inference(network.renderer, size, seed)
            runs[kind, TRAINING] = _training(network.renderer, size, seed)
        for number in range(settings.rounds + WARM_UP):
            for (kind, way), run in runs.items():
                begun = time.perf_counter()
                run()
                took = time.perf_counter() - begun
                if number >= WARM_UP:
                    seconds.setdefault((kind, way, size), []).append(took)
    return Throughput(seconds, threads)


def _buffers(renderer: Renderer, size: int, seed: int):
    import torch

    rng = generator(seed, "eval", "throughput", size)
    shape = (1, 3, 1, size, size)
    return {
        name: torch.from_numpy(rng.uniform(-1, 1, shape).astype(np.float32))
        for name in (*renderer.config.guidance, "rgb")
    }


def _inference(renderer: Renderer, size: int, seed: int) -> Callable[[], None]:
    import torch

    buffers = _buffers(renderer, size, seed)
    del buffers["rgb"]

    def run() -> None:
        with torch.no_grad():
            renderer(buffers)

    return run


def _training(renderer: Renderer, size: int, seed: int) -> Callable[[], None]:
    """A step on a copy, which alone is changed."""
    import copy

    import torch

    learner = copy.deepcopy(renderer).train().requires_grad_(True)
    optimizer = torch.optim.AdamW(learner.parameters(), lr=1e-6)
    buffers = _buffers(renderer, size, seed)
    truth = buffers.pop("rgb")

    def run() -> None:
        optimizer.zero_grad()
        torch.nn.functional.mse_loss(learner(buffers), truth).backward()
        optimizer.step()

    return run
