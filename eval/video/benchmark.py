"""Benchmark `video`: temporal stability of clips beside the truth's own, and VBench's scores."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from pydantic import Field, PositiveFloat

from eval.benchmark import Benchmark
from eval.confidence import Statistic, interval, scene_sums
from eval.report.outcome import Outcome
from eval.results import Row, mean_row
from eval.video.order import order_rows
from eval.video.steadiness import Difference, Steadiness, Surfaces
from eval.video.vbench import WEIGHTS, VBench, write_clip
from tron.errors import TronError
from tron.flow import surface_motion

if TYPE_CHECKING:
    from eval.protocol.method import MethodFolder
    from eval.protocol.suite import Suite, SuiteScene

log = logging.getLogger("tron.eval")

MEASURES = ("warping", "flicker", "far")


@dataclass(frozen=True)
class Clip:
    """A scene under a light by a method."""

    scene: str
    light: str
    steadiness: Steadiness


class Video(Benchmark):
    """Settings: methods' clips of a suite; a drawn clip checks the measures themselves."""

    name: ClassVar[str] = "video"

    suite: Path | None = Field(description="folder of tron-eval export=SUITE; null: only the drawn clip")
    methods: Path | list[Path] | None = Field(description="folder of methods' folders, or [a,b]")
    vbench: Path | None = Field(description="Python of an environment with `vbench`; null: no VBench scores")
    vbench_weights: Path = Field(description="VBENCH_CACHE_DIR; missing weights are named, not downloaded")
    vbench_timeout: PositiveFloat = Field(description="time limit of VBench per method, seconds")
    seed: int = Field(default=0, description="seed of the drawn clip's noise, and of the intervals")

    def check(self) -> None:
        """Check that suite and methods are given together."""
        if (self.suite is None) != (self.methods is None):
            lacking = "suite" if self.suite is None else "methods"
            raise TronError(f"{lacking} is not given", mend="suite=DIR and methods=DIR belong together")
        if self.suite is not None and self.methods is not None:
            self._read(self.suite, self.methods)

    def run(self, output_dir: Path) -> Outcome:
        """Measure; write one line per figure to stderr.

        Raises:
            TronError: a folder is not what it should be.
        """
        outcome = Outcome(output_dir)
        outcome.add(order_rows(self.seed))
        if self.suite is None or self.methods is None:
            outcome.lack("video.warping", "no suite and methods were given")
            return outcome
        from eval.compare.displayed import TRUTH

        suite, folders = self._read(self.suite, self.methods)
        outcome.inputs |= {"suite": suite.id, "methods": list(folders)}
        dimensions = self._dimensions(outcome)
        clips = _measure(suite, folders, self._vbench(), dimensions, outcome)
        for method, found in clips.items():
            outcome.add(steadiness_rows(method, found, clips.get(TRUTH), self.seed))
        return outcome

    def _read(self, suite: Path, methods: Path | list[Path]) -> tuple[Suite, dict[str, MethodFolder | None]]:
        from eval.compare.displayed import methods_and_truth
        from eval.protocol.suite import Suite

        read = Suite.load(suite)
        return read, methods_and_truth(methods, read)

    def _vbench(self) -> VBench:
        return VBench(self.vbench or Path(), self.vbench_weights.expanduser(), self.vbench_timeout)

    def _dimensions(self, outcome: Outcome) -> list[str]:
        """Return VBench's measurable dimensions, and reasons why the others are not."""
        why = "no benchmark.vbench=PYTHON was given"
        absent = dict.fromkeys(WEIGHTS, why) if self.vbench is None else self._vbench().absent()
        for dimension, reason in absent.items():
            outcome.lack(f"vbench.{dimension}", reason)
        return [each for each in WEIGHTS if each not in absent]


def _measure(
    suite: Suite,
    folders: Mapping[str, MethodFolder | None],
    vbench: VBench,
    dimensions: Sequence[str],
    outcome: Outcome,
) -> dict[str, list[Clip]]:
    """Measure clips of every method with all pictures; one scene's surfaces are in memory at a time."""
    from eval.compare.displayed import displayed
    from eval.protocol.pictures import Fault

    found: dict[str, list[Clip]] = {method: [] for method in folders}
    lacking = [name for name, scene in suite.scenes.items() if "depth" not in scene.entry.maps]
    if lacking:
        outcome.lack("video.warping", f"the suite has no true depth of {', '.join(lacking)}")
    with tempfile.TemporaryDirectory(dir=outcome.folder) as films:
        for scene in suite.scenes.values():
            surfaces = None if lacking else surfaces_of(scene)
            for method in list(found):
                try:
                    for light, pictures in displayed(suite, scene, folders[method]):
                        if surfaces is not None:
                            found[method].append(Clip(scene.name, light, Steadiness.of(pictures, surfaces)))
                        if dimensions:
                            place = Path(films) / method
                            place.mkdir(exist_ok=True)
                            write_clip(place / f"{scene.name}.{light}.mp4", pictures)
                except Fault as fault:
                    outcome.lack(f"video.warping.{method}", str(fault))
                    found.pop(method)
                else:
                    log.info("clips of %s: %s", method, scene.name)
        if dimensions:
            for method in found:
                outcome.add(vbench_rows(method, vbench.measure(Path(films) / method, dimensions), 0))
    return {method: clips for method, clips in found.items() if clips}


def surfaces_of(scene: SuiteScene) -> Surfaces:
    """Return steps of a scene's test cameras over its foreground, by its true depth, which must be known."""
    from eval.compare.scores import foreground

    depth = scene.depth()
    assert depth is not None
    return Surfaces.of(surface_motion(scene.cameras, depth.__getitem__), foreground(scene) & (depth > 0))


def steadiness_rows(
    method: str, clips: Sequence[Clip], truth: Sequence[Clip] | None, seed: int
) -> Iterator[Row]:
    """Yield RMS figures over all clips, and mean squares over the truth's mean squares, with intervals."""
    for measure in MEASURES:
        of_method: list[Difference] = [getattr(each.steadiness, measure) for each in clips]
        n = sum(each.pixels for each in of_method)
        if not n:
            continue
        sums = np.array([[each.squared, each.pixels] for each in of_method])
        yield _row(f"video.{measure}.{method}", "fraction", clips, sums, _root_mean, seed)
        if truth is not None and truth is not clips:
            true = np.array([getattr(each.steadiness, measure).squared for each in truth])
            both = np.stack([sums[:, 0], true], 1)
            yield _row(f"video.{measure}_excess.{method}", "x", clips, both, _ratio, seed)


def vbench_rows(method: str, scores: Mapping[str, Mapping[str, float]], seed: int) -> Iterator[Row]:
    """Yield means over clips, named SCENE.LIGHT, with intervals over scenes."""
    for dimension, by_clip in scores.items():
        found = [(name.partition(".")[0], value) for name, value in by_clip.items()]
        yield mean_row(f"vbench.{dimension}.{method}", "fraction", found, seed)


def _row(
    metric: str, unit: str, clips: Sequence[Clip], sums: np.ndarray, figure: Statistic, seed: int
) -> Row:
    by_scene = scene_sums([each.scene for each in clips], sums)
    row = Row(metric=metric, value=float(figure(sums.sum(0))), unit=unit, n=len(clips))
    return row.within(interval(by_scene, figure, seed))


def _root_mean(sums: np.ndarray) -> np.ndarray:
    return np.sqrt(sums[..., 0] / np.maximum(sums[..., 1], 1))


def _ratio(sums: np.ndarray) -> np.ndarray:
    return sums[..., 0] / np.maximum(sums[..., 1], 1e-12)
