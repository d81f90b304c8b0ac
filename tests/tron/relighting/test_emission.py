"""What glows: a lamp over a floor by its form factor and by Mitsuba's paths; files; scenes that do not."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from tron.brdf.bsdf import metallic_roughness
from tron.cameras import Camera, mitsuba_sensor
from tron.color import to_display
from tron.editing.edits import Material, Scale
from tron.editing.selections import Selection
from tron.editing.views import Views
from tron.errors import TronError
from tron.estimation import Estimation
from tron.gaussians.edit import joined, subset
from tron.gaussians.harmonics import eval_sh
from tron.gaussians.scene import GaussianScene
from tron.meshing.surface import Triangles
from tron.meshing.textures import textured as painted
from tron.models.load import load_model
from tron.models.parts import Part
from tron.models.sides import two_sided
from tron.models.surfels import surfels_of_model
from tron.models.write import write_glb
from tron.relighting import Relighter
from tron.relighting.baking import baked
from tron.relighting.proxy import Proxy
from tron.runtime import lanes
from tron.shading.bounces.bounce import BounceTransport
from tron.shading.environments.environment import EnvironmentMap
from tron.tracing import SurfelTracer
from tron.tracing import meshes as meshes_module

SPACING, HALF, HEIGHT = 0.04, 0.3, 0.6
GLOW = np.array([6.0, 3.0, 1.0], np.float32)
NIGHT = EnvironmentMap.constant(1e-4)
VIEW = Camera.look_at((0.5, -1.4, 0.3), (0, 0, 0.22), fov_deg=60, width=64, height=48)


def floor_and_lamp(dense: Any, lamp: bool = True, **fields: Any) -> GaussianScene:
    """A white floor, and above it a square that looks down and glows: the last of the objects."""
    floor, above = dense.plane(SPACING, 1.2), dense.plane(SPACING, HALF)
    hanging = SimpleNamespace(points=above.points + np.array([0, 0, HEIGHT]), normals=-above.normals)
    counts = [len(floor.points), len(above.points)]
    made = dense.scene(
        floor, hanging, spacing=SPACING, object_id=np.repeat([1, 2], counts),
        base_color=np.full((sum(counts), 3), 0.8), roughness=np.ones(sum(counts)),
        emission=np.repeat([0 * GLOW, GLOW], counts, axis=0), **fields,
    )  # fmt: skip
    return made if lamp else subset(made, made.object_id == 1)


def quad(half: float, height: float, up: float, **fields: Any) -> Part:
    """A square that looks up or down, whose image covers it."""
    corners = half * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0.0]]) + [0, 0, height]
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
    plain = {"base_color": np.full(3, 0.8, np.float32), "roughness": 1.0, "metallic": 0.0}
    return Part(
        corners, np.tile([0, 0, up], (4, 1)), faces if up > 0 else faces[:, ::-1], uv, normal_map=None,
        **{**plain, **fields},
    )  # fmt: skip


LAMP = partial(quad, HALF, HEIGHT, -1.0, emission=GLOW)


def reach(scene: GaussianScene) -> float:
    """Half the side of the lamp's surfels, which reach beyond it, by what they hide of rays straight up."""
    step = 0.01
    x, y = np.meshgrid(*[np.arange(-0.5, 0.5, step)] * 2)
    below = np.stack([x.ravel(), y.ravel(), np.full(x.size, HEIGHT / 2)], axis=1)
    tracer = SurfelTracer(subset(scene, scene.object_id == 2)).sided(True)
    through = tracer.transmittance(lanes(mi.Point3f, below), mi.Vector3f(0, 0, 1))
    return float(np.sqrt((1 - np.array(through)).sum()) * step / 2)


