"""White furnace tests: balls and bowls under constant light of 1, where brightness is albedo.

White materials reflect all incoming light, by every way of computing it: Mitsuba's paths on a mesh, ``lit``
of surfels or of a mesh beside them, bounces in a bowl, baked harmonics. Other materials are compared with
Cycles, if Blender is given. All read one glTF; its balls are too far apart to light each other.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np
import trimesh

from eval.renderers.blender import INSTALL, rendered
from eval.renderers.paths import path_traced
from eval.report.outcome import Outcome
from eval.results import Row
from eval.timing import Times
from tron.brdf.bsdf import metallic_roughness
from tron.cameras import Camera, mitsuba_sensor
from tron.color import from_agx
from tron.estimation import FINEST, PREVIEW, Estimation
from tron.framing import Y_UP
from tron.models.load import load_model
from tron.models.parts import Part
from tron.models.shapes import textured
from tron.models.surfels import surfels_of_model
from tron.relighting import Relighter
from tron.relighting.baking import baked
from tron.seeds import integer
from tron.shading.environments.environment import EnvironmentMap
from tron.tracing import SurfelTracer

BASE_COLORS = (1.0, 0.5, 0.2)
METALLIC = (0.0, 0.5, 1.0)
ROUGHNESS = (0.0, 0.05, 0.2, 0.38, 0.7, 1.0)
APART, ACROSS = 30.0, 9
"""Radii between balls, which stand in rows of so many: a neighbour is 0.001 of what the limb sees."""
SPACING = 0.05
"""Of surfels, in radii."""
SIDE, PATHS = 32, 256
WHOLE = 0.95
"""Radius, in the disk's, within which a pixel counts: none of the silhouette."""
CLOSED = 0.5
"""Opacity from which a pixel counts."""
CAP = 0.5
"""Sphere below minus this height is the bowl: a quarter, of which a quarter of what leaves it meets it again.

Of a half a point sees the half: after 4 bounces 1 / 32 is on its way still, as it is of paths so long.
"""
FRAMES = 8
"""Of a bowl, whose four reflection rays a pixel leave noise of 0.01 in the mean of one."""
EXPOSURE = 0.4
"""Of display values that harmonics hold: light of 1 is a middle grey."""
WAYS = ("truth", "preview", "final", "mesh", "bowl", "bake")


class Material(NamedTuple):
    """Material of a ball: base color of all channels, metallic and roughness."""

    base_color: float
    metallic: float
    roughness: float

    @property
    def case(self) -> str:
        """Name in metrics, in hundredths: 50_100_38."""
        return "_".join(f"{100 * each:.0f}" for each in self)


MATERIALS = [Material(b, m, r) for b in BASE_COLORS for m in METALLIC for r in ROUGHNESS]


@dataclass(frozen=True)
class Furnace:
    """Balls, each at its :func:`place`.

    Attributes:
        balls: one part per ball.
        seed: root of all random numbers.
    """

    balls: Sequence[Part]
    seed: int

    @classmethod
    def read(cls, path: Path, seed: int) -> Furnace:
        """Read a file of :func:`write_balls`."""
        return cls(load_model(path, fitted=False), seed)

    def by_paths(self) -> list[float]:
        """Return the mean brightness of each ball by Mitsuba's path tracer."""
        shapes = [textured(ball, f"ball{n}").shape for n, ball in enumerate(self.balls)]
        light = EnvironmentMap.constant(1.0)

        def seen(number: int, camera: Camera) -> np.ndarray:
            root = integer(self.seed, "furnace", "paths", number)
            return path_traced(shapes, light, camera, FINEST.bounces + 2, PATHS, root)

        return self._means(seen)

    def by_surfels(self, estimation: Estimation) -> list[float]:
        """Return the mean brightness of each ball by ``lit`` of surfels on it."""
        return self._lit(self._relighter(self.balls, estimation))

    def by_mesh(self) -> list[float]:
        """Return the mean brightness of each ball by ``lit`` of its mesh, beside hidden surfels."""
        aside = np.eye(4)
        aside[:3, 3] = -APART, 0, 0
        unseen = [self.balls[0].moved(aside)]
        return self._lit(self._relighter(unseen, FINEST, [[ball] for ball in self.balls]))

    def by_bounces(self) -> list[float]:
        """Return the mean brightness of bowls of surfels, with bounced light."""
        bowls = [bowl(ball) for ball in self.balls]
        return self._lit(self._relighter(bowls, FINEST), FRAMES)

    def by_harmonics(self) -> list[float]:
        """Return the mean brightness of the balls' harmonics by :func:`tron.relighting.baking.baked`."""
        light = self._relighter(self.balls, PREVIEW).under(EnvironmentMap.constant(1.0))
        tracer = SurfelTracer(baked(light, EXPOSURE, look="none"))

        def seen(_: int, camera: Camera) -> np.ndarray:
            view = tracer.gbuffer(camera).numpy()
            opacity = view["opacity"][..., None]
            shown = from_agx(view["rgb"] / np.maximum(opacity, CLOSED)) / EXPOSURE
            return np.where(opacity > CLOSED, shown, np.nan)

        return self._means(seen)

    def _relighter(
        self, parts: Sequence[Part], estimation: Estimation, meshes: Sequence[Sequence[Part]] = ()
    ) -> Relighter:
        scene = surfels_of_model(parts, SPACING, seed=integer(self.seed, "furnace", "surfels"))
        return Relighter(scene, estimation, self.seed, proxy="never", meshes=meshes)

    def _lit(self, relighter: Relighter, frames: int = 1) -> list[float]:
        light = relighter.under(EnvironmentMap.constant(1.0))

        def seen(number: int, camera: Camera) -> np.ndarray:
            found = []
            for k in range(frames):
                frame = light.trace(camera, integer(self.seed, "furnace", "frame", number, k))
                dark, bright = (frame.shade([behind] * 3) for behind in (0.0, 1.0))
                share = 1 - (bright.lit - dark.lit)  # of the surfels, which let some light through
                shown = dark.mask[..., None] > CLOSED
                found.append(np.where(shown, dark.lit / np.maximum(share, CLOSED), np.nan))
            return np.mean(found, 0)

        return self._means(seen)

    def _means(self, seen: Callable[[int, Camera], np.ndarray]) -> list[float]:
        return [disk_mean(seen(n, camera(n))) for n in range(len(self.balls))]


