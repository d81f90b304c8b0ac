"""A tenth of the cells path-traced by Cycles too, which shares neither code nor material with us.

Cells under one light go into one glTF, far apart. Shapes with a texture, and fogs, whose surface is a ball's,
stay out.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh

from eval.renderers.blender import rendered
from eval.results import Row
from eval.tracing.furnace import place
from eval.zoo.cells import Cell
from eval.zoo.lights import Light
from eval.zoo.shapes import FOV_DEG, SIDE, Shape
from tron.cameras import Camera
from tron.estimation import FINEST
from tron.framing import Y_UP
from tron.seeds import generator, integer

SHARE = 10
"""Of so many cells of a kind one is chosen."""
SAMPLES = 256


class Witnessed(NamedTuple):
    """A cell by Mitsuba's paths over Cycles': means, and the mean absolute difference over Cycles' mean."""

    cell: Cell
    mean: float
    error: float


def chosen(cells: Sequence[Cell], shapes: Mapping[tuple[str, int], Shape], seed: int) -> list[Cell]:
    """One in :data:`SHARE` of every kind of shape."""
    found = []
    for kind in dict.fromkeys(cell.shape for cell in cells):
        of_kind = [cell for cell in cells if cell.shape == kind]
        shape = shapes[kind, of_kind[0].number]
        if shape.fog or any(part.base_color.ndim > 1 for part in shape.parts):
            continue
        order = generator(seed, "zoo", "cycles", kind).permutation(len(of_kind))
        found += [of_kind[n] for n in sorted(order[: -(-len(of_kind) // SHARE)])]
    return found


def witnessed(
    python: Path,
    cells: Sequence[Cell],
    shapes: Mapping[tuple[str, int], Shape],
    lights: Sequence[Light],
    folder: Path,
    seed: int,
    threads: int,
) -> Iterator[Witnessed]:
    """Cells by Cycles.

    Args:
        python: that has Blender.
        cells: of :func:`chosen`.
        shapes: by kind and number.
        lights: of the zoo.
        folder: for models and frames.
        seed: root of all random numbers.
        threads: of Cycles.

    Raises:
        TronError: Blender failed.
    """
    for light in lights:
        under = [cell for cell in cells if cell.light == light.name]
        if not under:
            continue
        place_of = folder / light.name
        place_of.mkdir(parents=True, exist_ok=True)
        file = place_of / "cells.glb"
        write_cells(file, under, shapes)
        cameras = [_moved(shapes[cell.shape, cell.number].camera, place(n)) for n, cell in enumerate(under)]
        (seen,) = rendered(
            python, file, cameras, [light.environment], place_of, samples=SAMPLES, bounces=FINEST.bounces,
            threads=threads, seed=integer(seed, "zoo", "cycles", light.name),
        )  # fmt: skip
        for cell, view in zip(under, seen, strict=True):
            ours, theirs = cell.truth[cell.counts], view.lit[cell.counts]
            error = np.abs(ours - theirs).mean() / theirs.mean()
            yield Witnessed(cell, float(ours.mean() / theirs.mean()), float(error))


def write_cells(path: Path, cells: Sequence[Cell], shapes: Mapping[tuple[str, int], Shape]) -> None:
    """A glTF of each cell's shape and material at its place; factors are the materials' own."""
    scene = trimesh.Scene()
    for number, cell in enumerate(cells):
        for k, part in enumerate(shapes[cell.shape, cell.number].parts):
            vertices = (part.vertices + place(number)) @ Y_UP.T
            normals = part.normals @ Y_UP.T
            mesh = trimesh.Trimesh(vertices, part.faces, vertex_normals=normals, process=False)
            scene.add_geometry(mesh, geom_name=f"{number} {k}")

    def arrange(tree: dict[str, Any]) -> None:
        tree["materials"] = [
            {
                "doubleSided": True,
                "pbrMetallicRoughness": {
                    "baseColorFactor": [*cell.material.base_color, 1.0],
                    "metallicFactor": cell.material.metallic,
                    "roughnessFactor": cell.material.roughness,
                },
            }
            for cell in cells
        ]
        for mesh in tree["meshes"]:
            for primitive in mesh["primitives"]:
                primitive["material"] = int(mesh["name"].split()[0])

    content = scene.export(file_type="glb", include_normals=True, tree_postprocessor=arrange)
    assert isinstance(content, bytes)
    path.write_bytes(content)


def witness_rows(found: Sequence[Witnessed]) -> Iterator[Row]:
    """The worst cell and the mean of all."""
    off = [abs(each.mean - 1) for each in found]
    values = {
        "cycles.worst_mean": max(off),
        "cycles.mean_off": np.mean(off),
        "cycles.error": np.mean([each.error for each in found]),
    }
    for name, value in values.items():
        yield Row(metric=f"zoo.{name}", value=float(value), unit="fraction", n=len(found))


def _moved(camera: Camera, by: Sequence[float]) -> Camera:
    """A view of the zoo whose subject stands elsewhere."""
    eye = np.asarray(camera.position) + by
    return Camera.look_at(eye, by, fov_deg=FOV_DEG, width=SIDE, height=SIDE)
