"""Two layers of surfels back to back: how dark their fronts become, and how much light comes through.

Each layer has the jitter of a reconstruction: of its centres, and of its normals. The front is held against a
path-traced square of the same material under even light; what comes through is the front's light over the
back's where a lamp stands behind the sheet and nothing else shines. Pixels count that are a fifth of the
sheet's width inside its edges.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from eval.renderers.paths import path_traced
from eval.results import Row
from eval.zoo.cells import QUALITIES
from eval.zoo.lights import disc
from eval.zoo.materials import Material
from eval.zoo.shapes import of_material, polygon
from tron.cameras import Camera
from tron.gaussians.harmonics import SH_COUNT
from tron.gaussians.scene import GaussianScene, quats_from_normals
from tron.models.shapes import textured
from tron.relighting import Relighter
from tron.seeds import generator, integer
from tron.shading.environments.environment import EnvironmentMap

GAPS = (0.0, 0.25, 0.5, 1.0)
"""Between the layers, in spacings."""
JITTERS = ((0.1, 0.1), (0.25, 0.2))
"""Deviations off the plane in spacings, and of the normals' tangent."""
TOUCHING = (0.0, 0.25)
"""The gap and jitter of which less is asked."""
SPACING, COUNT, SIDE = 0.02, 50, 96
WHITE, BLACK = Material("light", (0.8, 0.8, 0.8), 0.6, 0.0), Material("black", (0.05, 0.05, 0.05), 0.6, 0.0)
DARK = 0.6
"""Share of what is right below which a pixel is dark."""
PATHS = 64
EYE = np.array([0.9, -0.6, 1.3])


class Sheet(NamedTuple):
    """Found of one gap and jitter, by one quality.

    Attributes:
        gap, jitter: in spacings.
        mean: of the front's light over the truth's.
        dark: share of its pixels below :data:`DARK` of the truth.
        leak: light through it.
    """

    gap: float
    jitter: float
    quality: str
    mean: float
    dark: float
    leak: float


def two_layers(
    gap: float, jitter: float, tilt: float, materials: Sequence[Material], rng: np.random.Generator
) -> GaussianScene:
    """A square of unit width about the origin: the first material above, the other below."""
    side = (np.arange(COUNT) + 0.5) / COUNT - 0.5
    even = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
    means, normals = [], []
    for height, up in ((0.0, 1.0), (-gap * SPACING, -1.0)):
        place = even + rng.normal(0, SPACING / 4, even.shape)
        lifted = height + rng.normal(0, jitter * SPACING, len(even))
        means.append(np.column_stack([place, lifted]))
        normals.append(np.column_stack([rng.normal(0, tilt, even.shape), np.full(len(even), up)]))
    n, normal = 2 * len(even), np.concatenate(normals).astype(np.float32)
    of = [materials[k // len(even)] for k in range(n)]
    return GaussianScene(
        means=np.concatenate(means).astype(np.float32),
        quats=quats_from_normals(normal / np.linalg.norm(normal, axis=1, keepdims=True)),
        log_scales=np.full((n, 2), np.log(0.5 * SPACING), np.float32),
        opacity_logits=np.full(n, 4.6, np.float32),
        sh=np.zeros((n, SH_COUNT, 3), np.float32),
        base_color=np.array([each.base_color for each in of], np.float32),
        roughness=np.array([each.roughness for each in of], np.float32),
        metallic=np.array([each.metallic for each in of], np.float32),
        object_id=np.ones(n, np.int32),
        kernel_degree=4,
        spacing=SPACING,
    ).validate()


def measured_sheets(seed: int) -> Iterator[Sheet]:
    """Every gap, jitter and quality."""
    above, below = (
        Camera.look_at(EYE * [1, 1, sign], (0, 0, 0), fov_deg=24, width=SIDE, height=SIDE) for sign in (1, -1)
    )
    front = textured(of_material(polygon(0.5 * _CORNERS), WHITE), "front").shape
    even, lamp = EnvironmentMap.constant(1.0), EnvironmentMap(10 * disc(-70, 0, 30)[..., None] * np.ones(3))
    truth = path_traced([front], even, above, 3, PATHS, integer(seed, "zoo", "sheet", "truth"))
    for gap in GAPS:
        for jitter, tilt in JITTERS:
            names = ("zoo", "sheet", f"{gap} {jitter}")
            dark, white = (
                Relighter(
                    two_layers(gap, jitter, tilt, (WHITE, under), generator(seed, *names)),
                    next(iter(QUALITIES.values())),
                    integer(seed, *names, "light"),
                    proxy="never",
                )
                for under in (BLACK, WHITE)
            )
            shown, shut = dark.under(even), white.under(lamp)
            for quality, estimation in QUALITIES.items():
                rays = integer(seed, *names, "rays")
                lit = replace(shown, estimation=estimation).render(above, rays, (0, 0, 0)).lit
                through, lamps = (
                    replace(shut, estimation=estimation).render(view, rays, (0, 0, 0)).lit[inner(view)].mean()
                    for view in (above, below)
                )
                share = (lit / truth).mean(-1)[inner(above)]
                yield Sheet(
                    gap,
                    jitter,
                    quality,
                    float(share.mean()),
                    float((share < DARK).mean()),
                    float(through / lamps),
                )


_CORNERS = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])


def inner(camera: Camera) -> np.ndarray:
    """(H, W) bool: pixels whose middle sees the sheet a fifth of its width inside its edges."""
    along = camera.rays()
    met = camera.position - along * (camera.position[2] / along[..., 2])[..., None]
    return (np.abs(met[..., :2]) < 0.3).all(-1)


def sheet_rows(found: Sequence[Sheet]) -> Iterator[Row]:
    """The worst of all, and every case."""
    touching = [each for each in found if (each.gap, each.jitter) == TOUCHING]
    apart = [each for each in found if each not in touching]
    for name, of in (("mean", apart), ("touching_mean", touching)):
        if of:
            yield _row(name, max(abs(each.mean - 1) for each in of), len(of))
    yield _row("dark", max(each.dark for each in found), len(found))
    yield _row("leak", max(each.leak for each in found), len(found))
    for each in found:
        case = f"{100 * each.gap:.0f}_{100 * each.jitter:.0f}"
        yield _row(f"{each.quality}_mean.{case}", each.mean, 1, "x")
        yield _row(f"{each.quality}_dark.{case}", each.dark, 1)
        yield _row(f"{each.quality}_leak.{case}", each.leak, 1)


def _row(name: str, value: float, n: int, unit: str = "fraction") -> Row:
    return Row(metric=f"zoo.sheet.{name}", value=value, unit=unit, n=n)