def form_factor(points: np.ndarray, half: float) -> np.ndarray:
    """Of the lamp, seen from (N, 2) points of the floor: four rectangles, each by its corner.

    J. R. Howell, "A Catalog of Radiation Heat Transfer Configuration Factors", B-3.
    """
    total = np.zeros(len(points))
    for sx in (-1, 1):
        for sy in (-1, 1):
            a, b = ((half + s * points[:, k]) / HEIGHT for k, s in enumerate((sx, sy)))
            one, other = np.sqrt(1 + a * a), np.sqrt(1 + b * b)
            total += (a / one * np.arctan(b / one) + b / other * np.arctan(a / other)) / (2 * np.pi)
    return total


def test_the_floor_below_a_lamp_has_its_form_factor(dense_surfels) -> None:
    scene = floor_and_lamp(dense_surfels)
    transport = BounceTransport.trace(SurfelTracer(scene), rays=256)
    none = dr.zeros(mi.Color3f, len(scene))
    found = np.array(transport.indirect(none, transport.albedo(), bounces=1)).T
    floor = (scene.object_id == 1) & (np.abs(scene.means[:, :2]).max(1) < 1)
    half = reach(scene)
    assert HALF < half < HALF + SPACING / 2
    wanted = form_factor(scene.means[floor, :2].astype(np.float64), half)
    distance = np.linalg.norm(scene.means[floor, :2], axis=1)
    for low, high in ((0, 0.2), (0.2, 0.4), (0.4, 0.6), (0.6, 0.8), (0.8, 1.0)):
        ring = (distance >= low) & (distance < high)
        expected = wanted[ring].mean() * GLOW
        np.testing.assert_allclose(found[floor][ring].mean(0), expected, rtol=0.03)
    # Nothing is below the lamp but what it is: its own light has to come back.
    assert found[scene.object_id == 2].max() < 0.1


def path_traced(half: float) -> np.ndarray:
    """(H, W, 3) by Mitsuba's paths, with a lamp of that half side as an area emitter."""
    slab = mi.ScalarTransform4f().translate([0, 0, -0.001]).scale([1.2, 1.2, 0.001])
    tone: Any = {"type": "rgb", "value": [0.8] * 3}
    floor = {"type": "cube", "to_world": slab, "bsdf": metallic_roughness(tone, 1.0, 0.0)}
    lamp = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 0, HEIGHT]).rotate([1, 0, 0], 180).scale(half),
        "bsdf": {"type": "twosided", "bsdf": metallic_roughness(tone, 1.0, 0.0)},
        "light": {"type": "area", "radiance": {"type": "rgb", "value": GLOW.tolist()}},
    }
    sensor = {**mitsuba_sensor(VIEW), "sampler": {"type": "independent", "sample_count": 256}}
    scene = mi.load_dict({"type": "scene", "sensor": sensor, "floor": floor, "lamp": lamp})
    path = mi.load_dict({"type": "path", "max_depth": 6, "rr_depth": 100})
    return np.array(mi.render(scene, integrator=path, spp=256))[..., :3]


@pytest.mark.parametrize("kind", ["surfels", "mesh"])
def test_a_lamp_lights_its_floor_as_paths_do(dense_surfels, monkeypatch, kind: str) -> None:
    monkeypatch.setattr(meshes_module, "STAND_INS", 4000)
    meshes = [] if kind == "surfels" else [[LAMP()]]
    scene = floor_and_lamp(dense_surfels, lamp=kind == "surfels")
    truth = path_traced(HALF if meshes else reach(scene))
    relighter = Relighter(scene, Estimation(rays=4), proxy="never", meshes=meshes)
    frame = relighter.under(NIGHT).render(VIEW)
    place, seen = frame.gbuffer["position"], frame.mask > 0.98
    floor = seen & (np.abs(place[..., :2]).max(-1) < 1.1) & (place[..., 2] < 0.01)
    lamp = (frame.gbuffer["emission"][..., 0] > 0.999 * GLOW[0]) & (truth[..., 0] > 0.999 * GLOW[0])
    assert floor.sum() > 400
    assert lamp.sum() > 20
    np.testing.assert_allclose(frame.lit[floor].mean(0), truth[floor].mean(0), rtol=0.05)
    error = np.sqrt(((frame.lit - truth)[floor] ** 2).mean()) / truth[floor].mean()
    assert error < 0.2  # of 32 rays a surfel a tenth meet the lamp
    # The lamp shows itself, and what the floor sends back.
    np.testing.assert_allclose(frame.lit[lamp].mean(0), truth[lamp].mean(0), rtol=0.03)
    alone = Relighter(scene, Estimation(rays=4, bounces=0), proxy="never", meshes=meshes).under(NIGHT)
    unlit = alone.render(VIEW).lit
    assert unlit[floor].max() < 1e-3  # without bounces it lights nothing
    np.testing.assert_allclose(unlit[lamp], np.tile(GLOW, (lamp.sum(), 1)), rtol=1e-3)


