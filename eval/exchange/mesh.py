"""Turn a real model into surfels, export them as a textured mesh, and read the mesh by Blender.

The model is turned into surfels (:func:`tron.models.surfels.surfels_of_model`), which have neither its
triangles nor its textures, and ``tron-export`` makes a .glb of them. Blender reads it, and Cycles shows its
base color and its normals, which are held against the model's own at the same pixels, and renders it under
photographed lights. Ours is ``lit`` of the surfels; Mitsuba's path tracer sees the model itself.

Only pixels that the model fills count: holes of the mesh are black there, with a normal error of 90 degrees.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import mitsuba as mi
import numpy as np

from eval.renderers.blender import INSTALL, Seen, rendered
from eval.renderers.paths import path_traced, scene_of
from eval.report.outcome import Outcome
from eval.results import Row
from eval.stages import Child, Stages
from tron.cameras import Camera
from tron.color import linear_to_srgb, to_display
from tron.estimation import FINEST
from tron.gaussians.scene import GaussianScene
from tron.metrics import angular_error_deg, capped_psnr
from tron.models.load import load_model
from tron.models.shapes import Shape, materials_at, surface_points, textured
from tron.models.sides import spacing_of, two_sided
from tron.models.surfels import surfels_of_model
from tron.relighting import Relighter
from tron.report.page import Picture, Pictures
from tron.runtime import lanes
from tron.seeds import integer
from tron.shading.environments.environment import EnvironmentMap
from tron.shading.guidance import averaged
from tron.trajectories import plan_cameras

MODEL = Path("assets/FlightHelmet/FlightHelmet.gltf")
LIGHTS = (("venice_sunset_1k", 110.0), ("studio_small_03_1k", 0.0))
"""Files below ``hdri``, and their turn about up in degrees."""
METRICS = ("mesh.base_color_psnr", "mesh.normal_mae_deg", "mesh.relight_psnr")
FINENESS = 3
"""Rays along a pixel's side that look up the model's materials."""
FILLED = 0.995
"""Opacity from which a pixel counts."""


@dataclass(frozen=True)
class Sizes:
    """Numbers of surfels, views, samples and texels.

    Attributes:
        surfels: approximate number of surfels of the model.
        views, side: number of cameras around the model, and their width in pixels.
        paths: samples per pixel, by Cycles and by Mitsuba.
        texture: width of the textures in texels.
    """

    surfels: int
    views: int
    side: int
    paths: int
    texture: int


class Truth(NamedTuple):
    """Maps of the model in a view: base color (linear) and normal (H, W, 3) as means of rays, and opacity.

    ``smooth`` holds normals without normal maps, which surfels do not have.
    """

    base_color: np.ndarray
    normal: np.ndarray
    smooth: np.ndarray
    opacity: np.ndarray


@dataclass(frozen=True, eq=False)
class View:
    """A view under one light: the mesh, the surfels and the truth.

    Attributes:
        light: its name. exposure: of its pictures.
        truth: of the model.
        seen: by Cycles.
        ours: (H, W, 3) linear, of the surfels. traced: of the model, by Mitsuba.
    """

    light: str
    exposure: float
    truth: Truth
    seen: Seen
    ours: np.ndarray
    traced: np.ndarray

    @property
    def filled(self) -> np.ndarray:
        """(H, W) bool: pixels that the model fills."""
        return self.truth.opacity > FILLED

    def psnr(self, image: np.ndarray, other: np.ndarray) -> float:
        """PSNR of display values, dB."""
        shown = [to_display(each, self.exposure) for each in (image, other)]
        return capped_psnr(shown[0], shown[1], self.filled)


def measure_mesh(
    real_data: Path | None, python: Path | None, sizes: Sizes, seed: int, threads: int,
    outcome: Outcome, stages: Stages,
) -> None:  # fmt: skip
    """Measure the exported mesh, and show pictures.

    Args:
        real_data: folder with ``assets`` and ``hdri``; None: nothing is measured.
        python: Python with Blender; None: nothing is measured.
        sizes: numbers of surfels, views, samples and texels.
        seed: root of all random numbers.
        threads: of Cycles.
        outcome: takes rows, pictures, and what could not be measured.
        stages: run tron-export.

    Raises:
        TronError: Blender cannot read or render the mesh.
        StageFailed: tron-export failed.
    """
    files = (
        [] if real_data is None else [real_data / MODEL, *(light_file(real_data, name) for name, _ in LIGHTS)]
    )
    lacking = [path for path in files if not path.is_file()]
    why = f"benchmark.blender_python is not given: {INSTALL}" if python is None else ""
    if real_data is None or lacking:
        why = f"no {lacking[0] if lacking else MODEL}: give benchmark.real_data"
    if real_data is None or python is None or lacking:
        for metric in METRICS:
            outcome.lack(metric, why)
        return
    parts = load_model(real_data / MODEL)
    sides = two_sided(parts)
    spacing = spacing_of(sides, sizes.surfels)
    scene = surfels_of_model(sides, spacing, seed=integer(seed, "exchange", "mesh"))
    folder = outcome.folder.absolute() / "mesh"
    folder.mkdir(parents=True, exist_ok=True)
    surfels, model = folder / "surfels.ply", folder / "mesh.glb"
    scene.save(surfels)
    stages.restart("export")
    given = [f"scene={surfels}", f"output={model}", f"texture={sizes.texture}", f"threads={threads}"]
    seconds = stages.run("export", [Child("export", "tron-export", given)])
    cameras = plan_cameras(
        scene, "orbit", sizes.views, width=sizes.side, height=sizes.side, fov_deg=40, phase=30.0
    )
    shapes = [textured(part, f"part{n}") for n, part in enumerate(parts)]
    views = _views(real_data, python, model, scene, shapes, cameras, sizes, seed, threads)
    outcome.add([
        Row(metric="mesh.bytes", value=model.stat().st_size, unit="bytes", n=1),
        Row(metric="mesh.export_seconds", value=seconds, unit="s", n=1),
        *mesh_rows(views),
    ])  # fmt: skip
    outcome.show("mesh", "mesh-maps", _maps(views[0]))
    for name, _ in LIGHTS:
        view = next(each for each in views if each.light == name)
        outcome.show("mesh", f"mesh-{name}", _relit(view))


def mesh_rows(views: Sequence[View]) -> Iterator[Row]:
    """Yield means over views; maps do not depend on the light and count once."""
    once = [view for view in views if view.light == views[0].light]
    base = [capped_psnr(v.seen.base_color, v.truth.base_color, v.filled) for v in once]
    normal, smooth = (
        [angular_error_deg(view.seen.normal, getattr(view.truth, name), view.filled) for view in once]
        for name in ("normal", "smooth")
    )
    shared = [((v.seen.opacity > 0.5) & v.filled).sum() / v.filled.sum() for v in once]
    figures = {
        "base_color_psnr": ("dB", base),
        "normal_mae_deg": ("deg", normal),
        "smooth_normal_mae_deg": ("deg", smooth),
        "covered": ("fraction", shared),
        "relight_psnr": ("dB", [view.psnr(view.seen.lit, view.ours) for view in views]),
        "relight_traced_psnr": ("dB", [view.psnr(view.seen.lit, view.traced) for view in views]),
        "lit_traced_psnr": ("dB", [view.psnr(view.ours, view.traced) for view in views]),
    }
    for name, (unit, values) in figures.items():
        yield Row(metric=f"mesh.{name}", value=float(np.mean(values)), unit=unit, n=len(values))


def true_maps(shapes: Sequence[Shape], camera: Camera) -> Truth:
    """Trace the model's true maps by rays through sub-pixels."""
    fine = camera.resized(FINENESS * camera.width, FINENESS * camera.height)
    along = lanes(mi.Vector3f, fine.rays().reshape(-1, 3))
    ray = mi.Ray3f(mi.Point3f(*camera.position.tolist()), along)
    si, normal = surface_points(shapes, scene_of([shape.shape for shape in shapes]), ray)
    base_color, _, _ = materials_at(shapes, si)
    met = np.array(si.is_valid())
    smooth = np.array(si.sh_frame.n).T
    smooth *= np.where((np.array(si.n).T * np.array(along).T).sum(1) > 0, -1, 1)[:, None]

    def image(values: np.ndarray) -> np.ndarray:
        size = (fine.height, fine.width, *values.shape[1:])
        return averaged(
            np.where(met.reshape(-1, *[1] * (values.ndim - 1)), values, 0).reshape(size), FINENESS
        )

    return Truth(image(np.array(base_color).T), image(np.array(normal).T), image(smooth), image(met * 1.0))


