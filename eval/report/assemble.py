"""Outcome of a benchmark + its results -> the page: verdict, targets, its own sections, provenance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from eval.report.figures import bound, verdict, with_interval
from eval.report.outcome import Outcome
from eval.results import Results, Target
from tron.report.page import Block, Cell, Code, Page, Section, Table, Text, Tile


def assemble(outcome: Outcome, results: Results, targets: Sequence[Target]) -> Page:
    """The whole page: every figure on it is a row of ``results`` or stands in the benchmark's sections."""
    environment = results.environment
    commit = str(environment.get("commit") or "unknown")
    if environment.get("dirty"):
        commit += " with uncommitted changes"
    sections = [*([_targets(results, targets)] if targets else []), *outcome.sections]
    sections.append(_provenance(environment, commit, outcome.reproduce))
    return Page(
        title=outcome.title,
        verdict=outcome.verdict + _tally(results, targets),
        lead=outcome.lead,
        tiles=_tiles(outcome.headline, results, targets),
        sections=sections,
        footer=f"Benchmark {results.benchmark}, commit {commit}. All figures: results.json beside this page.",
    )


def _tally(results: Results, targets: Sequence[Target]) -> str:
    values = [(target, results.value(target.metric)) for target in targets]
    verdicts = [target.reached(value) for target, value in values if value is not None]
    if not verdicts:
        return ""
    missing = len(targets) - len(verdicts)
    more = f"; {missing} not measured" if missing else ""
    return f" {sum(verdicts)} of {len(verdicts)} targets are reached{more}."


def _tiles(headline: dict[str, str], results: Results, targets: Sequence[Target]) -> list[Tile]:
    by_metric = {target.metric: target for target in targets}
    tiles = []
    for metric, label in headline.items():
        row, target = results.find(metric), by_metric.get(metric)
        if row is None:
            continue
        words, tone = verdict(target, row.value, row.unit) if target else ("", "plain")
        held = f"{bound(target, row.unit)}: {words}" if target else ""
        value, bracket, interval = with_interval(row, signed=".gain" in metric).partition("[")
        tiles.append(Tile(label, value.strip(), bracket + interval, held, tone))
    return tiles


def _targets(results: Results, targets: Sequence[Target]) -> Section:
    rows = []
    for target in targets:
        row = results.find(target.metric)
        unit = "" if row is None else row.unit
        words, tone = verdict(target, None if row is None else row.value, unit)
        measured = "—" if row is None else with_interval(row, ".gain" in target.metric)
        name = target.what or target.metric
        rows.append([name, Cell(measured, "strong"), bound(target, unit), Cell(words, tone)])
    caption = "Bounds set before the measurement; verdicts are on the unrounded figures."
    table = Table(caption, ["Figure", "Measured", "Target", "Verdict"], rows, words=[0, 3])
    return Section("targets", "Targets", [table])


def _provenance(environment: dict[str, Any], commit: str, reproduce: Sequence[str]) -> Section:
    described = {"commit": commit}
    for key, value in {**environment, **environment.get("inputs", {})}.items():
        if key not in ("commit", "dirty", "inputs") and value not in (None, "", {}):
            described[key.replace("_", " ")] = _plain(value)
    caption = "Where and with what this was measured."
    blocks: list[Block] = [Table(caption, ["Property", "Value"], list(described.items()), words=[1])]
    if reproduce:
        blocks += [Text("To measure it again, from a checkout of that commit:"), Code("\n".join(reproduce))]
    return Section("machine", "Machine, commit and how to reproduce", blocks)


def _plain(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {_plain(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(_plain, value))
    return f"{value:.4g}" if isinstance(value, float) else str(value)