def test_a_camera_sees_what_a_surfel_emits_by_its_coverage(dense_surfels) -> None:
    """Le where surfels are opaque; of one of opacity one half its share; nothing from behind."""
    sheet = dense_surfels.plane(SPACING, 0.5)
    closed = dense_surfels.scene(sheet, spacing=SPACING, emission=np.tile(GLOW, (len(sheet.points), 1)))
    one = SimpleNamespace(points=np.zeros((1, 3)), normals=np.array([[0, 0, 1.0]]))
    clear = dense_surfels.scene(
        one, opacity_logits=np.zeros(1), log_scales=np.zeros((1, 2)), emission=GLOW[None]
    )
    for scene, views in ((closed, (2.0, -2.0)), (clear, (2.0, -2.0))):
        for height in views:
            view = Camera.look_at((0.1, 0, height), (0, 0, 0), fov_deg=20, width=16, height=16)
            frames = [
                Relighter(each, Estimation(rays=2, bounces=0), proxy="never").under(NIGHT).render(view)
                for each in (scene, replace(scene, emission=0 * scene.emission))
            ]
            cover = frames[0].mask if height > 0 else 0 * frames[0].mask
            assert cover.max() == pytest.approx((0.995 if scene is closed else 0.5) * (height > 0), abs=0.006)
            share = np.where(cover > 0.99, 1, cover)  # what lies behind an opaque pixel counts for nothing
            for name in ("lit", "pbr", "shadowed"):
                added = frames[0][name] - frames[1][name]
                np.testing.assert_allclose(added, share[..., None] * GLOW, rtol=1e-4, atol=1e-5, err_msg=name)
            for name in ("irradiance", "unshadowed", "indirect"):
                np.testing.assert_allclose(frames[0][name], frames[1][name], rtol=1e-4, err_msg=name)


def test_a_mirror_and_a_bake_show_the_lamp(dense_surfels) -> None:
    scene = floor_and_lamp(dense_surfels)
    floor = scene.object_id == 1
    white = np.repeat(1.0 * floor[:, None], 3, axis=1)
    roughness = np.where(floor, 0.02, 1.0)
    mirror = replace(scene, base_color=white, metallic=1.0 * floor, roughness=roughness).validate()
    view = Camera.look_at((0, -0.2, 0.5), (0, 0, 0), fov_deg=4, width=8, height=8)
    light = Relighter(mirror, Estimation(rays=2, reflections=8), proxy="never").under(NIGHT)
    np.testing.assert_allclose(light.render(view).lit.mean((0, 1)), GLOW, rtol=0.05)

    exposure = 0.1
    shown = baked(Relighter(scene, Estimation(rays=2), proxy="never").under(NIGHT), exposure)
    lamp = subset(shown, ~floor)
    below = np.tile([0.0, 0, 1], (len(lamp), 1))
    wanted = np.asarray(to_display(GLOW[None] * 1.03, exposure, look="photograph"))
    np.testing.assert_allclose(
        eval_sh(lamp.sh, below).mean(0), wanted[0], atol=0.06
    )  # the fit hears backs too


