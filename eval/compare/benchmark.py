"""Benchmark `compare`: score every method's folder on a suite by the same figures."""

from __future__ import annotations

import importlib.util
import itertools
import logging
import re
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
import scipy.stats
from pydantic import Field, NonNegativeInt

from eval.benchmark import Benchmark
from eval.compare.measures import MAP_MEASURES, MEASURES
from eval.compare.scores import (
    FrameScore,
    Judged,
    common_scenes,
    identical_share,
    judge_method,
    judged_lights,
    shown,
)
from eval.compare.tables import write_tables
from eval.confidence import LEAST
from eval.protocol.method import METHOD_NAME, MethodFolder
from eval.protocol.suite import Suite
from eval.report.outcome import Outcome
from eval.results import Row, mean_row
from tron.errors import TronError
from tron.metrics import LPIPS
from tron.report.page import Picture, Pictures
from tron.seeds import generator

log = logging.getLogger("tron.eval")

EXACT = 2**13
"""Sign flips of paired differences that are all tried; of more scenes so many are drawn."""


class Compare(Benchmark):
    """Settings: the suite, the methods, and the number of pictures on the page."""

    name: ClassVar[str] = "compare"

    suite: Path | None = Field(description="folder written by tron-eval export=SUITE")
    methods: list[Path] | Path | None = Field(
        description="folder of methods' folders, or a list of methods' folders ([a,b])"
    )
    lpips: Path | None = Field(
        description="vgg16-397923af.pth of torchvision, for LPIPS; null: no LPIPS (nothing is downloaded)"
    )
    pictures: NonNegativeInt = Field(
        description="number of scenes and lights on the page, with a slider between methods"
    )
    seed: int = 0

    def check(self) -> None:
        """Read the suite and every method.yaml; TronError names what is missing or does not fit."""
        self._read()
        if self.lpips is not None:
            LPIPS.load(self.lpips)

    def run(self, output_dir: Path) -> Outcome:
        """Judge every method, then show them side by side."""
        suite, folders = self._read()
        lpips = None if self.lpips is None else LPIPS.load(self.lpips)
        if not importlib.util.find_spec("flip_evaluator"):
            log.warning("flip-evaluator is not installed: no FLIP (pip install 'tron-relight[flip]')")
        outcome, judged = Outcome(output_dir), []
        for folder in folders:
            judged.append(found := judge_method(suite, folder, lpips))
            for fault in found.faults:
                log.warning("%s, scene %s: %s", found.name, fault.scene, fault.text)
            log.info("%s: %d pictures judged, %d faults", found.name, len(found.frames), len(found.faults))
        outcome.add(rows_of(judged, set(suite.scenes), self.seed))
        with tempfile.TemporaryDirectory() as scratch:
            shares = [identical_share(suite, each, Path(scratch) / each.name) for each in judged]
        known = [share for share in shares if share is not None]
        if known:
            outcome.add([Row(metric="compare.identical_rows", value=min(known), unit="1", n=len(known))])
        write_tables(output_dir, judged, {row.metric: row for row in outcome.rows})
        self._show(outcome, suite, judged)
        outcome.inputs |= {
            "suite": suite.id,
            "tone_curve": suite.file.tone_curve,
            "background": suite.file.background,
            "methods": {each.name: each.folder.method.model_dump(mode="json") for each in judged},
            "faults": {each.name: [vars(fault) for fault in each.faults] for each in judged if each.faults},
            "no_maps": {each.name: sorted(each.missing) for each in judged if each.missing},
        }
        return outcome

    def _read(self) -> tuple[Suite, list[MethodFolder]]:
        if self.suite is None or self.methods is None:
            raise TronError("no suite or no methods", mend="give suite=DIR methods=DIR")
        suite = Suite.load(self.suite)
        if not any(judged_lights(scene) for scene in suite.scenes.values()):
            mend = "there is nothing to compare with; benchmark=judge looks at pictures alone"
            raise TronError("the suite knows no truth under any light", self.suite, mend)
        return suite, find_methods(self.methods, suite)

    def _show(self, outcome: Outcome, suite: Suite, judged: Sequence[Judged]) -> None:
        """Show middle frames of scenes and lights, evenly spaced among the lights that all methods have."""
        common = common_scenes(judged)
        pairs = [(s, light) for s in suite.scenes.values() if s.name in common for light in judged_lights(s)]
        places = np.linspace(0, len(pairs) - 1, min(self.pictures, len(pairs))).round().astype(int)
        for scene, light in (pairs[place] for place in places):
            k, exposure = scene.entry.frames // 2, scene.lights[light].exposure
            where = f"scene {scene.name} under light {light}"
            truth = suite.display(scene.truth(light)[k] * np.float32(exposure))
            pictures = [Picture(truth, "truth", f"the truth, {where}", strong=True)]
            for each in judged:
                image = shown(
                    suite,
                    each.folder,
                    each.folder.frames(scene, light),
                    exposure,
                    each.factors.get(scene.name, 1.0),
                )[k]
                mine = (
                    s.figures.get("psnr")
                    for s in each.frames
                    if (s.scene, s.light, s.frame) == (scene.name, light, k)
                )
                figure = next((f"{psnr:.1f} dB" for psnr in mine if psnr is not None), "")
                title = each.folder.method.title or each.name
                pictures.append(Picture(image, title, f"{title}, {where}", figure))
            note = f"Frame {k}. Decibels are of the foreground of this picture."
            outcome.show(
                "pictures", f"{scene.name}-{light}", Pictures(f"{scene.name}, {light}", pictures, note)
            )


