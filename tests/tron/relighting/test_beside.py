"""Meshes beside surfels: shadows both ways by geometry, whole pictures by Mitsuba's path tracer."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from tron.brdf.bsdf import metallic_roughness
from tron.cameras import Camera, mitsuba_sensor
from tron.errors import TronError
from tron.estimation import Estimation
from tron.models.parts import Part
from tron.models.shapes import textured
from tron.relighting import Guidance, Relighter
from tron.relighting.baking import baked
from tron.runtime import lanes
from tron.seeds import generator
from tron.shading.environments.environment import EnvironmentLight, EnvironmentMap
from tron.tracing import SurfelTracer
from tron.tracing import meshes as meshes_module

SPACING = 0.05
VIEW = Camera.look_at((1.2, -3.4, 2.2), (0, 0, 0.3), fov_deg=42, width=64, height=48)


@pytest.fixture(autouse=True)
def few_stand_ins(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(meshes_module, "STAND_INS", 4000)


@pytest.fixture(scope="module")
def sun() -> EnvironmentMap:
    """A dim sky with a sun of some degrees."""
    image = np.full((64, 128, 3), 0.2, np.float32)
    image[18:20, 30:32] = 400.0
    return EnvironmentMap(image)


@pytest.fixture(scope="module")
def toward_sun(variant: str, sun: EnvironmentMap) -> np.ndarray:
    """Unit direction of the sun: the brightest of many."""
    ways = generator(0, "tests", "ways").normal(size=(200_000, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    bright = np.array(EnvironmentLight(sun).radiance(lanes(mi.Vector3f, ways)).x) > 200
    middle = ways[bright].mean(0)
    assert middle[2] > 0.3
    return middle / np.linalg.norm(middle)


def box(
    low: Any, high: Any, color: Any = (0.5, 0.5, 0.5), roughness: float = 0.5, metallic: float = 0
) -> Part:
    """An upright box whose sides have normals of their own."""
    corners, normals, faces = [], [], []
    for axis in range(3):
        for side in (0, 1):
            u, v = (np.eye(3)[(axis + k) % 3] for k in (1, 2))
            signs = [(0, 0), (1, 0), (1, 1), (0, 1)] if side else [(0, 0), (0, 1), (1, 1), (1, 0)]
            start = len(corners)
            corners += [side * np.eye(3)[axis] + a * u + b * v for a, b in signs]
            normals += [(2 * side - 1) * np.eye(3)[axis]] * 4
            faces += [[start, start + 1, start + 2], [start, start + 2, start + 3]]
    vertices = np.array(low) + np.array(corners) * (np.array(high) - np.array(low))
    tone = np.array(color, np.float32)
    return Part(vertices, np.array(normals), np.array(faces), None, tone, roughness, float(metallic), None)


LOW, HIGH = np.array([-0.4, -0.3, 0.0]), np.array([0.3, 0.4, 0.8])


def in_the_way(points: np.ndarray, along: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Whether rays from ``points`` (..., 3) meet a box: the slab test (Kay and Kajiya 1986)."""
    with np.errstate(divide="ignore"):
        ends = np.stack([(low - points) / along, (high - points) / along])
    near, far = ends.min(0).max(-1), ends.max(0).min(-1)
    return (near < far) & (far > 1e-3)


def share(frame: Guidance) -> np.ndarray:
    return frame.irradiance.mean(-1) / np.maximum(frame.unshadowed.mean(-1), 1e-9)


def compare_shadow(frame: Guidance, level: np.ndarray, toward: np.ndarray, low: Any, high: Any) -> None:
    """The floor is dark where the box is in the sun's way, but for its edges, and bright else."""
    place = frame.gbuffer["position"]
    inner = in_the_way(place, toward, np.add(low, 0.1), np.subtract(high, 0.1))
    outer = in_the_way(place, toward, np.subtract(low, 0.1), np.add(high, 0.1))
    dark, bright = level & inner, level & ~outer
    assert dark.sum() > 20
    assert bright.sum() > 400
    assert share(frame)[dark].max() < 0.35
    assert share(frame)[bright].min() > 0.75


def level_at(frame: Guidance, height: float) -> np.ndarray:
    z, normal = frame.gbuffer["position"][..., 2], frame.gbuffer["normal"][..., 2]
    return (frame.mask > 0.99) & (np.abs(z - height) < 0.02) & (normal > 0.9)


@pytest.mark.parametrize("rays", [64, 0], ids=["traced", "from the bake"])
def test_a_box_throws_the_shadow_on_surfels_that_geometry_says(dense_surfels, sun, toward_sun, rays):
    scene = dense_surfels.scene(dense_surfels.plane(SPACING, 1.5), spacing=SPACING)
    relighter = Relighter(scene, Estimation(rays=rays), meshes=[[box(LOW, HIGH)]], proxy="never")
    frame = relighter.under(sun).render(VIEW)
    compare_shadow(frame, level_at(frame, 0.0), toward_sun, LOW, HIGH)
    top = level_at(frame, 0.8)
    assert top.sum() > 20
    assert share(frame)[top].min() > 0.7