def test_a_proxy_an_edit_and_a_selection_carry_emission(dense_surfels) -> None:
    scene = floor_and_lamp(dense_surfels)
    scan = replace(scene, emission=np.where(scene.object_id[:, None] == 2, GLOW, 0))
    lent = Proxy(replace(scene, emission=0 * GLOW + 0 * scene.means), SPACING).painted(scan)
    np.testing.assert_allclose(lent.surfels.emission, scan.emission, atol=1e-4)
    np.testing.assert_array_equal(subset(scene, scene.object_id == 2).emission[0], GLOW)
    both = joined(scene, scene)
    np.testing.assert_array_equal(both.emission[len(scene) :], scene.emission)
    lit = Material(select=Selection(object=1), emission=(9.0, 1.0, 0.0)).apply(scene, Views())
    dimmed = Material(select=Selection(object=2), emission=Scale(scale=0.5)).apply(lit, Views())
    np.testing.assert_array_equal(dimmed.emission[[0, -1]], [(9, 1, 0), GLOW / 2])


def test_ply_holds_what_glows_and_nothing_else_changes(dense_surfels, tmp_path: Path) -> None:
    scene = floor_and_lamp(dense_surfels)
    scene.save(tmp_path / "lamp.ply")
    found = GaussianScene.load(tmp_path / "lamp.ply")
    np.testing.assert_array_equal(found.emission, scene.emission)
    dark = replace(scene, emission=0 * scene.emission)
    for name, each in (("none", replace(scene, emission=np.empty((0, 3)))), ("zero", dark)):
        each.save(tmp_path / f"{name}.ply")
        assert not GaussianScene.load(tmp_path / f"{name}.ply").emission.any()
    plain, glowing = ((tmp_path / f"{name}.ply").read_bytes() for name in ("none", "lamp"))
    assert plain == (tmp_path / "zero.ply").read_bytes()
    assert b"emission" not in plain
    head, body = glowing.split(b"end_header\n", 1)
    assert head.replace(b"".join(b"property float emission_%d\n" % k for k in range(3)), b"") in plain
    rows = np.frombuffer(body, np.uint8).reshape(len(scene), -1)[:, :-12]
    assert plain.endswith(rows.tobytes())

    broken = glowing.replace(b"emission_2", b"emission_7")
    (tmp_path / "broken.ply").write_bytes(broken)
    with pytest.raises(TronError, match="lacks emission_2"):
        GaussianScene.load(tmp_path / "broken.ply")
    with pytest.raises(TronError, match="emission of 1 surfels is below 0"):
        replace(scene, emission=np.where(np.arange(len(scene))[:, None] == 5, -GLOW, 0)).validate()


def test_a_scene_that_does_not_glow_is_traced_as_before(dense_surfels, kernels_of) -> None:
    """Its G-buffer has no emission, and its kernels are those of a glowing scene without three values."""
    scene = floor_and_lamp(dense_surfels)
    dark = SurfelTracer(replace(scene, emission=np.empty((0, 3))))
    assert dark.gbuffer(VIEW).emission is None
    assert "emission" not in dark.gbuffer(VIEW).numpy()
    glowing = SurfelTracer(scene)
    values = [mi.Float(np.ascontiguousarray(axis)) for axis in scene.emission.T]
    traced = {
        name: kernels_of(lambda tracer=tracer, given=given: dr.eval(tracer.gbuffer(VIEW, given)))
        for name, tracer, given in (("dark", dark, ()), ("valued", dark, values), ("glowing", glowing, ()))
    }
    assert traced["glowing"] == traced["valued"] != traced["dark"]
    ours, theirs = glowing.gbuffer(VIEW).numpy(), dark.gbuffer(VIEW, values).numpy()
    np.testing.assert_array_equal(ours["emission"], theirs["values"])


