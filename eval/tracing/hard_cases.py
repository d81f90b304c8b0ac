"""Hard cases of guidance against Mitsuba's path tracer: thin shadows, sheets, low suns, metals.

Dense surfels with true materials are on the same panels as the meshes, so only the estimator is judged. Thin
shadows are compared with 1,024 rays through the same surfels.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import mitsuba as mi
import numpy as np

from eval.results import Row
from eval.timing import Times, interleaved
from tron.brdf.bsdf import metallic_roughness
from tron.cameras import Camera, mitsuba_sensor
from tron.color import luminance
from tron.estimation import FINAL, PREVIEW, Estimation
from tron.gaussians.harmonics import SH_COUNT
from tron.gaussians.scene import GaussianScene, quats_from_matrices
from tron.relighting import Relighter
from tron.shading.environments.environment import EnvironmentMap

RAYS, TRIALS, REFERENCE = (2, 4, 8), 3, 1024
HEIGHTS, SHEET_SUN = (0.3, 0.6, 1.2), (50.0, 30.0)
SUNS, VIEWS = ((8.0, 0.0), (8.0, 180.0), (15.0, 0.0), (15.0, 90.0), (15.0, 180.0)), (15.0, 30.0, 60.0)
PATHS = 256
DEEP, HALF = 0.25, 0.75
SUN_HEIGHT = 720
"""Rows of a map with a small sun: a quarter of a degree each."""
HALF_AT = 0.94
"""Distance from its centre at which a surfel's alpha is one half, in cells: 1.87 standard deviations."""


Vector = tuple[float, float, float]


def measure_hard_cases(rounds: int) -> Iterator[Row]:
    """Render all cases and their truth, in a few minutes; return rows of every case, and of the worst."""
    deep, half, lit_deep, lit_half = thin_shadows(bars())
    sheets, suns = {}, {}
    for height in HEIGHTS:
        way = toward(*SHEET_SUN)
        shift = -height * way[:2] / way[2]
        under_sun = sheet(height, sunny(*SHEET_SUN), (float(shift[0]), float(shift[1])))
        sheets[f"sun_{height:g}"] = float(over_truth(under_sun, FINAL).mean())
        sheets[f"overcast_{height:g}"] = float(over_truth(sheet(height, overcast()), FINAL).mean())
    for elevation, azimuth in SUNS:
        for view in VIEWS:
            ratio = over_truth(low_sun(elevation, azimuth, view), FINAL).mean()
            suns[f"{elevation:g}_{azimuth:g}_{view:g}"] = float(ratio)
    metal = dict(zip("rgb", map(float, over_truth(metal_box(sunny(50, 30, 4)), PREVIEW)), strict=True))
    times = metal_times(rounds)
    slowdown = times["with"].over(times["without"])
    for name, value, unit, n in (
        ("thin_shadow.deep", max(deep.values()), "x", len(deep)),
        ("thin_shadow.half", max(half.values(), key=lambda v: abs(v - 1)), "x", len(half)),
        ("sheet.least", min(sheets.values()), "x", len(sheets)),
        ("sheet.most", max(sheets.values()), "x", len(sheets)),
        ("low_sun.error", max(abs(v - 1) for v in suns.values()), "fraction", len(suns)),
        ("metal.error", max(abs(v - 1) for v in metal.values()), "fraction", len(metal)),
        ("metal.seconds_ratio", slowdown, "x", len(times["with"].seconds)),
    ):
        yield Row(metric=name, value=value, unit=unit, n=n)
    for name, found, n in (
        ("thin_shadow.deep", deep, TRIALS),
        ("thin_shadow.half", half, TRIALS),
        ("thin_shadow.lit_over_paths.deep", lit_deep, TRIALS),
        ("thin_shadow.lit_over_paths.half", lit_half, TRIALS),
        ("sheet.ratio", sheets, 1),
        ("low_sun.ratio", suns, 1),
        ("metal.ratio", metal, 1),
    ):
        for case, value in found.items():
            yield Row(metric=f"{name}.{case}", value=value, unit="x", n=n)