@pytest.mark.parametrize("rays", [64, 0], ids=["traced", "from the bake"])
def test_surfels_throw_the_shadow_on_a_mesh_that_geometry_says(dense_surfels, sun, toward_sun, rays):
    block = dense_surfels.box(SPACING, 0.4, 0.401)
    scene = dense_surfels.scene(block, spacing=SPACING)
    floor = box((-1.5, -1.5, -0.1), (1.5, 1.5, 0))
    relighter = Relighter(scene, Estimation(rays=rays), meshes=[[floor]], proxy="never")
    frame = relighter.under(sun).render(VIEW)
    compare_shadow(frame, level_at(frame, 0.0), toward_sun, (-0.4, -0.4, 0), (0.4, 0.4, 0.8))


def still_life(dense: Any) -> tuple[Any, list[Part], list[dict[str, Any]]]:
    """A white floor of surfels; a red wall and a green block as meshes; and all of it as Mitsuba's shapes."""
    floor = dense.plane(SPACING, 1.5)
    scene = dense.scene(floor, spacing=SPACING, base_color=np.full((len(floor.points), 3), 0.8),
                        roughness=np.full(len(floor.points), 0.7))  # fmt: skip
    parts = [
        box((-0.9, 0.5, 0), (0.9, 0.6, 1.0), (0.8, 0.1, 0.1)),
        box((0.1, -0.6, 0), (0.6, -0.2, 0.4), (0.1, 0.6, 0.2), 0.3),
    ]
    tone = {"type": "rgb", "value": [0.8] * 3}
    bsdf = metallic_roughness(tone, 0.7, 0.0)
    shapes: list[Any] = [{**floor.mitsuba, "bsdf": bsdf}]
    return scene, parts, shapes + [textured(part, f"part{k}").shape for k, part in enumerate(parts)]


def path_traced(shapes: list[Any], light: EnvironmentMap) -> np.ndarray:
    """(H, W, 3) linear radiance by Mitsuba's paths."""
    sensor = {**mitsuba_sensor(VIEW), "sampler": {"type": "multijitter", "sample_count": 400}}
    named = {f"shape{k}": shape for k, shape in enumerate(shapes)}
    scene = mi.load_dict({"type": "scene", "sensor": sensor, "light": light.to_mitsuba(), **named})
    integrator = mi.load_dict({"type": "path", "max_depth": 6, "rr_depth": 100})
    return np.array(mi.render(scene, integrator=integrator, spp=400))[..., :3]


def error(picture: np.ndarray, truth: np.ndarray, where: np.ndarray) -> float:
    """RMSE over the mean of the truth."""
    return float(np.sqrt(np.mean((picture - truth)[where] ** 2)) / truth[where].mean())


def test_pictures_are_those_of_a_path_tracer(dense_surfels, sun):
    scene, parts, shapes = still_life(dense_surfels)
    truth = path_traced(shapes, sun)
    estimation = Estimation(rays=64, supersample=2, filtered=True, reflections=16)
    light = Relighter(scene, estimation, meshes=[parts[:1], parts[1:]], proxy="never").under(sun)
    frame = light.render(VIEW)
    # Away from edges, which the path tracer's pixels hold in other shares.
    tones = frame.gbuffer["base_color"][..., None, :] - np.array(
        [(0.8, 0.8, 0.8), *(p.base_color for p in parts)]
    )
    whole = (np.abs(tones).max(-1) < 0.02) & (frame.mask > 0.98)[..., None]
    inner: list[Any] = [binary_erosion(whole[..., k], np.ones((3, 3))) for k in range(3)]
    floor, *made = inner
    assert floor.sum() > 500
    assert error(frame.lit, truth, floor) < 0.06
    for each in made:
        assert each.sum() > 40
        assert error(frame.lit, truth, each) < 0.1
        np.testing.assert_allclose(frame.lit[each].mean(0), truth[each].mean(0), rtol=0.04)
    # Before the sunlit wall the floor is redder than elsewhere, by the wall's surfels alone.
    place = frame.gbuffer["position"]
    before = (
        np.asarray(whole)[..., 0]
        & (np.abs(place[..., 0]) < 0.5)
        & (place[..., 1] > 0.25)
        & (place[..., 1] < 0.45)
    )
    assert before.sum() > 5
    redness = [float((image[..., 0] / image[..., 2])[before].mean()) for image in (frame.lit, truth)]
    assert redness[1] > 1.05
    assert redness[0] - 1 == pytest.approx(float(redness[1]) - 1, rel=0.25)


