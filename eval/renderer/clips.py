"""Clips: what windows of several frames bring over single frames, in flicker and in PSNR."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from eval.confidence import interval, scene_sums
from eval.relighting.buffers import MEMBERS, SURFELS_DEPTH, Buffers, region_mask
from eval.renderer.networks import TITLES, Network
from eval.renderer.pictures import LEAST_WIDTH, enlarge
from eval.renderer.settings import Kind
from eval.renderer.warping import DEPTH, Flicker, flicker, steps
from eval.report.intervals import interval_note
from eval.results import Row, mean_row
from tron import metrics
from tron.errors import TronError
from tron.neural.reprojection import averaged_frames
from tron.neural.windows import Overlap
from tron.report.page import Block, Cell, Film, Films, Section, Table, Text
from tron.report.values import format_value
from tron.shards.reader import read_clips
from tron.video import VideoWriter

log = logging.getLogger("tron.eval")

TRUTH, LIT, LIT_AVERAGED = "truth", "lit_buffer", "lit_buffer_averaged"
SINGLE, UNMOVED, AVERAGED = "k1", "unmoved", "averaged"
"""Single frames; windows whose frames are not averaged along their motion; single frames that are."""
PLAIN = {
    TRUTH: "path-traced truth",
    LIT: "lit, no network",
    LIT_AVERAGED: "lit, no network, averaged along its motion alike",
}
FILM_FPS = 10.0


@dataclass(frozen=True)
class ClipScore:
    """One clip by one method: its flicker, and the PSNR of each of its frames in dB (foreground)."""

    scene: str
    flicker: Flicker
    psnr: Sequence[float]


@dataclass(frozen=True)
class Example:
    """Clip to look at: its name, and method -> (K, H, W, 3) display values."""

    title: str
    frames: Mapping[str, np.ndarray]


@dataclass
class Clips:
    """Findings.

    Attributes:
        window: frames of a pass of the windowed methods.
        overlap: the way of overlapping that figures without a name are of.
        example: frames of the clip that flickers most by single frames, by method; None before it was seen.
        scores: method -> a score a clip; methods are TRUTH, LIT, LIT_AVERAGED and ``KIND.k1``,
            ``KIND.unmoved``, ``KIND.averaged``, ``KIND.OVERLAP``.
    """

    window: int
    overlap: Overlap
    example: Example | None = None
    scores: defaultdict[str, list[ClipScore]] = field(default_factory=lambda: defaultdict(list))

    @property
    def kinds(self) -> list[Kind]:
        """Checkpoints that were judged."""
        kinds: tuple[Kind, ...] = ("lit", "pair")
        return [kind for kind in kinds if f"{kind}.{SINGLE}" in self.scores]

    def ways(self, kind: Kind) -> list[str]:
        """Ways of overlapping that a checkpoint was judged with."""
        names = [name.partition(".") for name in self.scores]
        return [way for owner, _, way in names if owner == kind and way != SINGLE]

    def rows(self, seed: int) -> Iterator[Row]:
        """Root mean squared flicker of every method; ratios and gains of windows over single frames.

        Figures without a checkpoint's name are of that which starts from lit, the default of tron-relight.
        Its windows are compared with lit that is averaged alike, too.
        """
        for method in self.scores:
            yield self._rms(method)
        for kind in self.kinds:
            for way in self.ways(kind):
                tail = f".{way}"
                yield self._ratio(f"renderer.{kind}.warp_error_ratio{tail}", kind, way, seed)
                yield self._gain(f"renderer.{kind}.clip_gain_db{tail}", kind, way, seed)
            if self.overlap in self.ways(kind):
                start = "renderer" if kind == "lit" else "renderer.pair"
                yield self._ratio(f"{start}.warp_error_ratio", kind, self.overlap, seed)
                yield self._gain(f"{start}.clip_gain_db", kind, self.overlap, seed)
        if LIT_AVERAGED in self.scores and self.overlap in self.ways("lit"):
            of = f"lit.{self.overlap}", LIT_AVERAGED
            yield self._difference("renderer.lit.clip_gain_over_lit_db", *of, seed)

    def sections(self, pictures: Path) -> list[Section]:
        """Every way of overlapping in a table, and films of a clip, which are written to ``pictures``."""
        rows: list[Sequence[Cell | str]] = []
        for method, scores in self.scores.items():
            kind, _, way = method.partition(".")
            title = PLAIN.get(method) or f"{_title(kind)}, {self._words(way)}"
            psnr = float(np.mean([value for score in scores for value in score.psnr]))
            ratio = gain = ""
            if way not in ("", SINGLE):
                ratio = f"{self._value(kind, way, 'ratio'):.3f}"
                gain = format_value(self._value(kind, way, "gain"), "dB", signed=True)
            shown = "" if method == TRUTH else format_value(psnr, "dB")
            rows.append([title, format_value(self._rms(method).value, "fraction"), ratio, shown, gain])
        scenes = len({score.scene for score in next(iter(self.scores.values()))})
        text = Text(
            "Warping error: each frame against that before it, warped by the exact flow of true surfaces, "
            "on foreground that both frames see (Lai et al. 2018). Shown as the root of the mean square, in "
            "shares of full brightness; the ratio is of mean squares, as the measure is defined, windows "
            "over single frames of the same network. Windows are averaged along the motion of the surfels' "
            f"own depth, but for those that are called in place. {interval_note(scenes)}"
        )
        headings = ["Method", "warping error, rms", "ratio to K = 1", "PSNR", "gain over K = 1"]
        blocks: list[Block] = [text, Table("Flicker and PSNR of clips, foreground.", headings, rows)]
        if self.example is not None:
            blocks.append(self._films(self.example, pictures))
        return [Section("clips", f"Clips: windows of {self.window} frames", blocks)]

    def _films(self, example: Example, pictures: Path) -> Films:
        films = []
        shown = [LIT, f"{self.kinds[0]}.{SINGLE}", f"{self.kinds[0]}.{self.overlap}", TRUTH]
        for method in [each for each in shown if each in example.frames]:
            kind, _, way = method.partition(".")
            title = PLAIN.get(method) or f"{_title(kind)}, {self._words(way)}"
            frames = example.frames[method]
            scale = -(-LEAST_WIDTH // frames.shape[2])
            film = [enlarge(frame, scale) for frame in [*frames, *frames[-2:0:-1]]]  # there and back again
            size = film[0].shape[1], film[0].shape[0]
            path = pictures / f"renderer-clips-{method.replace('.', '-')}.mp4"
            path.parent.mkdir(parents=True, exist_ok=True)
            with VideoWriter(path, FILM_FPS, size) as video:
                for frame in film:
                    video.write(frame)
            films.append(Film(path.read_bytes(), size, title, f"{example.title}: {title}"))
        return Films(example.title, films, columns=2)

    def _words(self, way: str) -> str:
        if way == UNMOVED:
            return f"K = {self.window}, {self.overlap}, in place"
        if way == AVERAGED:
            return f"K = 1, {self.window} frames averaged"
        return "K = 1" if way == SINGLE else f"K = {self.window}, {way}"

    def _value(self, kind: str, way: str, what: str) -> float:
        measure = self._ratio if what == "ratio" else self._gain
        return measure("a.b", kind, way, 0).value

    def _rms(self, method: str) -> Row:
        flickers = [score.flicker for score in self.scores[method]]
        pixels = sum(each.pixels for each in flickers)
        value = float(np.sqrt(sum(each.squared for each in flickers) / pixels))
        return Row(metric=f"renderer.warp_rms.{method}", value=value, unit="fraction", n=len(flickers))

    def _ratio(self, metric: str, kind: str, way: str, seed: int) -> Row:
        """Mean square of windows over that of single frames: the pixels are the same."""
        pairs = list(zip(self.scores[f"{kind}.{way}"], self.scores[f"{kind}.{SINGLE}"]))
        sums = np.array([[many.flicker.squared, single.flicker.squared] for many, single in pairs])
        per_scene = scene_sums([many.scene for many, _ in pairs], sums)

        def ratio(sums: np.ndarray) -> np.ndarray:
            return sums[..., 0] / np.maximum(sums[..., 1], 1e-12)

        row = Row(metric=metric, value=float(ratio(sums.sum(0))), unit="x", n=len(pairs))
        return row.within(interval(per_scene, ratio, seed))

    def _gain(self, metric: str, kind: str, way: str, seed: int) -> Row:
        return self._difference(metric, f"{kind}.{way}", f"{kind}.{SINGLE}", seed)

    def _difference(self, metric: str, method: str, other: str, seed: int) -> Row:
        """Mean difference of PSNR of two methods on the same frames."""
        found = [
            (many.scene, a - b)
            for many, single in zip(self.scores[method], self.scores[other])
            for a, b in zip(many.psnr, single.psnr)
        ]
        return mean_row(metric, "dB", found, seed)


def _title(kind: str) -> str:
    return {str(name): title for name, title in TITLES.items()}[kind]


def measure_clips(
    dataset: Path,
    split: str,
    networks: Mapping[Kind, Network],
    window: int,
    overlap: Overlap,
    overlaps: Sequence[Overlap],
) -> Clips:
    """Render every clip by single frames and by windows, overlapped in every way.

    Raises:
        TronError: no clip is as long as a window, or clips hold no true depth.
    """
    found = Clips(window, overlap)
    for clip in read_clips(dataset, split, (*MEMBERS, DEPTH, SURFELS_DEPTH)):
        if clip.meta.frames < window:
            continue
        moves, truth, inside = steps(clip), clip.displayed("rgb"), region_mask(clip, "foreground")
        if not any(move.judged.any() for move in moves):
            continue
        buffers = Buffers.of(clip)
        lit = buffers.displayed("lit")
        shown = {TRUTH: truth, LIT: lit, LIT_AVERAGED: _averaged(lit, window, overlap, buffers)}
        for kind, network in networks.items():
            single = network.clip(buffers, 1)
            shown[f"{kind}.{SINGLE}"] = single
            shown[f"{kind}.{AVERAGED}"] = _averaged(single, window, overlap, buffers)
            shown[f"{kind}.{UNMOVED}"] = network.clip(replace(buffers, motion=None), window, overlap)
            for way in overlaps:
                shown[f"{kind}.{way}"] = network.clip(buffers, window, way)
        for method, frames in shown.items():
            psnr = [
                metrics.capped_psnr(image, target, mask)
                for image, target, mask in zip(frames, truth, inside)
                if mask.any()
            ]
            found.scores[method].append(ClipScore(clip.meta.scene, flicker(frames, moves), psnr))
        scores = found.scores[f"{next(iter(networks))}.{SINGLE}"] if networks else []
        if scores and scores[-1].flicker.mean == max(score.flicker.mean for score in scores):
            found.example = Example(f"Scene {clip.meta.scene}, light {clip.meta.light}", shown)
        log.info("clip %s by windows of %d frames", clip.meta.key, window)
    if not found.scores:
        raise TronError(f"no clip of {window} frames whose surface is seen twice", dataset)
    return found


def _averaged(frames: np.ndarray, window: int, overlap: Overlap, buffers: Buffers) -> np.ndarray:
    """Pictures averaged along the motion of their clip, as tron-relight does."""
    assert buffers.motion is not None  # the clip was read with the depth of its surfels
    return np.stack(list(averaged_frames(frames, len(frames), window, buffers.motion, overlap)))
