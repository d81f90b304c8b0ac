"""Benchmarks, one file each; ``conf/eval/benchmark/NAME.yaml`` names the class by ``_target_``.

A benchmark is a pydantic model of its own settings with a ``run`` method. It measures and describes; the
command line (:mod:`eval.cli`) writes results.json and report.html, so that every benchmark's files look the
same.
"""

from __future__ import annotations

import abc
from pathlib import Path
from typing import ClassVar

from pydantic import BaseModel, ConfigDict, Field

from eval.report.outcome import Outcome
from eval.results import Target


class Benchmark(BaseModel, abc.ABC):
    """Settings of a benchmark and the targets that its rows are held to."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: ClassVar[str]
    targets: list[Target] = Field(default_factory=list)

    def bounds(self) -> list[Target]:
        """Return the targets of the rows, including targets of a nested benchmark."""
        return self.targets

    def check(self) -> None:
        """Check the inputs before anything is written.

        Raises:
            TronError: an input is missing or is not what it should be.
        """

    @abc.abstractmethod
    def run(self, output_dir: Path) -> Outcome:
        """Measure, and write pictures and other files below ``output_dir``, which exists.

        Raises:
            TronError: an input is missing or is not what it should be.
        """