def test_mirrors_of_surfels_show_meshes(dense_surfels, sun):
    floor = dense_surfels.plane(SPACING, 1.5)
    many = len(floor.points)
    scene = dense_surfels.scene(floor, spacing=SPACING, base_color=np.full((many, 3), 0.9),
                                roughness=np.full(many, 0.1), metallic=np.ones(many))  # fmt: skip
    wall = box((-1.2, 0.6, 0), (1.2, 0.8, 1.5), (0.8, 0.05, 0.05), 0.9)
    even = EnvironmentMap(np.full((32, 64, 3), 0.5, np.float32))
    redness = {}
    for name, meshes in (("wall", [[wall]]), ("none", [])):
        relighter = Relighter(scene, Estimation(reflections=8), meshes=meshes, proxy="never")
        frame = relighter.under(even).render(VIEW)
        place = frame.gbuffer["position"]
        before = (np.abs(place[..., 0]) < 0.5) & (place[..., 1] > 0.2) & (place[..., 1] < 0.5)
        before &= np.abs(place[..., 2]) < 0.02
        redness[name] = float((frame.lit[..., 0] / frame.lit[..., 1])[before].mean())
    assert redness["none"] == pytest.approx(1, abs=1e-3)
    assert redness["wall"] > 3


def test_without_meshes_every_bit_is_the_same(dense_surfels, sun):
    scene = dense_surfels.scene(dense_surfels.plane(SPACING, 0.5), spacing=SPACING)
    plain, none = Relighter(scene, proxy="never"), Relighter(scene, proxy="never", meshes=[])
    assert type(none.tracer(VIEW)) is type(none.transport.tracer) is SurfelTracer
    frames = [each.under(sun).render(VIEW) for each in (plain, none)]
    for name in Guidance.BUFFERS:
        np.testing.assert_array_equal(frames[0][name], frames[1][name], err_msg=name)


@pytest.mark.parametrize("kind", ["signless", pytest.param("proxied", marks=pytest.mark.long)])
def test_meshes_stand_in_scans_too(dense_surfels, sun, short_film, kind):
    ball = dense_surfels.sphere(0.08, 0.4, -0.6)
    floor = dense_surfels.plane(0.08, 1.2)
    scene = dense_surfels.scene(floor, ball, spacing=0.08)
    scene = replace(scene, oriented=kind == "proxied")
    proxy = "never" if kind == "signless" else "always"
    relighter = Relighter(scene, Estimation(rays=16), meshes=[[box(LOW, HIGH, (0.8, 0.1, 0.1))]], proxy=proxy)
    frame = relighter.under(sun).render(VIEW)
    on_mesh = (frame.gbuffer["base_color"][..., 0] > 0.7) & (frame.mask > 0.999)
    assert on_mesh.sum() > 200
    shaded = share(frame)[level_at(frame, 0.0) | (np.abs(frame.gbuffer["position"][..., 2]) < 0.1)]
    assert shaded.min() < 0.4
    assert np.isfinite(frame.lit).all()


def test_a_changed_scene_and_moved_meshes_are_as_made_anew(dense_surfels, sun):
    scene = dense_surfels.scene(dense_surfels.plane(SPACING, 1.2), spacing=SPACING)
    other = replace(scene, means=scene.means + np.array([0, 0, 0.1], np.float32))
    before = Relighter(scene, Estimation(rays=16), meshes=[[box(LOW, HIGH)]], proxy="never")
    before.under(sun)
    pose = np.eye(3), np.zeros(3), np.array([0.2, 0.1, 0.1])
    assert before.meshes is not None
    changed = before.changed(other, meshes=before.meshes.moved([pose])).under(sun).render(VIEW)
    moved = box(LOW + pose[2], HIGH + pose[2])
    anew = Relighter(other, Estimation(rays=16), meshes=[[moved]], proxy="never").under(sun).render(VIEW)
    for name in ("unshadowed", "irradiance"):
        np.testing.assert_allclose(
            changed[name], anew[name], rtol=1e-3, atol=2e-3 * anew[name].max(), err_msg=name
        )
    assert error(changed.lit, anew.lit, anew.mask > 0.99) < 0.02
    still = before.under(sun).render(VIEW)
    assert error(still.lit, anew.lit, anew.mask > 0.99) > 0.05


def test_a_scene_with_meshes_is_not_baked_into_a_file(dense_surfels, sun):
    scene = dense_surfels.scene(dense_surfels.plane(0.2, 0.5), spacing=0.2)
    light = Relighter(scene, meshes=[[box(LOW, HIGH)]], proxy="never").under(sun)
    with pytest.raises(TronError, match="holds no mesh"):
        baked(light, 1.0)
