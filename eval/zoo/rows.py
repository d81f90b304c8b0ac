"""Rows of cells: the worst of all, each shape, balls by material and light, every way of TRON."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from eval.results import Row
from eval.zoo.cells import QUALITIES, Cell
from eval.zoo.lights import JUDGED
from eval.zoo.materials import POLISHED, ROUGH

WITHIN = 0.1
"""Distance of a cell's mean from 1 that it may have in either quality."""
BALL = "ball"


def zoo_rows(cells: Sequence[Cell]) -> Iterator[Row]:
    """Yield all rows of cells; rows of balls only if there are balls."""
    off = np.array([[abs(cell.mean(quality) - 1) for quality in QUALITIES] for cell in cells])
    errors = np.array([[cell.error(quality) for quality in QUALITIES] for cell in cells])
    yield _row("worst_mean", off.max(), len(cells))
    yield _row("worst_error", errors.max(), len(cells))
    yield _row("share_within", (off <= WITHIN).all(1).mean(), len(cells))
    kinds, lights = (list(dict.fromkeys(names)) for names in zip(*((c.shape, c.light) for c in cells)))
    means = {}
    for kind in kinds:
        of_kind = [cell for cell in cells if cell.shape == kind]
        for quality in QUALITIES:
            means[kind, quality] = float(np.mean([cell.mean(quality) for cell in of_kind]))
            yield _row(f"mean.{kind}.{quality}", means[kind, quality], len(of_kind), "x")
            worst = max((cell.mean(quality) for cell in of_kind), key=lambda mean: abs(mean - 1))
            yield _row(f"farthest.{kind}.{quality}", worst, len(of_kind), "x")
            error = np.mean([cell.error(quality) for cell in of_kind])
            yield _row(f"error.{kind}.{quality}", error, len(of_kind))
    yield _row("worst_shape", max(abs(mean - 1) for mean in means.values()), len(kinds))
    ways = dict.fromkeys(name for cell in cells for name in cell.psnr)
    shown = [cell for cell in cells if cell.psnr.keys() == ways.keys()]  # by every way
    for way in ways:
        yield _row(f"psnr.{way}", np.mean([cell.psnr[way] for cell in shown]), len(shown), "dB")
    balls = [cell for cell in cells if cell.shape == BALL]
    if balls:
        yield from _ball_rows(balls, lights)


def _ball_rows(balls: Sequence[Cell], lights: Sequence[str]) -> Iterator[Row]:
    """Yield rows of the balls' targets, and means of groups of materials under each light."""
    preview = next(iter(QUALITIES))
    shiny = [(cell, preview) for cell in balls if cell.material.metallic and cell.material.roughness < ROUGH]
    others = [(cell, quality) for cell in balls for quality in QUALITIES if (cell, quality) not in shiny]
    for name, found in (("mean", others), ("shiny_mean", shiny)):
        if found:
            yield _row(f"ball.{name}", max(abs(cell.mean(way) - 1) for cell, way in found), len(found))
    for light in lights:
        under = [cell for cell in balls if cell.light == light]
        rough = [cell for cell in under if cell.material.roughness >= ROUGH]
        polished = [cell for cell in under if cell.material.roughness <= POLISHED]
        if light in JUDGED and rough:
            most = max(cell.error(way) for cell in rough for way in QUALITIES)
            yield _row(f"ball.rough_error.{light}", most, len(rough))
        if light in JUDGED and polished:
            yield _row(f"ball.polished_error.{light}", max(c.error("final") for c in polished), len(polished))
        groups: dict[str, list[Cell]] = {}
        for cell in under:
            groups.setdefault(group(cell), []).append(cell)
        for name, found in sorted(groups.items()):
            for quality in QUALITIES:
                mean, error = ([getattr(c, each)(quality) for c in found] for each in ("mean", "error"))
                yield _row(f"ball_mean.{name}_{quality}.{light}", np.mean(mean), len(found), "x")
                yield _row(f"ball_error.{name}_{quality}.{light}", np.mean(error), len(found))


def group(cell: Cell) -> str:
    """Return the group of a material by kind and roughness, such as ``metal_polished``."""
    roughness = cell.material.roughness
    width = "polished" if roughness <= POLISHED else "rough" if roughness >= ROUGH else "middle"
    return f"{'metal' if cell.material.metallic else 'dielectric'}_{width}"


def _row(name: str, value: float | np.floating, n: int, unit: str = "fraction") -> Row:
    return Row(metric=f"zoo.{name}", value=float(value), unit=unit, n=n)
