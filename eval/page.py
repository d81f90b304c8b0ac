"""Write report.html from results.json: a template with figures from rows, curves and pictures.

A page is one template, ``eval/report/NAME.html.j2``, that extends ``benchmark.html.j2``. Templates call the
methods of :class:`Figures` by name. A metric may be a pattern: ``*`` is any word without a
point.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from eval.compare.measures import MAP_MEASURES, MEASURES
from eval.compare.published import published
from eval.relighting.baselines import METHODS
from eval.relighting.scores import METRICS
from eval.report.figures import bound, interval_note, left_out, row_cell, verdict, with_interval
from eval.report.outcome import load_group
from eval.results import Results, Row
from eval.stages import StageFile
from tron.denoising import DENOISERS
from tron.errors import TronError
from tron.report.charts import line_chart
from tron.report.page import Cell, Chart, Code, Films, Pictures, Table, Tile, format_value
from tron.report.render import render_template
from tron.storage import write_atomic

MULTIPLES = {"k": 1e3, "m": 1e6}


def write_page(folder: Path) -> Path:
    """Write ``folder/report.html`` from results.json; missing pictures are left out.

    Raises:
        TronError: there is no results.json, or the folder cannot be written.
    """
    results = Results.load(folder / "results.json")
    template = f"{results.benchmark}.html.j2"
    if not (Path(__file__).parent / "report" / template).is_file():
        raise TronError(f"no page for benchmark {results.benchmark}", folder / "results.json")
    path = folder / "report.html"
    functions = Figures(results, folder)
    names = {name: getattr(functions, name) for name in dir(functions) if not name.startswith("_")}
    titles = {method.name: method.title for method in METHODS}
    names |= {"metrics": METRICS, "methods": titles, "what": {method.name: method.what for method in METHODS}}
    names |= {"measures": MEASURES, "map_measures": MAP_MEASURES, "published": published}
    names["denoisers"] = {name: row.title for name, row in DENOISERS.items()}
    names["underscored"] = {name.replace(".", "_"): title for name, title in titles.items()}
    page = render_template("eval.report", template, brand="benchmark report", **names)
    write_atomic(path, page)
    return path


class Figures:
    """Functions for templates.

    Args:
        results: results of the benchmark.
        folder: folder of results.json, of its pictures, and of stages.json if commands were run.
    """

    def __init__(self, results: Results, folder: Path):
        self.results, self._folder = results, folder
        self._rows = {row.metric: row for row in results.rows}
        self._opened: str | None = None
        commit = str(results.environment.get("commit") or "unknown")
        self.commit = commit + (" with uncommitted changes" if results.environment.get("dirty") else "")

    def row(self, metric: str) -> Row | None:
        """Return the first row of a name or pattern."""
        return next(iter(self.rows(metric)), None)

    def rows(self, pattern: str) -> list[Row]:
        """Return all rows of a pattern, in order."""
        if "*" not in pattern:
            return [self._rows[pattern]] if pattern in self._rows else []
        found = _compiled(pattern)
        return [row for row in self.results.rows if found.fullmatch(row.metric)]

    def value(self, metric: str) -> str:
        """Format a figure with its unit and interval; a dash if it was not measured."""
        row = self.row(metric)
        return "—" if row is None else with_interval(row)

    def span(self, pattern: str) -> str:
        """Format the least and greatest value of rows: ``14.0 to 31.1``."""
        values = [row.value for row in self.rows(pattern)]
        ends = list(dict.fromkeys(f"{each:.1f}" for each in (min(values), max(values)))) if values else ["—"]
        return " to ".join(ends)

    def names(self, pattern: str, without: Iterable[str] = ()) -> list[str]:
        """Return the words that match the pattern's first ``*``, in the order of the rows."""
        found = (_compiled(pattern).fullmatch(row.metric) for row in self.results.rows)
        return list(dict.fromkeys(each[1] for each in found if each and each[1] not in without))

    def each(self, pattern: str, names: Iterable[str]) -> dict[str, str]:
        """Return columns of a table: name -> the pattern with the name in place of ``{}``."""
        return {name: pattern.replace("{}", name) for name in names}

    def table(
        self,
        caption: str,
        columns: Mapping[str, str],
        rows: Mapping[str, str] | None = None,
        first: str = "",
        words: Mapping[str, str] | None = None,
        strong: Sequence[str] = (),
    ) -> Table | None:
        """Return a table of figures, None without figures. Rows and columns without a figure are left out.

        Args:
            caption: caption of the table.
            columns: heading -> metric, ``*`` in place of the row's key.
            rows: key -> label; by default every key that a column has.
            first: heading of the labels.
            words: key -> text of a last column.
            strong: keys of emphasised rows.
        """
        keys = rows or {key: key for pattern in columns.values() for key in self.names(pattern)}
        found = {key: [self._rows.get(p.replace("*", key, 1)) for p in columns.values()] for key in keys}
        found = {key: cells for key, cells in found.items() if any(cells)}
        there = [k for k in range(len(columns)) if any(cells[k] for cells in found.values())]
        table = [
            [
                Cell(keys[key], tone := "strong" if key in strong else "plain"),
                *(row_cell(cells[k], tone) if cells[k] else Cell("") for k in there),
                *([Cell(words.get(key, ""), "faint")] if words else []),
            ]
            for key, cells in found.items()
        ]
        headings = [first, *(list(columns)[k] for k in there), *(["What it is"] if words else [])]
        return Table(caption, headings, table, words=[len(there) + 1] if words else ()) if table else None

    def figures(self, caption: str, metrics: Mapping[str, str]) -> Table | None:
        """Return a table with one figure per row, from metric -> description."""
        return self.table(caption, {"Measured": "*"}, metrics)

    def growth(
        self, caption: str, x_label: str, y_label: str, lines: Mapping[str, str], square: bool = False
    ) -> Chart | None:
        """Return a logarithmic chart over the count in the rows' names: ``*`` stands for 200k or 512.

        Args:
            caption: ``{}`` in it, and in the patterns, is the other count in the names; the value with the
                most points is taken.
            lines: label -> pattern.
            square: whether the count is the width of a square.
        """
        both = [_compiled(pattern.replace("*", "+").replace("{}", "*")) for pattern in lines.values()]
        found = [each.fullmatch(row.metric) for each in both for row in self.results.rows]
        fixed = [each[1] for each in found if each and each.groups()]
        held = max(dict.fromkeys(fixed), key=fixed.count, default="")
        drawn: dict[str, list[tuple[float, float]]] = {}
        for label, pattern in lines.items():
            of_held = pattern.replace("{}", held)
            counts = ((_count(name), name) for name in self.names(of_held))
            points = sorted((x, self._rows[of_held.replace("*", name)].value) for x, name in counts if x)
            if len(points) > 1:
                drawn[label] = [(x * x if square else x, y) for x, y in points]
        shown = caption.format(held)
        return line_chart(drawn, x_label, y_label, shown, logarithmic=True) if drawn else None

    def curves(self, name: str, caption: str, x_label: str, y_label: str, target: str = "") -> Chart | None:
        """Return a chart of a series; the bound of the metric ``target`` is drawn."""
        lines = self.results.series.get(name)
        held = next(((each.what, each.value) for each in self.results.targets if each.metric == target), None)
        if held is not None:
            held = "target", held[1]
        return line_chart(lines, x_label, y_label, caption, held) if lines else None

    def pictures(self, section: str) -> list[Pictures | Films]:
        """Return pictures and films of a section, except the ones on the first screen."""
        groups = [g for g in self.results.pictures if g.section == section and g.file != self._opened]
        return [found for group in groups if (found := load_group(self._folder, group)) is not None]

    def opening(self) -> Pictures | Films | None:
        """Return the first pictures, for the first screen."""
        for group in self.results.pictures:
            if (found := load_group(self._folder, group)) is not None:
                self._opened = group.file
                return found
        return None

    def note(self, metric: str, observed: str = "") -> str:
        """Return a note on intervals of figures that are averaged like the metric; empty without it.

        ``observed`` names what the scenes hold, such as "frames".
        """
        row = self.row(metric)
        if row is None or row.scenes is None:
            return ""
        return interval_note(row.scenes, f"{row.n} {observed}" if observed else "")

    def tiled(self, headline: Mapping[str, str]) -> list[Tile]:
        """Return tiles of headline figures, metric -> label, with verdicts on targets."""
        by_metric = {target.metric: target for target in self.results.targets}
        tiles = []
        for pattern, label in headline.items():
            rows = self.rows(pattern)
            row = next((each for each in rows if each.metric in by_metric), rows[0] if rows else None)
            if row is None:
                continue
            target = by_metric.get(row.metric)
            said, tone = verdict(target, row.value, row.unit) if target else ("", "plain")
            held = f"{bound(target, row.unit)}: {said}" if target else ""
            figure, bracket, interval = with_interval(row).partition("[")
            ranges = "; ".join(filter(None, (bracket + interval, left_out(row))))
            tiles.append(Tile(label, figure.strip(), ranges, held, tone))
        return tiles

    def tally(self) -> str:
        """Return a sentence with the number of reached targets."""
        values = [(target, self.results.value(target.metric)) for target in self.results.targets]
        verdicts = [target.reached(value) for target, value in values if value is not None]
        if not verdicts:
            return ""
        missing = len(values) - len(verdicts)
        more = f"; {missing} not measured" if missing else ""
        return f"{sum(verdicts)} of {len(verdicts)} targets are reached{more}."

    def targets(self) -> Table | None:
        """Return a table of the targets and their verdicts."""
        rows = []
        for target in self.results.targets:
            row = self._rows.get(target.metric)
            unit = "" if row is None else row.unit
            said, tone = verdict(target, None if row is None else row.value, unit)
            measured = "—" if row is None else with_interval(row)
            name = target.what or target.metric
            rows.append([name, Cell(measured, "strong"), bound(target, unit), Cell(said, tone)])
        caption = "Bounds set before the measurement; verdicts are on the unrounded figures."
        return (
            Table(caption, ["Figure", "Measured", "Target", "Verdict"], rows, words=[0, 3]) if rows else None
        )

    def absent(self) -> Table | None:
        """Return the figures that could not be measured, with reasons; None if there are none."""
        lacking = list(self.results.absent.items())
        return Table("Not measured, and why.", ["Figure", "Why"], lacking, words=[1]) if lacking else None

    def stages(self) -> Table | None:
        """Return wall time, commit and commands of the stages in stages.json; None without stages."""
        path = self._folder / "stages.json"
        if not path.is_file():
            return None
        try:
            records = StageFile.model_validate_json(path.read_bytes()).stages
        except ValidationError as error:
            raise TronError("not a record of stages", path, "delete it") from error
        rows = [
            [
                name,
                Cell(format_value(record.seconds, "s"), "strong"),
                str(record.attempts),
                record.commit or "unknown",
                Cell("; ".join(" ".join(command) for command in record.commands), "faint"),
            ]
            for name, record in records.items()
        ]
        total = format_value(sum(record.seconds for record in records.values()), "s")
        caption = (
            f"Wall time of the commands, {total} in all. One that was interrupted counts all its attempts. "
            "What was finished before is not run again: the commit is that of the code that made it."
        )
        headings = ["Stage", "Time", "Attempts", "Commit", "Command"]
        return Table(caption, headings, rows, words=[4]) if rows else None

    def machine(self) -> Table:
        """Return the machine and the versions of the measurement."""
        environment = self.results.environment
        described = {"commit": self.commit}
        for key, value in {**environment, **environment.get("inputs", {})}.items():
            if key not in ("commit", "dirty", "inputs") and value not in (None, "", {}):
                described[key.replace("_", " ")] = _plain(value)
        caption = "Where and with what this was measured."
        return Table(caption, ["Property", "Value"], list(described.items()), words=[1])

    def reproduce(self) -> Code | None:
        """Return the commands that repeat the measurement."""
        return Code("\n".join(self.results.reproduce)) if self.results.reproduce else None


def _compiled(pattern: str) -> re.Pattern[str]:
    return re.compile(re.escape(pattern).replace(r"\*", "([^.]+)").replace(r"\+", "[^._]+"))


def _count(name: str) -> float | None:
    """Return the number in a name such as 200k or 512."""
    found = re.fullmatch(r"(\d+)([km]?)", name)
    return None if found is None else float(found[1]) * MULTIPLES.get(found[2], 1)


def _plain(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {_plain(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(_plain, value))
    return f"{value:.4g}" if isinstance(value, float) else str(value)
