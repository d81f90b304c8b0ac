"""Figures of one benchmark on one machine (results.json), and their targets.

The file is ``{"benchmark", "environment", "rows": [{"metric", "value", "unit", "reference", "ratio",
"n"}]}``. Metric names are unique; a figure that was not measured has no row (``absent`` may say why), and a
row never holds NaN or infinity (JSON has no way to write them). Beside the rows stands what else the page is
made of: ``targets`` that the rows are held to, ``reproduce`` (commands), ``series`` (curves) and ``pictures``
(files beside it).

A row that is a mean over scenes also has ``"scenes"``, their number, and where that is two or more ``"low"``
and ``"high"``, the ends of its confidence interval (:mod:`eval.confidence`). A gain has ``"without_one"``
too, its least and greatest value where one scene is left out. Other rows lack these keys.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pydantic
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, PositiveInt

from eval.confidence import Interval, mean_interval
from tron.errors import TronError
from tron.storage import write_atomic

KEYS = ("benchmark", "environment", "rows")
"""What every results.json has; the rest where there is some."""
METRIC_PATTERN = r"^[a-z][a-z0-9_]*(\.[a-z0-9][a-z0-9_]*)+$"


class Row(BaseModel):
    """One figure."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    metric: str = Field(pattern=METRIC_PATTERN, description="what was measured, e.g. neural.psnr_full.sun")
    value: FiniteFloat = Field(description="the figure, in its unit")
    unit: str = Field(min_length=1, description="dB, s, deg, x (times), fraction, bytes, abs (error) or 1")
    reference: str | None = Field(default=None, description="reference of the value, in words")
    ratio: FiniteFloat | None = Field(default=None, description="value / reference")
    n: PositiveInt = Field(description="number of averaged items")
    low: FiniteFloat | None = Field(default=None, description="lower end of the interval over scenes")
    high: FiniteFloat | None = Field(default=None, description="upper end of the interval over scenes")
    scenes: PositiveInt | None = Field(default=None, description="number of independent scenes among the n")
    without_one: tuple[FiniteFloat, FiniteFloat] | None = Field(
        default=None, description="least and greatest figure with one scene left out"
    )

    @pydantic.model_validator(mode="after")
    def _interval(self) -> Row:
        if (self.low is None) != (self.high is None):
            raise ValueError(f"{self.metric}: an interval has two ends")
        if self.low is not None and self.high is not None:
            if self.low > self.high:
                raise ValueError(f"{self.metric}: the interval's ends are exchanged")
            if (self.scenes or 0) < 2:
                raise ValueError(f"{self.metric}: an interval needs two scenes")
        return self

    def within(self, interval: Interval) -> Row:
        """Return a copy with the interval over scenes."""
        return self.model_copy(update={"low": interval.low, "high": interval.high, "scenes": interval.scenes})

    @pydantic.model_serializer(mode="wrap")
    def _without_absent(self, plain: pydantic.SerializerFunctionWrapHandler) -> dict[str, Any]:
        absent = {name for name in ("low", "high", "scenes", "without_one") if getattr(self, name) is None}
        return {name: value for name, value in plain(self).items() if name not in absent}


def mean_row(metric: str, unit: str, found: Iterable[tuple[str, float]], seed: int) -> Row:
    """Return the mean of ``found``, pairs of (scene, value), with its interval over scenes.

    ``seed`` draws the scenes of the interval.
    """
    scenes, values = zip(*found)
    row = Row(metric=metric, value=float(np.mean(values)), unit=unit, n=len(values))
    return row.within(mean_interval(scenes, values, seed))


class Target(BaseModel):
    """A bound on one metric: a row of the small table of targets in ``conf/eval``."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    metric: str = Field(pattern=METRIC_PATTERN, description="name of the row")
    bound: Literal["at least", "at most"] = Field(description="the good side")
    value: FiniteFloat = Field(description="the bound, in the row's unit")
    what: str = Field(default="", description="the metric in words, for the report")

    def margin(self, measured: float) -> float:
        """Return the distance of ``measured`` to the bound, in its unit; negative if the bound is missed."""
        return measured - self.value if self.bound == "at least" else self.value - measured

    def reached(self, measured: float) -> bool:
        """Whether the unrounded figure reaches the bound."""
        return self.margin(measured) >= 0


class Caption(BaseModel):
    """Words of one picture or film (:class:`tron.report.page.Picture`); ``size``: height, width."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    title: str
    alt: str
    figure: str = ""
    strong: bool = False
    size: tuple[PositiveInt, PositiveInt]