def _views(
    real_data: Path, python: Path, model: Path, scene: GaussianScene, shapes: Sequence[Shape],
    cameras: list[Camera], sizes: Sizes, seed: int, threads: int,
) -> list[View]:  # fmt: skip
    """Render every view under every light."""
    lights = [EnvironmentMap.load(light_file(real_data, name), turn) for name, turn in LIGHTS]
    seen = rendered(
        python, model, cameras, lights, model.parent, samples=sizes.paths, bounces=FINEST.bounces,
        threads=threads, seed=integer(seed, "exchange", "cycles"),
    )  # fmt: skip
    truths = [true_maps(shapes, camera) for camera in cameras]
    relighter = Relighter(scene, FINEST, integer(seed, "exchange", "lit"), proxy="never")
    found = []
    for (name, _), light, of_light in zip(LIGHTS, lights, seen, strict=True):
        lit = relighter.under(light)
        for number, (camera, truth, by_cycles) in enumerate(zip(cameras, truths, of_light, strict=True)):
            root = integer(seed, "exchange", name, number)
            ours = lit.render(camera, root, background=(0, 0, 0)).lit
            traced = path_traced(
                [each.shape for each in shapes], light, camera, FINEST.bounces + 2, sizes.paths, root
            )
            found.append(View(name, light.exposure(), truth, by_cycles, ours, traced))
    return found


