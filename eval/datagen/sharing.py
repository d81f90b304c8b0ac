"""Path tracing a frame under 20 lights: one by one over together, at equal mean error.

The data engine knows how both are done, so it measures them (``tron-datagen mode=sharing``).
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from eval.datagen.runs import make
from eval.results import Row, mean_row
from tron.errors import TronError
from tron.images import read_image, write_image
from tron.report.page import Picture, Pictures, Section, Table

RECORD = "sharing.json"
GAIN = "lights.sharing_gain"


@dataclass(frozen=True)
class Sharing:
    """The data engine's record of frames under many lights.

    Attributes:
        cases: one a scene: "scene", "lights", "pixels", "paths", "seconds", "error", "gain", "bias".
        pictures: (H, W, 3) display values of each case: truth, one by one, together, errors of both.
    """

    cases: Sequence[Mapping[str, Any]]
    pictures: Sequence[np.ndarray]

    def rows(self, seed: int) -> Iterator[Row]:
        """Gain, the seconds of both at one error, the paths that this takes, and what the mean hides.

        That is the error together over that alone of the light that fares worst, and the largest bias.
        """
        for metric, unit, values in (
            (GAIN, "x", [case["gain"] for case in self.cases]),
            ("lights.seconds_alone", "s", [case["seconds"]["alone"] for case in self.cases]),
            ("lights.seconds_together", "s", [case["seconds"]["together"] for case in self.cases]),
            ("lights.paths_alone", "1", [case["paths"]["alone"] for case in self.cases]),
            ("lights.paths_together", "1", [case["paths"]["together"] for case in self.cases]),
            ("lights.relative_error", "abs", [case["error"]["alone"] for case in self.cases]),
        ):
            yield mean_row(metric, unit, [(c["scene"], v) for c, v in zip(self.cases, values)], seed)
        worst = [(case["scene"], _worst_light(case)) for case in self.cases]
        yield mean_row("lights.worst_light_error_ratio", "x", worst, seed)
        bias = max(abs(case["bias"]) for case in self.cases)
        yield Row(metric="lights.largest_bias", value=bias, unit="fraction", n=len(self.cases))

    def sections(self, pictures: Path) -> list[Section]:
        """Every scene in a table, and its pictures."""
        rows, shown = [], []
        for case, image in zip(self.cases, self.pictures, strict=True):
            alone, together = case["seconds"]["alone"], case["seconds"]["together"]
            paths = case["paths"]
            rows.append(
                [case["scene"], f"{paths['alone']:.0f}", f"{paths['together']:.0f}", f"{alone:.2f} s",
                 f"{together:.2f} s", f"{case['gain']:.2f} x"]
            )  # fmt: skip
            pictures.mkdir(parents=True, exist_ok=True)
            write_image(pictures / f"sharing-{case['scene']}.png", image)
            shown.append(Picture(image, case["scene"], f"{case['scene']} under four of the lights"))
        first = self.cases[0]
        caption = (
            f"A frame of {first['pixels']} pixels under {first['lights']} lights, half of high contrast and "
            "half of low: path-traced light by light by Mitsuba's path, and under all at once, at the same "
            "mean over lights of the relative squared error. Medians of interleaved rounds."
        )
        headings = ["scene", "paths one by one", "paths together", "one by one", "together", "gain"]
        note = "A row a light: the truth, one by one, together, and eight times the errors of both."
        blocks = [Table(caption, headings, rows), Pictures("Under four lights", shown, note, columns=1)]
        return [Section("sharing", "Many lights at once", blocks)]


def _worst_light(case: Mapping[str, Any]) -> float:
    """Error together over error alone of the worst light, at about the same mean error."""
    errors = dict(case["error_by_light"])
    alone = np.asarray(errors.pop("alone"))
    nearest = min(errors, key=lambda paths: abs(int(paths) - case["paths"]["together"]))
    return float((np.asarray(errors[nearest]) / np.maximum(alone, 1e-9)).max())


def measure_sharing(recipe: Sequence[str], folder: Path) -> Sharing:
    """Let the data engine path-trace frames both ways.

    Args:
        recipe: arguments of tron-datagen.
        folder: of this part.

    Raises:
        StageFailed: tron-datagen failed.
        TronError: it wrote no such record.
    """
    output = folder / "frames"
    make([*recipe, "mode=sharing"], output)
    path = output / RECORD
    try:
        cases = json.loads(path.read_text("utf-8"))["cases"]
        pictures = [read_image(output / "sharing" / f"{case['scene']}.png") for case in cases]
    except (OSError, ValueError, KeyError) as error:
        raise TronError(f"not a record of shared lights: {error}", path) from error
    return Sharing(cases, pictures)