class Group(BaseModel):
    """Pictures or films side by side on the page.

    Pictures are one file, ``pictures/FILE.png``: rows of ``columns`` cells as large as the largest of them,
    each picture in the upper left corner of its cell. Films are a file each, ``pictures/FILE-NUMBER.mp4``.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    section: str = Field(description="section of the page that shows them")
    file: str
    title: str
    note: str = ""
    columns: PositiveInt
    films: bool = False
    captions: list[Caption]


_ABSOLUTE = re.compile(r"(?<![\w./:~])(?:/[\w.@+-]+)+(?=/[\w.@+-]+/[\w.@+-]+)/")


def portable(value: Any) -> Any:
    """Return JSON with paths reduced to last folder and name: other machines have other folders."""
    if isinstance(value, str):
        return _ABSOLUTE.sub("", value)
    if isinstance(value, dict):
        return {key: portable(inner) for key, inner in value.items()}
    return [portable(inner) for inner in value] if isinstance(value, list) else value


class Results(BaseModel):
    """Everything in results.json; validated when read and when written."""

    model_config = ConfigDict(extra="forbid")

    benchmark: str = Field(min_length=1)
    environment: dict[str, Any]
    rows: list[Row]
    targets: list[Target] = Field(default_factory=list)
    absent: dict[str, str] = Field(default_factory=dict, description="unmeasured figure -> reason, in words")
    reproduce: list[str] = Field(default_factory=list, description="commands that repeat the measurement")
    series: dict[str, dict[str, list[tuple[FiniteFloat, FiniteFloat]]]] = Field(
        default_factory=dict, description="name of a chart -> label of a line -> (x, y) of its points"
    )
    pictures: list[Group] = Field(default_factory=list)

    @pydantic.model_validator(mode="after")
    def _unique(self) -> Results:
        seen: set[str] = set()
        for row in self.rows:
            if row.metric in seen:
                raise ValueError(f"metric {row.metric} appears twice")
            seen.add(row.metric)
        return self

    def find(self, metric: str) -> Row | None:
        """Return the row of a name, or None if it was not measured."""
        return next((row for row in self.rows if row.metric == metric), None)

    def value(self, metric: str) -> float | None:
        """Return the value of a name, or None if it was not measured."""
        row = self.find(metric)
        return None if row is None else row.value

    def held_to(self, targets: Iterable[Target]) -> Results:
        """Return a copy with the targets; rows get it as ``reference``, and ``ratio`` = value / target."""
        targets = list(targets)
        by_metric = {target.metric: target for target in targets}

        def annotated(row: Row) -> Row:
            target = by_metric.get(row.metric)
            if target is None:
                return row
            ratio = row.value / target.value if target.value else None
            reference = f"target: {target.bound} {target.value:g} {row.unit}"
            return row.model_copy(update={"reference": reference, "ratio": ratio})

        rows = [annotated(row) for row in self.rows]
        return self.model_copy(update={"rows": rows, "targets": targets})

    def save(self, path: str | Path) -> None:
        """Write the file whole or not at all; TronError if the folder cannot be written.

        Folders of this machine are removed from its texts (:func:`portable`).

        Raises:
            ValueError: two rows share a name, or a value is not finite (a defect of the benchmark).
        """
        checked = Results.model_validate(self.model_dump()).model_dump()
        written = portable({key: value for key, value in checked.items() if value or key in KEYS})
        write_atomic(path, json.dumps(written, indent=2, allow_nan=False) + "\n")

    @staticmethod
    def load(path: str | Path) -> Results:
        """Read and validate a file; TronError if it is missing or is not a results.json."""
        try:
            return Results.model_validate_json(Path(path).read_bytes())
        except OSError as error:
            raise TronError(f"cannot read: {error.strerror or error}", path) from error
        except pydantic.ValidationError as error:
            first = error.errors()[0]
            place = ".".join(str(part) for part in first["loc"]) or "file"
            raise TronError(f"not a results.json: {place}: {first['msg']}", path) from error
