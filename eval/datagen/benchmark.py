"""Benchmark `datagen`: what the data engine's world teaches, how fast it is made, and what it survives."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from eval.datagen.captured import measure_captured
from eval.datagen.hostile import measure_hostile
from eval.datagen.kills import measure_kills
from eval.datagen.merge import measure_merge
from eval.datagen.paper_smoke import measure_paper_smoke
from eval.datagen.parts import Found
from eval.datagen.reader import measure_reader
from eval.datagen.settings import DatagenSettings, Part
from eval.datagen.sharing import measure_sharing
from eval.datagen.soak import measure_soak
from eval.datagen.specifications import measure_specifications
from eval.datagen.throughput import measure_throughput
from eval.datagen.variety import measure_variety
from eval.datagen.workers import measure_workers
from eval.report.outcome import Outcome
from eval.report.stage_table import stage_section
from eval.results import Row
from eval.stages import Stages, script_path
from tron.cli.installation import require_own_packages

log = logging.getLogger("tron.eval")

LEAD = (
    "tron-datagen makes what TRON's neural renderer learns from: scenes drawn from seeds, path-traced, "
    "turned into surfels, and rendered again by TRON's tracer.",
    "This page asks what a renderer learns from them that is of use on real models under photographed light, "
    "how many frames this machine makes in an hour, and whether the engine keeps its promises: flat memory, "
    "the same bytes from any number of workers, on any processor, and after any number of kills.",
)
HEADLINE = {
    "variety.ood_gain_db": "Gain of the new world on real models",
    "variety.loss_db": "Loss on the old world's test scenes",
    "lights.sharing_gain": "20 lights together: times as fast as one by one",
    "workers.speedup_2": "Two workers: times as fast as one",
    "frames_per_hour.256": "Frames an hour, 256²",
    "soak.rss_growth_mb": "Growth of memory over the soak",
    "kills.identical": "Kills that left no trace",
    "hostile.refused": "Hostile files refused",
    "captured.kill_identical": "Kills of captures, one a phase, that left no trace",
    "captured.seconds_per_scene": "Seconds of a capture, 48 views of 128²",
}


class Datagen(DatagenSettings):
    """Parts of the benchmark; the commands of variety that are finished are not run again."""

    def check(self) -> None:
        """Find the commands that the parts call."""
        require_own_packages("datagen", "train")
        for name in ("tron-datagen", "tron-train", "tron-eval"):
            script_path(name)

    def run(self, output_dir: Path) -> Outcome:
        """Measure part after part; one line on stderr for each figure.

        Raises:
            StageFailed: a command failed.
        """
        self.check()
        folder = output_dir.absolute()
        found: dict[str, Found] = {}
        rows: list[Row] = []
        for part in self.parts:
            found[part] = self._measure(part, folder)
            for row in found[part].rows(self.seed):
                log.info("%s: %.4g %s", row.metric, row.value, row.unit)
                rows.append(row)
        sections = [section for each in found.values() for section in each.sections(folder / "pictures")]
        records = {**Stages(folder / "variety").records, **Stages(folder).records}
        return Outcome(
            rows=rows,
            title="The data engine: what its world teaches, how fast it is made, what it survives",
            verdict=_verdict({row.metric: row for row in rows}),
            lead=LEAD,
            sections=[*sections, *stage_section(records)],
            headline=HEADLINE,
            reproduce=[" ".join(_typed(self.parts, output_dir))],
            inputs={"settings": self.model_dump(mode="json", exclude={"targets"})},
        )

    def _measure(self, part: Part, folder: Path) -> Found:
        if part == "variety":  # its commands are stages of their own
            return measure_variety(self.variety, self.seed, folder / part)
        tiny = self.tiny
        measures: dict[str, Callable[[Path], Found]] = {
            "sharing": lambda at: measure_sharing(self.sharing, at),
            "workers": lambda at: measure_workers(self.workers, self.rounds, at),
            "soak": lambda at: measure_soak(tiny, self.soak_scenes, at),
            "kills": lambda at: measure_kills(_of(tiny, self.kill_scenes), self.kills, self.seed, at),
            "merge": lambda at: measure_merge(_of(tiny, self.merge_scenes), at),
            "specifications": lambda at: measure_specifications(
                [*_of(tiny, self.specified_scenes), *self.specified], at
            ),
            "reader": lambda at: measure_reader(self.reader, self.seed, at),
            "paper_smoke": measure_paper_smoke,
            "throughput": lambda at: measure_throughput(self.throughput, self.sizes, at),
            "hostile": measure_hostile,
            "captured": lambda at: measure_captured(self.captured, self.seed, at),
        }
        stages = Stages(folder)
        stages.restart(part)  # a figure of this run, never of one before
        with stages.timed(part, [_typed([part], folder)]):
            return measures[part](folder / part)


def _of(recipe: Sequence[str], scenes: int) -> list[str]:
    return [*recipe, f"train.scenes={scenes}"]


def _typed(parts: Sequence[str], output_dir: Path) -> list[str]:
    given = ("benchmark=datagen", f"benchmark.parts=[{','.join(parts)}]", f"output_dir={output_dir}")
    return ["tron-eval", *given]


def _verdict(found: Mapping[str, Row]) -> str:
    said = []
    if row := found.get("variety.ood_gain_db"):
        said.append(f"Trained on the new world the renderer gains {row.value:+.2f} dB on real models.")
    if row := found.get("workers.speedup_2"):
        said.append(f"Two workers are {row.value:.2f} times as fast as one.")
    if row := found.get("kills.identical"):
        said.append(f"{row.value:.0f} of {row.n} kills left no trace.")
    return " ".join(said) or "Only some parts were run."
