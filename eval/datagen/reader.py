"""Samples a second from clips of many frames: one frame by index, against the whole clip.

Before the index, training read a clip's bytes from its first frame to its last, though it decoded the
sample's frames alone (`read_streamed`); whoever had no such care decoded them too (`read_whole`).
"""

from __future__ import annotations

import shutil
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from eval.datagen.settings import ReaderSettings
from eval.results import Row
from tron import seeds
from tron.report.page import Section, Table, Text
from tron.shards.clip_store import ClipStore
from tron.shards.manifest import Manifest
from tron.shards.reader import decode_clip, group_clips, tar_files
from tron.shards.schema import GUIDANCE, MEMBERS, TARGET, Clip, ClipMeta, clip_members, shard_name
from tron.shards.writer import ShardWriter

SPLIT = "train"
BUFFERS = (*GUIDANCE, TARGET)
"""Members of a sample: those of the default renderer."""
WAYS = {
    "k1": "one frame, by index",
    "k5": "five frames, by index",
    "streamed": "one frame, all bytes of the clip read",
    "whole": "one frame, all frames of the clip read and decoded",
}


@dataclass(frozen=True)
class Reader:
    """Way of WAYS -> seconds a sample in each round, on clips of a number of frames and a width."""

    seconds: Mapping[str, Sequence[float]]
    frames: int
    width: int

    def rate(self, way: str) -> float:
        """Samples a second, median of the rounds."""
        return 1 / statistics.median(self.seconds[way])

    def rows(self, seed: int) -> Iterator[Row]:  # noqa: ARG002
        """Samples a second, and how many times as fast as without the index."""
        rounds = len(self.seconds["k1"])
        for way in ("k1", "k5"):
            metric, value = f"reader.samples_per_second.{way}", self.rate(way)
            yield Row(metric=metric, value=value, unit="samples/s", n=rounds)
        for metric, way in (("reader.speedup.k1", "whole"), ("reader.speedup.k1.streamed", "streamed")):
            value = self.rate("k1") / self.rate(way)
            yield Row(metric=metric, value=value, unit="times", n=rounds)

    def sections(self, pictures: Path) -> list[Section]:  # noqa: ARG002
        """Every way in a table."""
        rows = [[words, f"{self.rate(way):.2f}"] for way, words in WAYS.items()]
        caption = f"Samples a second from clips of {self.frames} frames, {self.width}², in one process."
        text = Text(
            f"Samples hold {', '.join(BUFFERS)}, decoded. All ways take turns, on files that the system has "
            "in memory; from a disk the ways that read whole clips are slower still."
        )
        return [Section("reader", "Reading clips", [text, Table(caption, ["Sample", "a second"], rows)])]


def measure_reader(settings: ReaderSettings, seed: int, folder: Path) -> Reader:
    """Write clips, and read samples of them in all ways by turns."""
    dataset = folder / "clips"
    shutil.rmtree(dataset, ignore_errors=True)
    write_clips(dataset, settings, seed)
    store = ClipStore(dataset, SPLIT, BUFFERS)
    ways: dict[str, Callable[[int, int], Clip]] = {
        "k1": lambda clip, frame: store.read_frames(clip, [frame]),
        "k5": lambda clip, frame: store.read_frames(clip, range(frame, frame + 5)),
        "streamed": lambda clip, frame: read_streamed(dataset, clip, frame),
        "whole": lambda clip, frame: read_whole(dataset, clip, frame),
    }
    seconds: dict[str, list[float]] = {way: [] for way in ways}
    for turn in range(-1, settings.rounds):  # the first, which warms all up, does not count
        random = seeds.generator(seed, "reader", turn)
        for way, read in ways.items():
            samples = settings.samples if way in ("k1", "k5") else 1
            drawn = [
                (int(random.integers(settings.clips)), int(random.integers(settings.frames - 4)))
                for _ in range(samples)
            ]
            start = time.perf_counter()
            for clip, frame in drawn:
                read(clip, frame)
            if turn >= 0:
                seconds[way].append((time.perf_counter() - start) / samples)
    store.close()
    shutil.rmtree(dataset)
    return Reader(seconds, settings.frames, settings.width)


def read_streamed(dataset: Path, clip: int, frame: int) -> Clip:
    """One frame of a clip that is a shard of its own: all its bytes are read, one frame is decoded."""
    ((_, files),) = group_clips(tar_files(dataset / shard_name(SPLIT, clip), BUFFERS))
    return decode_clip(files, BUFFERS, [frame])


def read_whole(dataset: Path, clip: int, frame: int) -> Clip:
    """The same, of the decoded clip."""
    ((_, files),) = group_clips(tar_files(dataset / shard_name(SPLIT, clip), BUFFERS))
    whole = decode_clip(files, BUFFERS)
    return Clip(whole.meta, {name: images[frame : frame + 1] for name, images in whole.frames.items()})


def write_clips(folder: Path, settings: ReaderSettings, seed: int) -> None:
    """A dataset of clips, each a shard: smooth pictures that move, under the noise of a few paths a pixel."""
    with ShardWriter(folder, SPLIT, samples_per_shard=1) as writer:
        for clip in range(settings.clips):
            random = seeds.generator(seed, "reader", "clip", clip)
            meta = ClipMeta(
                key=f"clip{clip:03d}",
                scene=f"clip{clip:03d}",
                light="l0",
                light_family="studio",
                split=SPLIT,
                frames=settings.frames,
                width=settings.width,
                height=settings.width,
                cameras=[{"number": frame} for frame in range(settings.frames)],
                exposure=1.0,
                color_space={},
            )
            writer.write(meta, [_frame(random, settings.width, frame) for frame in range(settings.frames)])
    Manifest(shards=writer.entries).save(folder)


def _frame(random: np.random.Generator, width: int, frame: int) -> dict[str, np.ndarray]:
    x, y = np.meshgrid(*2 * [np.linspace(0, 6, width, dtype=np.float32)])
    smooth = 1 + np.sin(x[..., None] + 0.02 * frame + np.arange(3)) * np.cos(y[..., None])
    picture = smooth * random.gamma(16.0, 1 / 16, (width, width, 3)).astype(np.float32)
    one = np.ones((width, width, 1), np.float32)
    return {
        name: smooth if name in GUIDANCE else picture if MEMBERS[name].channels == 3 else one
        for name in clip_members(reference=False)
    }
