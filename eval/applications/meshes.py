"""Compare mesh models beside surfels with Mitsuba's path tracer, under two photographed lights.

Models stand on a table. Some are meshes, the others are surfels of the same meshes
(:func:`tron.models.surfels.surfels_of_model`), so only the combination of both is judged. Pictures are
compared after AgX in pixels that show one thing alone, shadows where less than 0.8 of the light arrives.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation

from eval.renderers.paths import path_traced, scene_of
from eval.report.outcome import Outcome
from eval.results import Row
from tron.cameras import Camera
from tron.color import to_display
from tron.errors import TronError
from tron.estimation import FINEST, PREVIEW, Estimation
from tron.gaussians.edit import joined
from tron.gaussians.scene import GaussianScene
from tron.metrics import psnr
from tron.models.load import load_model
from tron.models.parts import Part
from tron.models.shapes import mitsuba_mesh, mitsuba_texture, textured
from tron.models.sides import spacing_of, two_sided
from tron.models.surfels import surfels_of_model
from tron.relighting import Guidance, Illumination, Relighter
from tron.report.page import Picture, Pictures
from tron.seeds import integer
from tron.shading.environments.environment import EnvironmentMap

MODELS = {  # file, radius, (x, y), turn about up in degrees
    "helmet": ("FlightHelmet/FlightHelmet.gltf", 1.15, (0.12, 0.2), 10),
    "cat": ("cat/cat.glb", 1.0, (-1.0, 0.1), 30),
    "cow": ("spot/spot.obj", 0.8, (1.12, -0.15), 140),
    "calf": ("spot/spot.obj", 0.27, (0.42, -0.72), 200),
}
TABLE, HALF, COLOR = "table", 1.8, (0.55, 0.24, 0.13)
LIGHTS = (("venice_sunset_1k", 30.0), ("potsdamer_platz_1k", 60.0))
SURFELS = 40_000
"""Of the models together, and of the table."""
BRIGHTER = 1.3
PATHS, SHADOW_PATHS = 144, 256
SHADED = 0.8
"""Share of the light that arrives, below which a pixel is in shadow."""
TIMED = 5
VIEW = Camera.look_at((0.35, -5.3, 1.5), (0.06, 0, 0.82), fov_deg=38.5, width=448, height=252)
SPLITS = {"cow": ("cow",), "models": tuple(MODELS), "table": (TABLE,)}
"""Which things are meshes; all others are surfels."""


def measure_meshes(real_data: Path, seed: int, outcome: Outcome) -> None:
    """Measure meshes beside surfels, and show pictures under each light.

    Args:
        real_data: folder with ``assets`` and ``hdri``.
        seed: root of all random numbers.
        outcome: takes the rows and the pictures.

    Raises:
        TronError: a model or a map is missing.
    """
    things = read_things(real_data)
    surfels = {name: _surfels(parts, name, seed) for name, parts in things.items()}
    shadows: dict[str, list[float]] = {"models": [], "table": []}
    lit: dict[str, list[float]] = {"mesh": [], "all_meshes": [], "as_surfels": []}
    for name, turn in LIGHTS:
        path = real_data / "hdri" / f"{name}.hdr"
        if not path.is_file():
            raise TronError("no such map", path, "give the folder of the real data")
        light = EnvironmentMap.load(path, turn)
        exposure, truth = BRIGHTER * light.exposure(), Truth.of(things, light, seed)
        whole = _frame(_lit(surfels, things, list(things), light, seed), seed)
        flat = _frame(_lit(surfels, things, [], light, seed), seed)
        shown = {"path-traced": truth.lit, "all meshes": whole.lit, "all surfels": flat.lit}
        for split, meshes in SPLITS.items():
            frame = _frame(_lit(surfels, things, meshes, light, seed), seed)
            shown[f"{split}: mesh{'es' if split == 'models' else ''}"] = frame.lit
            there = np.isin(truth.number, [1 + list(things).index(each) for each in meshes])
            for kind, image in (("mesh", frame), ("all_meshes", whole), ("as_surfels", flat)):
                lit[kind].append(_psnr(image.lit, truth.lit, exposure, there))
            if split in shadows:  # of the models on the surfels of the table, or on the mesh of the table
                shaded = truth.irradiance.mean(-1) < SHADED * whole.unshadowed.mean(-1)
                shaded &= truth.number == 1
                shadows[split].append(_psnr(frame.irradiance, truth.irradiance, exposure, shaded))
        pictures = [
            Picture(to_display(image, exposure), title, f"{title}, light {name}", strong=image is truth.lit)
            for title, image in shown.items()
        ]
        outcome.show("meshes", f"meshes-{name}", Pictures(f"Light {name}", pictures, columns=3))
    light = EnvironmentMap.load(real_data / "hdri" / f"{LIGHTS[0][0]}.hdr", LIGHTS[0][1])
    ratios = {
        "frame_time_ratio": _time_ratio(surfels, things, light, seed, PREVIEW),
        "frame_time_ratio_traced": _time_ratio(surfels, things, light, seed, FINEST),
    }
    apart = np.subtract(lit["all_meshes"], lit["mesh"])
    lower, most = "the lower of two lights", "the most of three splits and two lights"
    outcome.add([
        _row("shadow_on_surfels_psnr", min(shadows["models"]), "dB", len(LIGHTS), lower),
        _row("shadow_on_mesh_psnr", min(shadows["table"]), "dB", len(LIGHTS), lower),
        *(_row(f"lit_psnr.{kind}", float(np.mean(found)), "dB", len(found)) for kind, found in lit.items()),
        _row("below_all_meshes", float(apart.max()), "dB", len(apart), most),
        *(_row(name, ratio, "x", TIMED, "all as surfels") for name, ratio in ratios.items()),
    ])  # fmt: skip


def read_things(real_data: Path) -> dict[str, list[Part]]:
    """Read the table and the models, placed in the world."""
    things = {TABLE: [_slab()]}
    for name, (file, radius, at, turn) in MODELS.items():
        path = real_data / "assets" / file
        if not path.is_file():
            raise TronError("no such model", path, "give the folder of the real data")
        parts, matrix = load_model(path), np.eye(4)
        matrix[:3, :3] = Rotation.from_euler("z", turn, degrees=True).as_matrix()
        matrix[:3, 3] = (*at, -radius * min(part.vertices[:, 2].min() for part in parts))
        things[name] = [part.moved(matrix, radius) for part in parts]
    return things


def _slab() -> Part:
    """The table: a thin box below z = 0, its sides with corners of their own."""
    corners, normals, faces = [], [], []
    for axis in range(3):
        for side in (0.0, 1.0):
            u, v = np.roll(np.eye(3)[[1, 2]], axis, axis=1)
            square = [side * np.eye(3)[axis] + a * u + b * v for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))]
            order = np.array([[0, 1, 2], [0, 2, 3]])[:, :: 1 if side else -1]
            faces += (order + len(corners)).tolist()
            corners += square
            normals += [(2 * side - 1) * np.eye(3)[axis]] * 4
    size = np.array([2 * HALF, 2 * HALF, 0.1])
    vertices = np.array(corners) * size - [HALF, HALF, 0.1]
    color = np.array(COLOR, np.float32)
    return Part(vertices, np.array(normals), np.array(faces), None, color, 0.4, 0.0, None)


def _surfels(parts: Sequence[Part], name: str, seed: int) -> GaussianScene:
    count = SURFELS if name == TABLE else SURFELS / len(MODELS)
    sides = two_sided(parts)
    return surfels_of_model(sides, spacing_of(sides, count), seed=integer(seed, "meshes", name))


@dataclass(frozen=True)
class Truth:
    """Truth of the view by Mitsuba.

    Attributes:
        lit: (H, W, 3) radiance, 4 bounces. irradiance: (H, W, 3) of direct light, over pi.
        number: (H, W) number of the only thing in a pixel, from 1 on; 0 if the pixel shows several or none.
    """

    lit: np.ndarray
    irradiance: np.ndarray
    number: np.ndarray

    @classmethod
    def of(cls, things: Mapping[str, Sequence[Part]], light: EnvironmentMap, seed: int) -> Truth:
        """Path-trace the truth."""
        parts = [(k, part) for k, each in enumerate(things.values(), 1) for part in each]
        shapes = [textured(part, f"true{n}").shape for n, (_, part) in enumerate(parts)]
        white = [_white(part, f"white{n}") for n, (_, part) in enumerate(parts)]
        lit, irradiance = (
            path_traced(each, light, VIEW, depth, paths, integer(seed, "meshes", "truth", depth))
            for each, depth, paths in ((shapes, FINEST.bounces + 2, PATHS), (white, 2, SHADOW_PATHS))
        )
        return cls(lit, irradiance, _numbers(shapes, [k for k, _ in parts]))


def _white(part: Part, name: str) -> mi.Mesh:
    """The part, diffuse and white: under direct light it shows irradiance over pi."""
    bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}
    if part.normal_map is not None:
        texture = mitsuba_texture(part.normal_map, part.sampling.get("normal_map"))
        bsdf = {"type": "normalmap", "normalmap": texture, "bsdf": bsdf}
    made = mi.load_dict({"type": "twosided", "bsdf": bsdf})
    return mitsuba_mesh(name, made, part.vertices, part.normals, part.faces, part.uv)


def _numbers(shapes: Sequence[mi.Mesh], numbers: Sequence[int]) -> np.ndarray:
    """Return the number (H, W) of the thing that a pixel's nine rays hit; 0 if they hit several or none."""
    fine = VIEW.resized(3 * VIEW.width, 3 * VIEW.height)
    along = mi.Vector3f(fine.rays().reshape(-1, 3).T.astype(np.float32))
    si = scene_of(shapes).ray_intersect(mi.Ray3f(mi.Point3f(*VIEW.position.tolist()), along))
    found = mi.UInt32(0)
    for shape, number in zip(shapes, numbers, strict=True):
        found = dr.select(si.is_valid() & (si.shape == mi.ShapePtr(shape)), number, found)
    image = np.array(found).reshape(VIEW.height, 3, VIEW.width, 3).transpose(0, 2, 1, 3)
    image = image.reshape(VIEW.height, VIEW.width, 9)
    return np.where((image == image[..., :1]).all(-1), image[..., 0], 0)


