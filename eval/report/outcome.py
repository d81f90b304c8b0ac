"""Result of a benchmark: rows, curves, and pictures, which become files beside results.json."""

from __future__ import annotations

import csv
import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from eval.results import Caption, Group, Row
from tron.io.images import read_image, write_image
from tron.report.page import Film, Films, Picture, Pictures

log = logging.getLogger("tron.eval")

Points = list[tuple[float, float]]
"""(x, y) of a line, ascending in x."""


@dataclass
class Outcome:
    """Figures of a benchmark, and pictures and curves of its page.

    Attributes:
        folder: folder of results.json.
        rows: the figures, in reading order.
        pictures: written pictures, in the order of the page.
        absent: unmeasured figure -> reason.
        series: name of a chart -> label of a line -> its points.
        reproduce: command lines that repeat the measurement; by default the typed one.
        inputs: inputs of the measurement (hashes of data and weights); joins settings and environment in
            results.json.
    """

    folder: Path
    rows: list[Row] = field(default_factory=list)
    pictures: list[Group] = field(default_factory=list)
    absent: dict[str, str] = field(default_factory=dict)
    series: dict[str, dict[str, Points]] = field(default_factory=dict)
    reproduce: list[str] = field(default_factory=list)
    inputs: dict[str, Any] = field(default_factory=dict)

    def add(self, rows: Iterable[Row]) -> None:
        """Keep rows; write one line each to stderr."""
        for row in rows:
            log.info("%s: %.4g %s", row.metric, row.value, row.unit)
            self.rows.append(row)

    def lack(self, metric: str, why: str) -> None:
        """Name a figure that could not be measured, and why."""
        log.warning("%s: not measured: %s", metric, why)
        self.absent[metric] = why

    def show(self, section: str, file: str, group: Pictures | Films) -> None:
        """Write pictures or films below ``folder/pictures``, for a section of the page."""
        self.pictures.append(save_group(self.folder, section, file, group))


def save_group(folder: Path, section: str, file: str, group: Pictures | Films) -> Group:
    """Write pictures or films below ``folder/pictures``; return their entry in results.json."""
    place = folder / "pictures" / file
    films = isinstance(group, Films)
    if films:
        place.parent.mkdir(parents=True, exist_ok=True)
        for number, film in enumerate(group.films):
            place.with_name(f"{file}-{number}.mp4").write_bytes(film.video)
        captions = [Caption(title=f.title, alt=f.alt, size=(f.size[1], f.size[0])) for f in group.films]
    else:
        write_image(place.with_name(f"{file}.png"), _strip(group))
        captions = [
            Caption(
                title=each.title,
                alt=each.alt,
                figure=each.figure,
                strong=each.strong,
                size=(each.image.shape[0], each.image.shape[1]),
            )
            for each in group.pictures
        ]
    return Group(
        section=section,
        file=file,
        title=group.title,
        note=group.note,
        columns=group.columns,
        films=films,
        captions=captions,
    )


def load_group(folder: Path, group: Group) -> Pictures | Films | None:
    """Load the pictures or films of a group; None if a file is missing (git has rows only).

    Raises:
        TronError: a picture is damaged.
    """
    place = folder / "pictures" / group.file
    if group.films:
        files = [place.with_name(f"{group.file}-{number}.mp4") for number in range(len(group.captions))]
        if not all(file.is_file() for file in files):
            return None
        films = [
            Film(file.read_bytes(), (each.size[1], each.size[0]), each.title, each.alt)
            for file, each in zip(files, group.captions)
        ]
        return Films(group.title, films, group.note, group.columns)
    path = place.with_name(f"{group.file}.png")
    if not path.is_file():
        return None
    strip, pictures = read_image(path), []
    height, width = (max(sides) for sides in zip(*(each.size for each in group.captions)))
    for number, each in enumerate(group.captions):
        top, left = number // group.columns * height, number % group.columns * width
        image = strip[top : top + each.size[0], left : left + each.size[1]]
        pictures.append(Picture(image, each.title, each.alt, each.figure, each.strong))
    return Pictures(group.title, pictures, group.note, group.columns)


def _strip(group: Pictures) -> np.ndarray:
    """Join all pictures into one, with black padding if sizes differ."""
    images = [picture.image for picture in group.pictures]
    height, width = (max(image.shape[axis] for image in images) for axis in (0, 1))
    rows = -(-len(images) // group.columns)
    strip = np.zeros((rows * height, group.columns * width, 3), np.float32)
    for number, image in enumerate(images):
        top, left = number // group.columns * height, number % group.columns * width
        strip[top : top + image.shape[0], left : left + image.shape[1]] = image
    return strip


def training_curves(runs: Mapping[str, Path]) -> dict[str, dict[str, Points]]:
    """Return curves of ``loss`` and ``psnr`` over training seconds, one per column of each run's metrics.csv.

    Clocks of stages are concatenated. A repeated value (of a validation, until the next one) is kept once,
    where it is new.

    Args:
        runs: label of a run -> metrics.csv of tron-train; files that do not exist are left out, and so are
        columns
            without two numbers.
    """
    found: dict[str, dict[str, Points]] = {}
    for label, path in runs.items():
        if not path.is_file():
            continue
        with open(path, newline="", encoding="utf-8") as file:
            rows = [row for row in csv.DictReader(file) if np.isfinite(_number(row.get("seconds")))]
        columns: dict[str, Points] = {}
        stage, offset, last = None, 0.0, 0.0
        for row in rows:
            if row.get("stage") != stage:
                stage, offset, last = row.get("stage"), offset + last, 0.0
            last = _number(row["seconds"])
            for name, text in row.items():
                points, value = columns.setdefault(name, []), _number(text)
                if np.isfinite(value) and not (points and points[-1][1] == value):
                    points.append((offset + last, value))
        for name, points in columns.items():
            kind = next((word for word in ("loss", "psnr") if word in name.lower()), None)
            if kind and len(points) > 1:
                found.setdefault(kind, {})[f"{label}, {name}"] = points
    return found


def _number(text: str | None) -> float:
    try:
        return float(text or "nan")
    except ValueError:
        return float("nan")
