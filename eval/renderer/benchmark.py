"""Benchmark `renderer`: the shipped checkpoints against the best that there is without them."""

from __future__ import annotations

import logging
from pathlib import Path

from eval.renderer import page
from eval.renderer.datasets import require_data
from eval.renderer.networks import find_weights, load_networks
from eval.renderer.parts import Found, Parts, worst_family
from eval.renderer.settings import Kind, Part, RendererSettings
from eval.report.outcome import Outcome
from eval.report.stage_table import stage_section
from eval.results import Row
from eval.stages import script_path
from tron.cli.installation import require_own_packages
from tron.errors import TronError
from tron.runtime import set_torch_threads
from tron.storage import sha256

log = logging.getLogger("tron.eval")

WITHOUT_WEIGHTS: tuple[Part, ...] = ("kills", "cosmos")


class Renderer(RendererSettings):
    """Parts of the benchmark; data sets and trainings that are finished are not made again."""

    def check(self) -> None:
        """Find the commands and the data sets, and read the checkpoints that were given."""
        require_own_packages("datagen", "train")
        for name in ("tron-datagen", "tron-train"):
            script_path(name)
        require_data(self)
        for kind, folder in self.training.items():
            if not folder.is_dir():
                raise TronError(f"no training of {kind}", folder, "give the output_dir of tron-train")
        if self.train or set(self.parts) <= set(WITHOUT_WEIGHTS):
            return
        if self.pair is None and self.lit is None:
            raise TronError(
                "no checkpoint to judge", mend="give benchmark.pair or benchmark.lit, or train=true"
            )
        if self.parts == ["stages"] and not self.training:
            mend = "give benchmark.training={lit: DIR}, the output_dir of tron-train, or train=true"
            raise TronError("part stages has no training to judge", mend=mend)
        given: dict[Kind, str | None] = {"pair": self.pair, "lit": self.lit}
        load_networks({kind: find_weights(each) for kind, each in given.items() if each is not None})

    def run(self, output_dir: Path) -> Outcome:
        """Measure part after part; one line on stderr for each figure.

        Raises:
            StageFailed: a command failed.
            TronError: data or weights are not what they should be.
        """
        self.check()
        set_torch_threads(self.threads)
        folder = output_dir.absolute()
        parts = Parts(self, folder)
        found: dict[Part, list[Found]] = {}
        rows: list[Row] = []
        for part in self.parts:
            stages = parts.datasets.stages
            stages.restart(f"part {part}")  # a figure of this run, never of one before
            with stages.timed(f"part {part}", [self._typed([part], folder)]):
                found[part] = parts.measure(part)
                fresh = [row for each in found[part] for row in each.rows(self.seed)]
            for row in fresh:
                log.info("%s: %.4g %s", row.metric, row.value, row.unit)
            rows += fresh
        families = worst_family(found, self.seed)
        if families:
            worst = min(families.values(), key=lambda row: row.value)
            rows.append(worst.model_copy(update={"metric": "renderer.lit.worst_family_gain_db"}))
        pictures = folder / "pictures"
        sections = [
            section for part in found.values() for each in part for section in each.sections(pictures)
        ]
        return Outcome(
            rows=rows,
            title="The neural renderer against the best without one, on what it never saw",
            verdict=page.verdict({row.metric: row for row in rows}),
            lead=page.LEAD,
            sections=[
                *page.parts_section({part: self.what.get(part, "") for part in self.parts}),
                *page.families_section(families),
                *sections,
                *stage_section(parts.datasets.stages.records),
            ],
            headline=page.HEADLINE,
            reproduce=[" ".join(self._typed(self.parts, output_dir))],
            inputs=self._inputs(parts),
        )

    def _inputs(self, parts: Parts) -> dict[str, object]:
        """Hashes of the checkpoints, and the settings."""
        judged = {} if set(self.parts) <= set(WITHOUT_WEIGHTS) else parts.weights
        return {
            **{f"{kind}_sha256": sha256(path) for kind, path in judged.items()},
            "settings": self.model_dump(mode="json", exclude={"targets", "what"}),
        }

    def _typed(self, parts: list[Part], output_dir: Path) -> list[str]:
        """The command that measures parts with what was given: checkpoints, trainings and data sets."""
        inner = {
            name: ", ".join(f"{key}: {path}" for key, path in getattr(self, name).items())
            for name in ("training", "data")
        }
        defaults = type(self).model_fields
        changed = [name for name in ("pair", "lit", "train") if getattr(self, name) != defaults[name].default]
        given = [
            *(f"benchmark.{name}={_plain(getattr(self, name))}" for name in changed),
            *(f"'benchmark.{name}={{{listed}}}'" for name, listed in inner.items() if listed),
        ]
        chosen = f"'benchmark.parts=[{','.join(parts)}]'"
        return ["tron-eval", "benchmark=renderer", chosen, *given, f"output_dir={output_dir}"]


def _plain(value: object) -> str:
    """A value as Hydra reads it."""
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)
