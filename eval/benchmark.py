"""Benchmarks, one file each; ``conf/eval/benchmark/NAME.yaml`` names the class by ``_target_``.

A benchmark is a pydantic model of its own settings with a ``run`` method. It measures and describes; the
command line (:mod:`eval.cli`) writes results.json and report.html, so that every benchmark's files look the
same.
"""

from __future__ import annotations

import abc
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field

from eval.report.page import Section
from eval.results import Row, Target


@dataclass(frozen=True)
class Outcome:
    """What a benchmark found.

    Attributes:
        rows: the figures, in the order in which they are read.
        headline: metrics that become tiles on top of the page, with a label each.
        verdict: the finding in one or two sentences.
        lead: paragraphs for a reader who has never seen TRON.
        sections: the body of the page.
        reproduce: command lines that measure it again.
        inputs: what was measured (data set, weights, their hashes); joins the environment in results.json.
    """

    rows: Sequence[Row]
    title: str
    verdict: str
    lead: Sequence[str]
    sections: Sequence[Section]
    headline: dict[str, str] = field(default_factory=dict)
    reproduce: Sequence[str] = ()
    inputs: dict[str, Any] = field(default_factory=dict)


class Benchmark(BaseModel, abc.ABC):
    """Settings of a benchmark and the targets that its rows are held to."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: ClassVar[str]
    targets: list[Target] = Field(default_factory=list)

    def bounds(self) -> list[Target]:
        """The targets that the rows are held to, those of a benchmark inside this one included."""
        return self.targets

    def check(self) -> None:
        """Look at the inputs before anything is written.

        Raises:
            TronError: an input is missing or is not what it should be.
        """

    @abc.abstractmethod
    def run(self, output_dir: Path) -> Outcome:
        """Measure. Pictures and other files go below ``output_dir``, which exists.

        Raises:
            TronError: an input is missing or is not what it should be.
        """
