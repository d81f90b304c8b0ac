"""Gains of the checkpoints on one test distribution, at one or more sizes of its frames.

The network of the paper's two buffers is compared with the best baseline of direct light: baselines of pbr
and irradiance alone and, harder, baselines that also see unshadowed irradiance and shadowed shading, from
which the two buffers are made. ``over_two_buffers`` is the gain over the former alone. The network that
starts from lit is compared with lit and all fits on it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from eval.confidence import quotient, scene_sums, without_one
from eval.relighting.baselines import DENOISED, DIRECT, NEURAL, NEURAL_LIT, ON_LIT
from eval.relighting.buffers import MATERIALS, REGIONS
from eval.relighting.scores import GROUPS, Scores, Where
from eval.renderer.sharpness import sharpness_rows
from eval.results import Row, mean_row
from tron.errors import TronError

TWO_BUFFERS = ["pbr", "pbr_x_irradiance", "affine", "affine_filtered", "pixel_mlp"]
"""Baselines that see pbr and irradiance, and nothing else."""
PIXELWISE = ["lit", "affine_lit", "pixel_mlp_lit"]
"""Of the rivals of the network that starts from lit, those that see one pixel at a time."""
PAIR_RIVALS: dict[str, list[str]] = {
    "gain_db": GROUPS[DIRECT],
    "gain_over_two_buffers_db": TWO_BUFFERS,
    "gain_over_pbr_db": ["pbr"],
}
LIT_RIVALS: dict[str, list[str]] = {
    "gain_db": ["lit", *GROUPS[ON_LIT]],
    "gain_over_pixelwise_db": PIXELWISE,
    "gain_over_lit_db": ["lit"],
    **{f"gain_over_{name}_db": [each.name] for name, each in DENOISED.items()},
}
RIVALS = {NEURAL.name: ("renderer", PAIR_RIVALS), NEURAL_LIT.name: ("renderer.lit", LIT_RIVALS)}
"""Method -> beginning of its rows, and what its gains are over by the end of their names."""
INPUT = {NEURAL.name: "pbr", NEURAL_LIT.name: "lit"}
"""Method -> what it starts from."""
WORST, WORST_OVER_INPUT, KEPT = "worst_scene_gain_db", "worst_scene_over_input_db", "gain_kept"
WORST_OVER = {f"worst_scene_over_{name}_db": [each.name] for name, each in DENOISED.items()}
"""Ends of the names of rows on single scenes; see :func:`scene_rows`."""


def gain_rows(prefix: str, sizes: Mapping[int, Scores], seed: int, every_size: bool = False) -> Iterator[Row]:
    """Yield gains, PSNRs and SSIMs, overall and by family and style, for foreground and full frames.

    Args:
        prefix: prefix of the word gain in names of rows: "", "ood_", "final_" or "capture_".
        sizes: width of a frame -> scores.
        seed: draws the scenes of the intervals.
        every_size: whether all names hold their size; otherwise names of the first size do not.
    """
    for size, scores in sizes.items():
        known = {each.name for each in scores.methods}  # per-pixel networks are not always trained
        of_size = f".{size}" if every_size or size != next(iter(sizes)) else ""
        for where in places(scores):
            tail = where.tail_after(of_size)
            for method, (start, rivals) in RIVALS.items():
                for end, over in rivals.items():
                    name = f"{start}.{prefix}{end}{tail}"
                    there = [each for each in over if each in known]
                    if row := scores.gain_row(name, method, there, where, seed):
                        yield row
            for method in (each.name for each in scores.methods):
                name = f"renderer.{prefix}psnr.{method.replace('.', '_')}{tail}"
                if row := scores.mean_row(name, method, where, seed):
                    yield row
        yield from scene_rows(prefix, scores, of_size, seed)
        yield from seen_rows(prefix, scores, of_size, seed)
        yield from material_rows(prefix, scores, of_size, seed)
        there = [each for each in LIT_RIVALS["gain_db"] if each in known]
        yield from sharpness_rows(prefix, scores, there, of_size, seed)


def scene_rows(prefix: str, scores: Scores, tail: str, seed: int) -> Iterator[Row]:
    """Yield the spread over single scenes of the foreground gain over the best rival.

    Rows are the gain without the scene that raises it most, and the share of the gain that remains (0 without
    gain); and the least gain of a scene over the scene's best rival, over the network's start picture and,
    with lit, over each denoiser.
    """
    for method, (start, rivals) in RIVALS.items():
        known = {each.name for each in scores.methods}
        over = [each for each in rivals["gain_db"] if each in known]
        name = f"{start}.{prefix}"
        gain = scores.gain_row(f"{name}gain_leave_one_out_db{tail}", method, over, seed=seed)
        if gain is None:
            continue
        if gain.without_one is not None:
            left, count = gain.without_one[0], gain.n
            yield Row(metric=gain.metric, value=left, unit="dB", n=count)
            kept = left / gain.value if gain.value > 0 else 0.0
            yield Row(metric=f"{name}{KEPT}{tail}", value=kept, unit="fraction", n=count)
        ends = {WORST: over, WORST_OVER_INPUT: [INPUT[method]]}
        if method == NEURAL_LIT.name:
            ends |= WORST_OVER
        for end, others in ends.items():
            by_scene = scores.scene_gains(method, others)
            if by_scene:
                value, count = min(by_scene.values()), len(by_scene)
                yield Row(metric=f"{name}{end}{tail}", value=value, unit="dB", n=count)


def seen_rows(prefix: str, scores: Scores, tail: str, seed: int) -> Iterator[Row]:
    """Yield SSIM and FLIP of every method, and gains; unlike PSNR these do not reward blur."""
    known = {each.name: scores.of(each.name, Where()) for each in scores.methods}
    for figure in ("ssim", "flip"):
        if not all(figure in score.figures for found in known.values() for score in found):
            continue  # FLIP is not installed
        for method in known:
            name = f"renderer.{prefix}{figure}.{method.replace('.', '_')}{tail}"
            if row := scores.mean_row(name, method, seed=seed, figure=figure):
                yield row
        for method, (start, rivals) in RIVALS.items():
            there = [each for each in rivals["gain_db"] if each in known]
            name = f"{start}.{prefix}{figure}_gain{tail}"
            if row := scores.gain_row(name, method, there, seed=seed, figure=figure):
                yield row


def material_rows(prefix: str, scores: Scores, tail: str, seed: int) -> Iterator[Row]:
    """Yield PSNRs and gains on metals and on other materials, over frames that have them.

    ``rest`` is the gain without metals, so it shows whether metals carry the mean. PSNRs are of the networks,
    lit and denoisers.
    """
    known = {each.name for each in scores.methods}
    for where in map(Where, MATERIALS):
        end = where.tail_after(tail)
        for method, (start, rivals) in RIVALS.items():
            for gain, over in rivals.items():
                there = [each for each in over if each in known]
                if row := scores.gain_row(f"{start}.{prefix}{gain}{end}", method, there, where, seed):
                    yield row
        for method in (*RIVALS, "lit", *(each.name for each in DENOISED.values())):
            if row := scores.mean_row(f"renderer.{prefix}psnr.{method}{end}", method, where, seed):
                yield row


def between(metric: str, method: str, scores: Scores, other: Scores, seed: int) -> Row | None:
    """Return a method's PSNR minus its PSNR on other data of the same frames; None if not scored.

    Raises:
        TronError: the frames differ.
    """
    ours, theirs = (
        [(each.clip, each.scene, each.figures["psnr"]) for each in of.of(method, Where())]
        for of in (scores, other)
    )
    if not ours or not theirs:
        return None
    if [each[:2] for each in ours] != [each[:2] for each in theirs]:
        raise TronError(f"{metric}: the data sets do not hold the same clips", mend="make both by one recipe")
    scenes = [scene for _, scene, _ in ours]
    gains = [mine[2] - yours[2] for mine, yours in zip(ours, theirs)]
    per_scene = scene_sums(scenes, np.stack([gains, np.ones(len(gains))], axis=1))
    row = mean_row(metric, "dB", zip(scenes, gains), seed)
    return row.model_copy(update={"without_one": without_one(per_scene, quotient)})


def time_rows(prefix: str, seconds: Mapping[str, Sequence[float]], size: int) -> Iterator[Row]:
    """Yield median seconds per frame of every timed method, without making the guidance."""
    for method, found in seconds.items():
        name = f"renderer.{prefix}seconds.{method.replace('.', '_')}.{size}"
        yield Row(metric=name, value=float(np.median(found)), unit="s", n=len(found))


def everywhere(rows: Iterable[Row]) -> Iterator[Row]:
    """Yield the least of each single-scene row of the network that starts from lit, over all data."""
    found = list(rows)
    for end in (WORST, WORST_OVER_INPUT, *WORST_OVER, KEPT):
        pattern = re.compile(rf"renderer\.lit\.([a-z]+_)*{end}(\.\d+)?")
        if there := [row for row in found if pattern.fullmatch(row.metric)]:
            least = min(there, key=lambda row: row.value)
            yield least.model_copy(update={"metric": f"renderer.lit.everywhere.{end}"})


def over_lit(scores: Scores, seed: int) -> list[Row]:
    """Return foreground gains over lit of the network that starts from lit, by family or style."""
    parts = [each for each in places(scores) if each.region == "foreground"]
    kinds = [each for each in parts if each.family or each.style] or parts
    rows = (scores.gain_row("renderer.lit.any", NEURAL_LIT.name, ["lit"], where, seed) for where in kinds)
    return [row for row in rows if row is not None]


def places(scores: Scores) -> list[Where]:
    """Return for both regions: all clips, each light family if there are several, and each style."""
    families = scores.families if len(scores.families) > 1 else []
    kinds = [(family, None) for family in (None, *families)] + [(None, style) for style in scores.styles]
    return [Where(region, family, style=style) for family, style in kinds for region in REGIONS]