def test_gltf_files_hold_what_glows(tmp_path: Path) -> None:
    """Ours as trimesh reads it and as we do, theirs with factor, image and strength as we do."""
    image = np.zeros((8, 8, 3), np.float32)
    image[:, :4], image[:4] = (12.0, 0.5, 0.0), (0.0, 3.0, 6.0)
    flat = np.full((8, 8, 3), 0.5, np.float32)
    part = quad(1.0, 0.0, 1.0, base_color=flat, roughness=flat[..., 0], metallic=flat[..., 0], emission=image)
    write_glb(tmp_path / "ours.glb", part)
    read = trimesh.load_mesh(tmp_path / "ours.glb", process=False)
    assert isinstance(read.visual, TextureVisuals)
    assert isinstance(read.visual.material, PBRMaterial)
    np.testing.assert_array_equal(read.visual.material.emissiveFactor, 1.0)
    stored = np.asarray(read.visual.material.emissiveTexture, float) / 255
    np.testing.assert_allclose(stored**2.2 * 12, image, atol=0.15)
    (found,) = load_model(tmp_path / "ours.glb", fitted=False)
    assert found.emission is not None
    np.testing.assert_allclose(found.emission, image, atol=0.06)
    write_glb(tmp_path / "dark.glb", replace(part, emission=None))
    assert b"emissive" not in (tmp_path / "dark.glb").read_bytes()
    assert load_model(tmp_path / "dark.glb")[0].emission is None

    def strengthen(tree: dict[str, Any]) -> None:
        tree["materials"][0]["extensions"] = {"KHR_materials_emissive_strength": {"emissiveStrength": 8.0}}

    grey = Image.fromarray(np.full((4, 4, 3), 188, np.uint8))  # 0.503 linear
    material = PBRMaterial(emissiveFactor=np.array([1.0, 0.5, 0.0]), emissiveTexture=grey)
    visual = TextureVisuals(part.uv, material=material)
    mesh = trimesh.Trimesh(part.vertices, part.faces, visual=visual, process=False)
    content = mesh.export(file_type="glb", tree_postprocessor=strengthen)
    assert isinstance(content, bytes)
    (tmp_path / "theirs.glb").write_bytes(content)
    parts = load_model(tmp_path / "theirs.glb", up="z", fitted=False)
    surfels = surfels_of_model(two_sided(parts), 0.1)
    front = surfels.normals()[:, 2] > 0
    assert front.sum() > 100
    assert (~front).sum() > 100
    expected = np.array([8, 4, 0]) * 0.503
    np.testing.assert_allclose(surfels.emission[front], np.tile(expected, (front.sum(), 1)), rtol=0.01)
    assert not surfels.emission[~front].any()

    def misplace(tree: dict[str, Any]) -> None:
        tree["materials"][0]["emissiveTexture"]["texCoord"] = 3

    content = mesh.export(file_type="glb", tree_postprocessor=misplace)
    assert isinstance(content, bytes)
    (tmp_path / "misplaced.glb").write_bytes(content)
    assert load_model(tmp_path / "misplaced.glb")[0].emission is None


def test_a_mesh_of_surfels_glows_as_they_do(dense_surfels) -> None:
    sheet = dense_surfels.plane(0.1, 1.0)
    right = sheet.points[:, :1] > 0
    scene = dense_surfels.scene(sheet, spacing=0.1, emission=np.where(right, GLOW, 0))
    square = quad(0.9, 0.0, 1.0)
    surface = Triangles(square.vertices, square.normals, square.faces, 0.05)
    part = painted(SurfelTracer(scene), surface, 32)
    assert part.emission is not None
    assert part.emission.shape == (32, 32, 3)
    np.testing.assert_allclose(part.emission.reshape(-1, 3).max(0), GLOW, rtol=1e-3)
    assert np.median(part.emission[..., 0] < 0.01 * GLOW[0]) in (0, 1)
    dark = painted(SurfelTracer(replace(scene, emission=0 * scene.emission)), surface, 32)
    assert dark.emission is None
