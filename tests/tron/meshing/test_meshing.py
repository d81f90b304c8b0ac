"""Surfels as triangles: a painted ball against its own formula, read back by trimesh."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from tron.errors import TronError
from tron.framing import Y_UP
from tron.gaussians.edit import joined
from tron.gaussians.initialize import surfels_from_points
from tron.gaussians.scene import GaussianScene
from tron.meshing import textures
from tron.meshing.surface import surface_of, views_of
from tron.meshing.textures import textured
from tron.models.write import write_glb
from tron.seeds import generator
from tron.tracing.tracer import SurfelTracer

RADIUS = 0.7
VOLUME = 4 / 3 * np.pi * RADIUS**3
MIDDLE = np.array([0.2, -0.1, 0.4])


def painted(direction: np.ndarray) -> np.ndarray:
    """Linear base color of the ball by unit direction from its middle."""
    return 0.5 + 0.4 * direction


def ball(radius: float = RADIUS, middle: np.ndarray = MIDDLE, surfels: int = 6000) -> GaussianScene:
    normal = generator(0, "test", "ball").normal(size=(12 * surfels, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    some = np.ones((len(normal), 1))
    values = {
        "position": middle + radius * normal, "normal": normal, "base_color": painted(normal),
        "roughness": 0.3 * some, "metallic": 0.8 * some,
    }  # fmt: skip
    return surfels_from_points(values, 0, surfels)


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("together", [pytest.param(None, marks=pytest.mark.long), 500])
def test_a_ball_is_a_ball_with_its_paint(tmp_path: Path, monkeypatch, together: int | None) -> None:
    """Whether it is cut whole, or piece by piece: charts of several pieces would paint over one another."""
    if together is not None:
        monkeypatch.setattr(textures, "_PIECE", together)
    scene = ball()
    speck = ball(0.03, MIDDLE + np.array([0, 0, 0.9]), 60)  # a floater
    tracer = SurfelTracer(joined(scene, speck))
    surface = surface_of(tracer, views_of(scene), voxels=64, triangles=4000)
    offset = surface.vertices - MIDDLE
    radius = np.linalg.norm(offset, axis=1)
    assert np.abs(radius - RADIUS).max() < surface.voxel
    assert np.abs(radius.mean() - RADIUS) < 0.3 * surface.voxel
    outwards = (surface.normals * offset).sum(1) / radius
    assert np.quantile(outwards, 0.01) > 0.97
    assert 3000 < len(surface.faces) <= 4000
    assert trimesh.Trimesh(surface.vertices, surface.faces).volume == pytest.approx(VOLUME, rel=0.03)

    part = textured(tracer, surface, 256)
    assert len(part.faces) == len(surface.faces)
    write_glb(tmp_path / "ball.glb", part)
    read = trimesh.load_mesh(tmp_path / "ball.glb", process=False)
    assert isinstance(read, trimesh.Trimesh)
    assert isinstance(read.visual, TextureVisuals)
    place, face = trimesh.sample.sample_surface(read, 2000, seed=0)[:2]
    weights = trimesh.triangles.points_to_barycentric(read.triangles[face], place)
    uv = np.einsum("nk,nkc->nc", weights, read.visual.uv[read.faces[face]])
    material = read.visual.material
    assert isinstance(material, PBRMaterial)
    direction = (place @ Y_UP - MIDDLE) / np.linalg.norm(place @ Y_UP - MIDDLE, axis=1, keepdims=True)
    stored = np.asarray(material.baseColorTexture, float) / 255
    column, row = (uv[:, 0] * 256).astype(int), ((1 - uv[:, 1]) * 256).astype(int)
    linear = np.where(stored <= 0.04045, stored / 12.92, ((stored + 0.055) / 1.055) ** 2.4)[row, column]
    assert np.abs(linear - painted(direction)).mean() < 0.02
    surface_map = np.asarray(material.metallicRoughnessTexture, float)[row, column] / 255
    assert np.abs(surface_map[:, 1] - 0.3).max() < 0.01
    assert np.abs(surface_map[:, 2] - 0.8).max() < 0.01


@pytest.mark.usefixtures("variant")
def test_surfels_without_a_sign_are_painted_from_both_sides() -> None:
    """Every other surfel of a scan looks inside: its paint counts as much."""
    scene = ball()
    unsigned = scene.turned_over(np.arange(len(scene)) % 2 == 0)
    unsigned.oriented = False
    tracer = SurfelTracer(unsigned)
    surface = surface_of(SurfelTracer(scene), views_of(scene), voxels=48, triangles=3000)
    found, wanted = (textured(each, surface, 128) for each in (tracer, SurfelTracer(scene)))
    assert np.abs(found.base_color - wanted.base_color).mean() < 1e-4


@pytest.mark.usefixtures("variant")
def test_cutting_and_painting_tell_how_far_they_have_come(monkeypatch) -> None:
    """Steps are shares of the work: half of the triangles, a quarter of the texels."""
    monkeypatch.setattr(textures, "_PIECE", 1500)
    monkeypatch.setattr(textures, "_AT_ONCE", 128 * 32)
    scene, steps = ball(), {}

    def track(items: Sequence[Any], label: str) -> Iterator[Any]:
        steps[label] = 0
        for item in items:
            yield item
            steps[label] += 1
        assert steps[label] == len(items)

    surface = surface_of(SurfelTracer(scene), views_of(scene), voxels=48, triangles=3000)
    textured(SurfelTracer(scene), surface, 128, track)
    assert steps == {"cutting the surface": 2, "textures": 4}


@pytest.mark.usefixtures("variant")
def test_what_no_view_saw_stays_open() -> None:
    scene = ball()
    from_above = [camera for camera in views_of(scene) if camera.position[2] > 1.5]
    surface = surface_of(SurfelTracer(scene), from_above, voxels=48)
    assert surface.vertices[:, 2].min() > MIDDLE[2] - 0.9 * RADIUS
    assert np.abs(np.linalg.norm(surface.vertices - MIDDLE, axis=1) - RADIUS).max() < 2 * surface.voxel


@pytest.mark.usefixtures("variant")
def test_nothing_to_see_is_one_line() -> None:
    scene = ball()
    scene.opacity_logits[:] = -20
    with pytest.raises(TronError, match="surface"):
        surface_of(SurfelTracer(scene), views_of(scene)[:4], voxels=32)