def _lit(
    surfels: Mapping[str, GaussianScene],
    things: Mapping[str, Sequence[Part]],
    meshes: Sequence[str],
    light: EnvironmentMap,
    seed: int,
    estimation: Estimation = FINEST,
) -> Illumination:
    """Render the things under a light, some of them as meshes."""
    rest = [scene for name, scene in surfels.items() if name not in meshes]
    if not rest:  # a scene has surfels: these let all light through
        table = surfels[TABLE]
        rest = [replace(table, opacity_logits=np.full(len(table), -80, np.float32))]
    models = [things[name] for name in meshes]
    return Relighter(reduce(joined, rest), estimation, seed, meshes=models, proxy="never").under(light)


def _frame(light: Illumination, seed: int) -> Guidance:
    return light.render(VIEW, integer(seed, "meshes", "rays"))


def _psnr(image: np.ndarray, truth: np.ndarray, exposure: float, where: np.ndarray) -> float:
    shown = [to_display(each, exposure)[where] for each in (image, truth)]
    return float(psnr(*shown))


def _time_ratio(
    surfels: Mapping[str, GaussianScene],
    things: Mapping[str, Sequence[Part]],
    light: EnvironmentMap,
    seed: int,
    estimation: Estimation,
) -> float:
    """Return the CPU time of a frame with the cow as a mesh over a frame of surfels: medians, in turns."""
    pair = [_lit(surfels, things, meshes, light, seed, estimation) for meshes in (SPLITS["cow"], ())]
    taken: list[list[float]] = [[], []]
    for _ in range(TIMED + 1):  # the first compiles
        for frames, seconds in zip(pair, taken):
            start = time.process_time()
            _frame(frames, seed)
            seconds.append(time.process_time() - start)
    beside, alone = (float(np.median(seconds[1:])) for seconds in taken)
    return beside / alone


def _row(name: str, value: float, unit: str, n: int, reference: str | None = None) -> Row:
    return Row(metric=f"mesh.{name}", value=value, unit=unit, reference=reference, n=n)
