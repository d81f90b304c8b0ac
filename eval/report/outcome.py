"""Result of a benchmark: the figures, and the parts of the page that are its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from eval.results import Row
from tron.report.page import Section


@dataclass(frozen=True)
class Outcome:
    """Figures of a benchmark and its page.

    Attributes:
        rows: the figures, in the order in which they are read.
        title: of the page.
        verdict: the finding in one or two sentences.
        lead: paragraphs for a reader who has never seen TRON.
        sections: the body of the page.
        headline: metrics that become tiles on top of the page, with a label each.
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