def thin_shadows(case: Case) -> tuple[dict[int, float], ...]:
    """Return ratios in deep and half shadow: irradiance over many rays', ``lit`` over Mitsuba's paths."""
    light = Relighter(case.scene(), Estimation(rays=REFERENCE, bounces=0), proxy="never").under(case.light)
    many = light.render(case.camera, 99)
    truth, solid = luminance(many.irradiance), many.mask > 0.99
    share = truth / np.maximum(luminance(many.unshadowed), 1e-9)
    where = (solid & (share < DEEP), solid & (share >= DEEP) & (share < HALF))
    traced = luminance(case.path_traced(PATHS))
    bounced = Relighter(case.scene(), Estimation(rays=REFERENCE)).under(case.light)
    found: tuple[dict[int, float], ...] = ({}, {}, {}, {})
    for rays in RAYS:
        fewer, bouncing = (each.framed(rays=rays, filtered=True) for each in (light, bounced))
        few = [fewer.render(case.camera, k).irradiance for k in range(TRIALS)]
        lit = [bouncing.render(case.camera, k).lit for k in range(TRIALS)]
        means = [np.mean([luminance(image) for image in images], 0) for images in (few, lit)]
        pairs = [(mean, other, chosen) for mean, other in zip(means, (truth, traced)) for chosen in where]
        for ratios, (mean, other, chosen) in zip(found, pairs, strict=True):
            ratios[rays] = float(mean[chosen].mean() / other[chosen].mean())
    return found


def over_truth(case: Case, estimation: Estimation) -> np.ndarray:
    """Return the mean of ``lit`` over the path tracer's with equal bounces, on opaque pixels: (3,)."""
    found = Relighter(case.scene(), estimation, proxy="never").under(case.light).render(case.camera)
    solid = found.mask > 0.99
    return found.lit[solid].mean(0) / case.path_traced(PATHS, estimation.bounces + 2)[solid].mean(0)


def metal_times(rounds: int, size: int = 256) -> dict[str, Times]:
    """Time previews of the metal box, and of the same surfels as dielectrics, in turns."""
    case = metal_box(sunny(50, 30, 4), size)
    scene = case.scene()
    dull = replace(scene, metallic=np.zeros_like(scene.metallic))
    contestants = {}
    for name, other in (("with", scene), ("without", dull)):
        light = Relighter(other, PREVIEW, proxy="never").under(case.light)
        contestants[name] = lambda light=light: light.render(case.camera)
    return interleaved(contestants, rounds)


def sunny(
    elevation_deg: float, azimuth_deg: float, diameter_deg: float = 1.0, height: int = SUN_HEIGHT
) -> EnvironmentMap:
    """Return a sun with an edge of one texel in a constant sky; the ground has a tenth of the sky's radiance.

    The sun gives four fifths of the light on an upward plane.
    """
    polar = np.linspace(0, np.pi, height)[:, None]
    around = (np.arange(2 * height) + 0.5)[None] * np.pi / height
    directions = np.stack(
        np.broadcast_arrays(np.sin(polar) * np.sin(around), np.sin(polar) * np.cos(around), np.cos(polar)), -1
    )
    away = np.degrees(np.arccos(np.clip(directions @ toward(elevation_deg, azimuth_deg), -1, 1)))
    texel = 180 / height
    disc = np.clip((diameter_deg / 2 - away) / texel + 0.5, 0, 1)[..., None] * np.array([1.05, 1.0, 0.9])
    sky = np.where(directions[..., 2:] >= 0, 1.0, 0.1) * np.array([0.8, 0.9, 1.1])
    both = [EnvironmentMap(np.float32(image)).unoccluded_upward().mean() for image in (disc, sky)]
    return EnvironmentMap(np.float32(sky + disc * (both[1] / both[0] * 4)))


def overcast(height: int = 64) -> EnvironmentMap:
    """Return the CIE overcast sky (1955): the zenith is three times the horizon; dark below."""
    up = np.cos(np.linspace(0, np.pi, height))[:, None, None]
    sky = np.where(up >= 0, (1 + 2 * np.maximum(up, 0)) / 3, 0.05) * np.ones((1, 2 * height, 3))
    return EnvironmentMap(np.float32(sky))


def toward(elevation_deg: float, azimuth_deg: float) -> np.ndarray:
    """Return the unit direction to a point of the sky, (3,)."""
    e, a = np.radians([elevation_deg, azimuth_deg])
    return np.array([np.cos(e) * np.sin(a), np.cos(e) * np.cos(a), np.sin(e)])