def place(number: int) -> tuple[float, float, float]:
    """Return the centre of a ball, z up."""
    return APART * (number % ACROSS), APART * (number // ACROSS), 0.0


def camera(number: int) -> Camera:
    """Return a camera that looks down at a ball or into a bowl."""
    centre = np.array(place(number))
    eye = centre + 5 * np.array([0, -np.sin(0.35), np.cos(0.35)])
    return Camera.look_at(eye, centre, up=(0, 1, 0), fov_deg=25, width=SIDE, height=SIDE)


def disk_mean(image: np.ndarray) -> float:
    """Average a :func:`camera`'s picture (H, W, 3) over its ball, without the silhouette and NaN."""
    y, x = (np.mgrid[:SIDE, :SIDE] + 0.5) / SIDE * 2 - 1
    radius = np.tan(np.arcsin(1 / 5)) / np.tan(np.radians(25 / 2))
    return float(np.nanmean(image[np.hypot(x, y) < WHOLE * radius]))


def bowl(ball: Part) -> Part:
    """Return the bottom of a ball, seen from inside."""
    middle = (ball.vertices.min(0) + ball.vertices.max(0)) / 2
    low = (ball.vertices - middle)[ball.faces].mean(1)[:, 2] < -CAP
    return replace(ball, faces=ball.faces[low, ::-1], normals=-ball.normals)


def write_balls(path: Path, materials: Sequence[Material]) -> None:
    """Write a glTF of a unit ball per material at its place; its factors are the materials' values."""
    sphere = trimesh.creation.icosphere(subdivisions=4)

    def arrange(tree: dict[str, Any]) -> None:
        (primitive,) = tree["meshes"][0]["primitives"]
        count = range(len(materials))
        tree["materials"] = [
            {
                "pbrMetallicRoughness": {
                    "baseColorFactor": [*[each.base_color] * 3, 1.0],
                    "metallicFactor": each.metallic,
                    "roughnessFactor": each.roughness,
                }
            }
            for each in materials
        ]
        tree["meshes"] = [{"primitives": [primitive | {"material": n}]} for n in count]
        tree["nodes"] = [{"mesh": n, "translation": [*(Y_UP @ place(n))]} for n in count]
        tree["scenes"] = [{"nodes": [*count]}]

    mesh = trimesh.Trimesh(sphere.vertices, sphere.faces, vertex_normals=sphere.vertices, process=False)
    content = mesh.export(file_type="glb", include_normals=True, tree_postprocessor=arrange)
    assert isinstance(content, bytes)
    path.write_bytes(content)


def measure_furnace(python: Path | None, rounds: int, seed: int, threads: int, outcome: Outcome) -> None:
    """Measure every material by every way and by Cycles, and the cost.

    Args:
        python: Python with Blender; None: without Cycles.
        rounds: rounds of timing.
        seed: root of all random numbers.
        threads: of Cycles.
        outcome: takes rows, and what could not be measured.

    Raises:
        TronError: Blender cannot render the balls.
    """
    with tempfile.TemporaryDirectory(prefix="tron-") as folder:
        file = Path(folder) / "balls.glb"
        write_balls(file, MATERIALS)
        every = Furnace.read(file, seed)
        found = {
            "truth": every.by_paths(),
            "preview": every.by_surfels(PREVIEW),
            "final": every.by_surfels(FINEST),
        }
        count = sum(each.base_color == 1 for each in MATERIALS)
        white = Furnace(every.balls[:count], seed)
        found |= {"mesh": white.by_mesh(), "bowl": white.by_bounces(), "bake": white.by_harmonics()}
        if python is None:
            outcome.lack("furnace.cycles_worst", f"benchmark.blender_python is not given: {INSTALL}")
        else:
            cameras = [camera(n) for n in range(len(MATERIALS))]
            (seen,) = rendered(
                python, file, cameras, [EnvironmentMap.constant(1.0)], Path(folder), samples=PATHS,
                bounces=FINEST.bounces, threads=threads, seed=integer(seed, "furnace", "cycles"),
            )  # fmt: skip
            found["cycles"] = [disk_mean(each.lit) for each in seen]
    outcome.add(furnace_rows(found))
    times = price(rounds)
    ratio = times["metallicroughness"].over(times["principled"])
    outcome.add([Row(metric="furnace.seconds_ratio", value=ratio, unit="x", n=rounds)])


def furnace_rows(found: Mapping[str, Sequence[float]]) -> list[Row]:
    """Return rows of brightness by each way, for materials in the order of :data:`MATERIALS`."""
    rows = [
        Row(metric=f"furnace.{way}.{material.case}", value=value, unit="x", n=1)
        for way, values in found.items()
        for material, value in zip(MATERIALS, values)
    ]
    off = {
        way: max(abs(value - 1) for material, value in zip(MATERIALS, values) if material.base_color == 1)
        for way, values in found.items()
        if way in WAYS
    }
    rows += [
        Row(metric=f"furnace.worst.{way}", value=value, unit="fraction", n=1) for way, value in off.items()
    ]
    rows.append(Row(metric="furnace.worst", value=max(off.values()), unit="fraction", n=len(off)))
    if "cycles" in found:
        other = {
            way: max(
                abs(value / theirs - 1)
                for material, value, theirs in zip(MATERIALS, found[way], found["cycles"], strict=True)
                if material.base_color < 1
            )
            for way in ("truth", "preview", "final")
        }
        rows += [
            Row(metric=f"furnace.cycles_worst.{way}", value=value, unit="fraction", n=1)
            for way, value in other.items()
        ]
        rows.append(
            Row(metric="furnace.cycles_worst", value=max(other.values()), unit="fraction", n=len(other))
        )
    return rows


def price(rounds: int, side: int = 256, paths: int = 64) -> dict[str, Times]:
    """Return CPU times of a path-traced picture of nine balls and a floor, with either material, in turns."""
    scenes = {"metallicroughness": _nine(metallic_roughness), "principled": _nine(_principled)}
    view = Camera.look_at((4, -6, 4), (0, 0, 0.5), fov_deg=45, width=side, height=side)
    sensor = mi.load_dict(mitsuba_sensor(view, paths))
    integrator = mi.load_dict({"type": "path", "max_depth": 6})
    taken: dict[str, list[float]] = {name: [] for name in scenes}
    for number in range(rounds + 1):
        for name, scene in scenes.items():
            start = time.process_time()
            np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=paths, seed=number))
            taken[name].append(time.process_time() - start)
    return {name: Times(tuple(seconds[1:])) for name, seconds in taken.items()}  # the first compiles


def _principled(base_color: float, roughness: float, metallic: float) -> mi.BSDF:
    color = {"type": "rgb", "value": base_color}
    return mi.load_dict(
        {"type": "principled", "base_color": color, "roughness": roughness, "metallic": metallic}
    )


def _nine(material: Callable[[float, float, float], mi.BSDF]) -> mi.Scene:
    floor = mi.ScalarTransform4f().translate([0, 0, -0.01]).scale([5, 5, 0.01])
    balls = {
        f"ball{n}": {
            "type": "sphere",
            "center": [n % 3 * 1.2 - 1.2, n // 3 * 1.2 - 1.2, 0.5],
            "radius": 0.5,
            "bsdf": material(0.7, 0.1 + 0.1 * n, float(n % 2)),
        }
        for n in range(9)
    }
    ground = {"type": "cube", "to_world": floor, "bsdf": material(0.6, 0.6, 0.0)}
    return mi.load_dict({"type": "scene", "light": {"type": "constant"}, "ground": ground, **balls})