def light_file(real_data: Path, name: str) -> Path:
    """Return the path of a light's map."""
    return real_data / "hdri" / f"{name}.hdr"


def _maps(view: View) -> Pictures:
    filled = view.filled[..., None]
    base = capped_psnr(view.seen.base_color, view.truth.base_color, view.filled)
    wrong = angular_error_deg(view.seen.normal, view.truth.normal, view.filled)
    true, read = (linear_to_srgb(maps.base_color * filled) for maps in (view.truth, view.seen))
    turned = [np.clip(0.5 + 0.5 * maps.normal, 0, 1) * filled for maps in (view.truth, view.seen)]
    shown = [
        Picture(true, "base color, the model's", "base color of the model", strong=True),
        Picture(np.clip(read, 0, 1), "of the mesh", "base color of the exported mesh", f"{base:.1f} dB"),
        Picture(turned[0], "normals, the model's", "normals of the model", strong=True),
        Picture(turned[1], "of the mesh", "normals of the exported mesh", f"{wrong:.1f}°"),
    ]
    return Pictures("What Blender reads from the file", shown, columns=4)


def _relit(view: View) -> Pictures:
    filled = view.filled[..., None]

    def picture(image: np.ndarray, title: str, figure: str = "", strong: bool = False) -> Picture:
        shown = to_display(image, view.exposure) * filled
        return Picture(shown, title, f"{title}, light {view.light}", figure, strong)

    pictures = [
        picture(view.ours, "surfels, lit", strong=True),
        picture(view.seen.lit, "the mesh in Cycles", f"{view.psnr(view.seen.lit, view.ours):.1f} dB"),
        picture(
            view.traced, "the model, path-traced by Mitsuba", f"{view.psnr(view.traced, view.ours):.1f} dB"
        ),
    ]
    return Pictures(f"Light {view.light}", pictures, columns=3)
