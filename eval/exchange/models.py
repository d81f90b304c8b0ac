"""Path-trace glTF models by Mitsuba with our material, and by Cycles with Blender's importer.

Only our model reader and our material (:mod:`tron.brdf`) are judged, not surfels and not ``lit``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from eval.exchange.mesh import FILLED, LIGHTS, light_file
from eval.renderers.blender import INSTALL, rendered
from eval.renderers.paths import path_traced
from eval.report.outcome import Outcome
from eval.results import Row
from tron.cameras import Camera
from tron.color import to_display
from tron.estimation import FINEST
from tron.metrics import capped_psnr
from tron.models.load import load_model
from tron.models.parts import Part, outline
from tron.models.shapes import textured
from tron.report.page import Picture, Pictures
from tron.seeds import integer
from tron.shading.environments.environment import EnvironmentMap

MODELS = (Path("FlightHelmet/FlightHelmet.gltf"), Path("cat/cat.glb"), Path("chess-board/chess-board.glb"))
"""Below ``assets``. Blender has neither the lenses, which are nearly clear, nor a clear coat on chessmen."""
METRIC = "blender.psnr"
SIDE = 96
"""Pixels: few, so that many paths in each leave little noise."""


@dataclass(frozen=True, eq=False)
class Pair:
    """A model under a light, by both renderers.

    Attributes:
        model, light: their names.
        exposure: of the light's pictures.
        mitsuba, cycles: (H, W, 3) linear.
        filled: (H, W) bool, pixels that count.
    """

    model: str
    light: str
    exposure: float
    mitsuba: np.ndarray
    cycles: np.ndarray
    filled: np.ndarray

    @property
    def psnr(self) -> float:
        """PSNR of display values, dB."""
        shown = [to_display(each, self.exposure) for each in (self.mitsuba, self.cycles)]
        return capped_psnr(shown[0], shown[1], self.filled)

    @property
    def ratio(self) -> float:
        """Mean of Mitsuba's picture over the mean of Cycles' picture."""
        return float(self.mitsuba[self.filled].mean() / self.cycles[self.filled].mean())


def measure_models(
    real_data: Path | None, python: Path | None, paths: int, seed: int, threads: int, outcome: Outcome
) -> None:
    """Measure every model under every light, and show pictures.

    Args:
        real_data: folder with ``assets`` and ``hdri``; None: nothing is measured.
        python: Python with Blender; None: nothing is measured.
        paths: samples per pixel, by either renderer.
        seed: root of all random numbers.
        threads: of Cycles.
        outcome: takes rows, pictures, and what could not be measured.

    Raises:
        TronError: Blender cannot read or render a model.
    """
    files = [] if real_data is None else [real_data / "assets" / path for path in MODELS]
    maps = [] if real_data is None else [light_file(real_data, name) for name, _ in LIGHTS]
    lacking = [path for path in (*files, *maps) if not path.is_file()]
    why = f"benchmark.blender_python is not given: {INSTALL}" if python is None else ""
    if not files or lacking:
        why = f"no {lacking[0] if lacking else MODELS[0]}: give benchmark.real_data"
    if python is None or why:
        outcome.lack(METRIC, why)
        return
    lights = {name: EnvironmentMap.load(path, turn) for path, (name, turn) in zip(maps, LIGHTS)}
    pairs = []
    for file in files:
        folder = outcome.folder.absolute() / "models" / file.stem
        pairs += both(python, file, lights, folder, paths, seed, threads)
    outcome.add(model_rows(pairs))
    for pair in pairs:
        outcome.show("models", f"models-{pair.model}-{pair.light}", _pictures(pair))


def both(
    python: Path, file: Path, lights: Mapping[str, EnvironmentMap], folder: Path, paths: int, seed: int,
    threads: int, side: int = SIDE,
) -> list[Pair]:  # fmt: skip
    """Render a model under lights by both renderers.

    Args:
        python: Python with Blender.
        file: file of the model.
        lights: by their names.
        folder: for Blender's job and its frames.
        paths: samples per pixel.
        seed: root of all random numbers.
        threads: of Cycles.
        side: of the square pictures, pixels.
    """
    parts = load_model(file, fitted=False)
    view = before(parts, side)
    seen = rendered(
        python, file, [view], [*lights.values()], folder, samples=paths, bounces=FINEST.bounces,
        threads=threads, seed=integer(seed, "models", "cycles"),
    )  # fmt: skip
    shapes = [textured(part, f"part{n}").shape for n, part in enumerate(parts)]
    pairs = []
    for (name, light), (cycles,) in zip(lights.items(), seen, strict=True):
        root = integer(seed, "models", file.stem, name)
        mitsuba = path_traced(shapes, light, view, FINEST.bounces + 2, paths, root)
        pairs.append(Pair(file.stem, name, light.exposure(), mitsuba, cycles.lit, cycles.opacity > FILLED))
    return pairs


def before(parts: Sequence[Part], side: int) -> Camera:
    """Return a camera whose picture the model fills, from its front and right, a little above it."""
    corners = outline(parts).vertices
    middle = (corners.min(0) + corners.max(0)) / 2
    radius = float(np.linalg.norm(corners - middle, axis=1).max())
    eye = middle + 2.6 * radius * np.array([0.46, -0.83, 0.32])
    return Camera.look_at(tuple(eye), tuple(middle), fov_deg=40, width=side, height=side)


def model_rows(pairs: Sequence[Pair]) -> Iterator[Row]:
    """Yield rows of each pair, of their mean and of the worst."""
    for pair in pairs:
        case = f"{pair.model}_{pair.light}".replace("-", "_").lower()
        yield Row(metric=f"blender.psnr.{case}", value=pair.psnr, unit="dB", n=1)
        yield Row(metric=f"blender.ratio.{case}", value=pair.ratio, unit="x", n=1)
    found = [pair.psnr for pair in pairs]
    yield Row(metric=METRIC, value=float(np.mean(found)), unit="dB", n=len(found))
    yield Row(metric="blender.worst", value=min(found), unit="dB", n=len(found))


def _pictures(pair: Pair) -> Pictures:
    filled = pair.filled[..., None]
    shown = [to_display(each, pair.exposure) * filled for each in (pair.mitsuba, pair.cycles)]
    off = np.clip(0.5 + 4 * (shown[0] - shown[1]), 0, 1) * filled
    where = f"{pair.model}, light {pair.light}"
    return Pictures(
        where,
        [
            Picture(shown[0], "Mitsuba, our material", f"{where}, by Mitsuba", strong=True),
            Picture(shown[1], "Cycles", f"{where}, by Cycles", f"{pair.psnr:.1f} dB"),
            Picture(off, "four times the difference", f"{where}, difference"),
        ],
        columns=3,
    )