@dataclass(frozen=True)
class Panel:
    """Parallelogram that faces ``along`` x ``across``, as surfels and as a mesh of the same material.

    Surfels stand on a grid whose outermost fade to one half at the panel's edge, so that shadows have its
    size. Mitsuba's is a mesh: 3.9.1 leaves ``rectangle`` shapes out of the scene's box, and their shadows
    end early.

    Attributes:
        corner, along, across: world.
        base_color: linear. roughness, metallic: of :mod:`tron.brdf`.
        cell: distance of its surfels, world units.
    """

    corner: Vector
    along: Vector
    across: Vector
    base_color: Vector = (0.5, 0.5, 0.5)
    roughness: float = 0.5
    metallic: float = 0.0
    cell: float = 0.02

    def grid(self) -> tuple[np.ndarray, np.ndarray]:
        """Return centres (N, 3), and the standard deviations (2,) of all surfels."""
        sides = [np.array(side) for side in (self.along, self.across)]
        places, sigmas = [], []
        for side in sides:
            length = float(np.linalg.norm(side))
            pitch = length / max(round(length / self.cell - 2 * HALF_AT + 1) + 2 * HALF_AT - 1, 1)
            count = round(length / pitch - 2 * HALF_AT + 1)
            places.append((HALF_AT + np.arange(count)) * pitch / length)
            sigmas.append(pitch / 2)
        u, v = (axis.ravel()[:, None] for axis in np.meshgrid(*places, indexing="ij"))
        return np.array(self.corner) + u * sides[0] + v * sides[1], np.array(sigmas)

    @property
    def normal(self) -> np.ndarray:
        """(3,) unit."""
        cross = np.cross(self.along, self.across)
        return cross / np.linalg.norm(cross)

    def mesh(self, name: str) -> mi.Mesh:
        """Return two triangles with the material on both sides."""
        base_color = {"type": "rgb", "value": list(self.base_color)}
        material = metallic_roughness(base_color, self.roughness, self.metallic)
        properties = mi.Properties()
        properties["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": material})
        mesh = mi.Mesh(name, 4, 2, properties)
        a, u, v = (np.array(vector, np.float32) for vector in (self.corner, self.along, self.across))
        values = mi.traverse(mesh)
        values["vertex_positions"] = np.stack([a, a + u, a + u + v, a + v]).ravel()
        values["faces"] = np.array([0, 1, 2, 0, 2, 3], np.uint32)
        values.update()
        return mesh


def box(centre: Vector, half: Vector, *, inwards: bool = False, **material: Any) -> list[Panel]:
    """Return six panels of a box, facing outwards or ``inwards``."""
    panels = []
    for axis in range(3):
        for side in (1.0, -1.0):
            out, along, across = (np.zeros(3) for _ in range(3))
            out[axis] = side * half[axis]
            first, second = (axis + 1) % 3, (axis + 2) % 3
            along[first], across[second] = 2 * half[first], 2 * half[second]
            corner = np.array(centre) + out - along / 2 - across / 2
            if (side > 0) == inwards:
                along, across = across, along
            panels.append(Panel(tuple(corner), tuple(along), tuple(across), **material))
    return panels


def surfels(panels: list[Panel]) -> GaussianScene:
    """Return all panels as one scene with true materials; its spacing is the most frequent one."""
    grids = [panel.grid() for panel in panels]
    counts = [len(points) for points, _ in grids]

    def each(values: list[Any]) -> np.ndarray:
        return np.repeat(np.array(values, np.float64), counts, axis=0)

    cells = each([panel.cell for panel in panels])
    return GaussianScene(
        means=np.concatenate([points for points, _ in grids]),
        quats=np.concatenate([_frame(panel, count) for panel, count in zip(panels, counts, strict=True)]),
        log_scales=np.log(each([sigmas for _, sigmas in grids])),
        opacity_logits=np.full(sum(counts), np.log(0.99 / 0.01)),
        sh=np.zeros((sum(counts), SH_COUNT, 3)),
        base_color=each([panel.base_color for panel in panels]),
        roughness=each([panel.roughness for panel in panels]),
        metallic=each([panel.metallic for panel in panels]),
        object_id=np.zeros(sum(counts)),
        kernel_degree=4,
        spacing=float(np.median(cells)),
    ).validate()


def _frame(panel: Panel, count: int) -> np.ndarray:
    u = np.array(panel.along) / np.linalg.norm(panel.along)
    frame = np.stack([u, np.cross(panel.normal, u), panel.normal], -1)
    return np.repeat(quats_from_matrices(frame[None]), count, axis=0)


