"""Write tables of a comparison: CSV of every picture, scene and pair, and a LaTeX table of methods."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from eval.compare.measures import MAP_MEASURES, MEASURES, Measure
from eval.compare.scores import Judged
from eval.results import Row
from tron.storage import write_atomic

DECIMALS = {"dB": 2, "deg": 2}
_TEX = str.maketrans(
    {c: f"\\{c}" for c in "&%$#_{}"} | {"\\": r"\textbackslash{}", "~": r"\~{}", "^": r"\^{}"}
)


def write_tables(folder: Path, judged: Sequence[Judged], rows: Mapping[str, Row]) -> None:
    """Write frames.csv, scenes.csv, faults.csv, methods.csv, and table.tex beside results.json.

    Args:
        folder: that exists.
        judged: every method.
        rows: metric -> row, the source of means and intervals.
    """
    names = list(dict.fromkeys(name for each in judged for score in each.frames for name in score.figures))
    _csv(
        folder / "frames.csv",
        ["method", "scene", "kind", "light", "family", "frame", *names],
        (
            [each.name, s.scene, s.kind, s.light, s.family, s.frame, *(s.figures.get(n, "") for n in names)]
            for each in judged
            for s in each.frames
        ),
    )
    maps = [measure.name for measure in MAP_MEASURES]
    _csv(
        folder / "scenes.csv",
        ["method", "scene", "light", *names, *maps, "factor"],
        (line for each in judged for line in _scene_lines(each, names, maps)),
    )
    _csv(
        folder / "faults.csv",
        ["method", "scene", "what", "kind", "fault"],
        ([each.name, f.scene, f.what, f.kind, f.text] for each in judged for f in each.faults),
    )
    found = [m for m in (*MEASURES, *MAP_MEASURES) if any(f"{each.name}.{m.name}" in rows for each in judged)]
    columns = [f"{m.name}{end}" for m in found for end in ("", "_low", "_high")]
    _csv(
        folder / "methods.csv",
        ["method", "title", "color_space", "scale", "saw", "fit_s", "frame_s", "faults", *columns],
        (_method_line(each, found, rows) for each in judged),
    )
    write_atomic(folder / "table.tex", latex(judged, found, rows))


def latex(judged: Sequence[Judged], measures: Sequence[Measure], rows: Mapping[str, Row]) -> str:
    """Return a booktabs table: one line per method, best of a column bold, a dash where a scene failed."""
    cells = {each.name: [rows.get(f"{each.name}.{m.name}") for m in measures] for each in judged}
    best = []
    for column, measure in enumerate(measures):
        values = [row.value for found in cells.values() if (row := found[column]) is not None]
        best.append((max if measure.better == "more" else min)(values))
    heads = [m.title.replace("↑", r"$\uparrow$").replace("↓", r"$\downarrow$") for m in measures]
    lines = [r"\begin{tabular}{l" + "r" * len(measures) + "}", r"\toprule"]
    lines += [" & ".join(["Method", *heads]) + r" \\", r"\midrule"]
    for each in judged:
        texts = [
            "--" if row is None else _bold(f"{row.value:.{DECIMALS.get(row.unit, 3)}f}", row.value == best[k])
            for k, row in enumerate(cells[each.name])
        ]
        title = (each.folder.method.title or each.name).translate(_TEX)
        lines.append(" & ".join([title, *texts]) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def _bold(text: str, best: bool) -> str:
    return rf"\textbf{{{text}}}" if best else text


def _scene_lines(judged: Judged, names: Sequence[str], maps: Sequence[str]) -> Iterable[list[object]]:
    """Yield a line of means over frames for each scene and light, and a line without light for maps."""
    groups: dict[tuple[str, str], list[Mapping[str, float]]] = {}
    for score in judged.frames:
        groups.setdefault((score.scene, score.light), []).append(score.figures)
    for (scene, light), figures in groups.items():
        means = [np.mean(v) if (v := [f[n] for f in figures if n in f]) else "" for n in names]
        yield [judged.name, scene, light, *means, *([""] * len(maps)), judged.factors.get(scene, "")]
    for scene, found in judged.maps.items():
        yield [judged.name, scene, "", *([""] * len(names)), *(found.get(m, "") for m in maps), ""]


def _method_line(judged: Judged, measures: Sequence[Measure], rows: Mapping[str, Row]) -> list[object]:
    method = judged.folder.method
    figures: list[object] = []
    for measure in measures:
        row = rows.get(f"{judged.name}.{measure.name}")
        figures += ["", "", ""] if row is None else [row.value, row.low, row.high]
    said = [method.title, method.color_space, method.scale, " ".join(method.saw)]
    return [judged.name, *said, method.seconds.fit, method.seconds.frame, len(judged.faults), *figures]


def _csv(path: Path, headings: Sequence[str], lines: Iterable[Sequence[object]]) -> None:
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(headings)
        writer.writerows(lines)