def find_methods(given: Path | Sequence[Path], suite: Suite) -> list[MethodFolder]:
    """Return method name -> folder; TronError if there are none, or two of one name."""
    if isinstance(given, Path):
        folders = (
            [given]
            if (given / METHOD_NAME).is_file()
            else sorted(p.parent for p in given.glob(f"*/{METHOD_NAME}"))
        )
    else:
        folders = list(given)
    if not folders:
        raise TronError(f"no folder in it has a {METHOD_NAME}", str(given), "give the methods' common folder")
    found: dict[str, MethodFolder] = {}
    for folder in folders:
        read = MethodFolder.load(folder, suite)
        if other := found.get(read.method.name):
            raise TronError(
                f"two methods are named {read.method.name}", folder, f"rename it, or leave {other.folder} out"
            )
        found[read.method.name] = read
    return list(found.values())


def rows_of(judged: Sequence[Judged], scenes: set[str], seed: int) -> Iterator[Row]:
    """Yield rows of means, gains and p-values; a mean over all scenes needs all scenes.

    - ``METHOD.FIGURE``: mean over all pictures of all scenes, if no scene failed; ``.GROUP`` is
      for one kind of scene or family of lights. If any method failed anywhere, ``METHOD.FIGURE_common``
      is the mean over the scenes that all methods have.
    - ``METHOD.faults``, ``METHOD.scene_psnr.SCENE``; ``METHOD.seconds_fit`` and ``_frame`` from its yaml.
    - ``A.gain_over_B``: mean difference of PSNR on the same pictures; ``A.p_over_B``: see :func:`p_values`.
    """
    common = common_scenes(judged)
    for each in judged:
        name, method = each.name, each.folder.method
        yield Row(metric=f"{name}.faults", value=float(len(each.faults)), unit="faults", n=len(scenes))
        for what, value in (("fit", method.seconds.fit), ("frame", method.seconds.frame)):
            if value is not None:
                yield Row(metric=f"{name}.seconds_{what}", value=value, unit="s", n=len(scenes))
        groups = {"": each.frames} if each.whole == scenes else {}
        for key in dict.fromkeys(k for s in each.frames for k in (s.kind, s.family) if k and groups):
            groups[f".{slug(key)}"] = [s for s in each.frames if key in (s.kind, s.family)]
        if common != scenes:
            groups["_common"] = [s for s in each.frames if s.scene in common]
        for measure, full, (tail, frames) in itertools.product(MEASURES, ("", "_full"), groups.items()):
            found = [
                (s.scene, s.figures[measure.name + full]) for s in frames if measure.name + full in s.figures
            ]
            if found:
                yield mean_row(f"{name}.{measure.name}{full}{tail}", measure.unit, found, seed)
        for measure in MAP_MEASURES:
            of_scenes = [
                (s, figures[measure.name]) for s, figures in each.maps.items() if measure.name in figures
            ]
            if {s for s, _ in of_scenes} == scenes:
                yield mean_row(f"{name}.{measure.name}", measure.unit, of_scenes, seed)
        for scene in sorted(each.whole):
            psnr = [
                (s.scene, s.figures["psnr"]) for s in each.frames if s.scene == scene and "psnr" in s.figures
            ]
            if psnr:
                yield mean_row(f"{name}.scene_psnr.{slug(scene)}", "dB", psnr, seed)
    yield from _pairs([each for each in judged if each.whole >= common], common, seed)


def _pairs(judged: Sequence[Judged], common: set[str], seed: int) -> Iterator[Row]:
    """Yield the gain of the better of every two methods on the common scenes, with p-values."""
    by_method = {each.name: _by_picture(each.frames, common) for each in judged}
    gains: list[Row] = []
    differences: list[np.ndarray] = []
    for a, b in itertools.combinations(by_method, 2):
        both = [key for key in by_method[a] if key in by_method[b]]
        found = [(key[0], by_method[a][key] - by_method[b][key]) for key in both]
        if not found:
            continue
        better, other = (a, b) if np.mean([value for _, value in found]) >= 0 else (b, a)
        sign = 1.0 if better == a else -1.0
        signed = [(scene, sign * value) for scene, value in found]
        gains.append(mean_row(f"{better}.gain_over_{other}", "dB", signed, seed))
        scenes = sorted({scene for scene, _ in signed})
        differences.append(np.array([np.mean([v for s, v in signed if s == scene]) for scene in scenes]))
    yield from gains
    for gain, p in zip(gains, p_values(differences, seed)):
        if p is not None:
            yield Row(
                metric=gain.metric.replace(".gain_over_", ".p_over_"), value=p, unit="1", n=gain.scenes or 1
            )


def p_values(differences: Sequence[np.ndarray], seed: int) -> list[float | None]:
    """Return two-sided p-values of each pair's differences (n scenes), for no difference in the mean.

    Signs are flipped scene by scene (a permutation test, exact up to EXACT flips), and p-values of all
    pairs are adjusted together by Benjamini and Hochberg's procedure. None for fewer than LEAST scenes.
    """
    raw = [
        None
        if len(each) < LEAST
        else float(
            scipy.stats.permutation_test(
                (each, np.zeros_like(each)),
                lambda a, b, axis: np.mean(a - b, axis=axis),
                permutation_type="samples",
                vectorized=True,
                n_resamples=EXACT,
                rng=generator(seed, "eval", "pairs"),
            ).pvalue
        )
        for each in differences
    ]
    known = [p for p in raw if p is not None]
    adjusted = iter(scipy.stats.false_discovery_control(known) if known else ())
    return [None if p is None else float(next(adjusted)) for p in raw]


def _by_picture(frames: Sequence[FrameScore], scenes: set[str]) -> dict[tuple[str, str, int], float]:
    return {
        (s.scene, s.light, s.frame): s.figures["psnr"]
        for s in frames
        if s.scene in scenes and "psnr" in s.figures
    }


def slug(name: str) -> str:
    """Return a name in the form that rows allow."""
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_") or "_"