@dataclass(frozen=True)
class Case:
    """Panels under a light, and a view of them."""

    panels: list[Panel]
    light: EnvironmentMap
    camera: Camera

    def scene(self) -> GaussianScene:
        """Return the surfels."""
        return surfels(self.panels)

    def path_traced(self, spp: int, segments: int = 8) -> np.ndarray:
        """Render linear radiance (H, W, 3) of the meshes by Mitsuba's paths."""
        meshes = {f"panel{k}": panel.mesh(f"panel{k}") for k, panel in enumerate(self.panels)}
        scene = mi.load_dict({"type": "scene", "light": self.light.to_mitsuba(), **meshes})
        sensor = mi.load_dict({**mitsuba_sensor(self.camera, spp)})
        integrator = mi.load_dict({"type": "path", "max_depth": segments, "rr_depth": 100})
        return np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=spp, seed=7))[..., :3]


def ground(half: float, cell: float, **material: Any) -> Panel:
    """Return a square of the plane z = 0 that faces up."""
    return Panel((-half, -half, 0), (2 * half, 0, 0), (0, 2 * half, 0), cell=cell, **material)


def bars() -> Case:
    """Thin bars above a ground: shadows a few pixels wide."""
    sun, above = (55.0, 35.0), 0.5
    made = [ground(1.5, 0.02, roughness=0.8)]
    for start in 0.2 * (np.arange(12) - 6):
        made.append(Panel((start, -1.6, above), (0.04, 0, 0), (0, 3.2, 0), roughness=0.8, cell=0.005))
    shift = -above * toward(*sun)[:2] / toward(*sun)[2]
    target = (float(shift[0]), float(shift[1]), 0.0)
    # Below the bars, which would else hide the ground.
    eye = (target[0] - 0.3, target[1] - 0.9, 0.9 * above)
    camera, light = Camera.look_at(eye, target, fov_deg=50, width=128, height=128), sunny(*sun)
    return Case(made, light, camera)


def sheet(
    height: float, light: EnvironmentMap, offset: tuple[float, float] = (0.0, 0.0), size: int = 48
) -> Case:
    """A sheet of side 1 that faces up above a floor; the camera is below it and looks down at its shadow.

    Args:
        height: height of the sheet.
        offset: offset of the shadow's middle, world.
    """
    above = Panel((-0.5, -0.5, height), (1, 0, 0), (0, 1, 0), (0.6, 0.5, 0.4), 0.6, cell=0.04)
    made = [ground(2.0, 0.04, base_color=(0.5, 0.5, 0.5), roughness=0.6), above]
    eye = 0.9 * height
    fov = 2 * np.degrees(np.arctan(0.3 / eye))
    camera = Camera.look_at(
        (*offset, eye), (*offset, 0.0), up=(0, 1, 0), fov_deg=fov, width=size, height=size
    )
    return Case(made, light, camera)


def low_sun(
    elevation_deg: float,
    azimuth_deg: float,
    view_deg: float,
    size: int = 48,
    color: Vector = (0.5, 0.5, 0.5),
) -> Case:
    """A rough floor under a low sun, seen at ``view_deg`` from above along +y."""
    made = [ground(2.0, 0.04, base_color=color, roughness=1.0)]
    eye = -8 * toward(view_deg, 0.0) * np.array([1, 1, -1])
    camera = Camera.look_at(tuple(eye), (0, 0, 0), fov_deg=8, width=size, height=size)
    return Case(made, sunny(elevation_deg, azimuth_deg, 2.0), camera)


GOLD, STEEL = (1.0, 0.77, 0.34), (0.56, 0.57, 0.58)


def metal_box(light: EnvironmentMap, size: int = 96) -> Case:
    """Boxes of gold and steel on a metal floor between metal walls, open above."""
    metal = {"metallic": 1.0, "cell": 0.025}
    made = [
        ground(1.0, base_color=STEEL, roughness=0.3, **metal),
        *box((-0.35, 0.15, 0.25), (0.2, 0.2, 0.25), base_color=GOLD, roughness=0.25, **metal),
        *box((0.35, -0.1, 0.2), (0.22, 0.22, 0.2), base_color=STEEL, roughness=0.35, **metal),
        *box((0, 0, 0.8), (1.0, 1.0, 0.8), inwards=True, base_color=GOLD, roughness=0.4, **metal)[:4],
    ]
    camera = Camera.look_at((0.55, -0.9, 1.3), (0, 0.1, 0.1), fov_deg=62, width=size, height=size)
    return Case(made, light, camera)
