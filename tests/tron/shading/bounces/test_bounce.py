"""Laws of light that bounces: furnaces, energy, Mitsuba's paths, colours that bleed, things that move."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tron.brdf.reflectance import bounce_albedo
from tron.brdf.table import BrdfTable
from tron.cameras import Camera, mitsuba_sensor
from tron.errors import TronError
from tron.estimation import Estimation
from tron.gaussians.edit import moved
from tron.seeds import generator
from tron.shading.bounces.bounce import BounceTransport
from tron.shading.environments.cubemap import CubemapLight
from tron.shading.environments.environment import EnvironmentMap
from tron.shading.lighting import Lighting, SplitSum
from tron.tracing import SurfelTracer
from tron.tracing.parameters import SurfelParameters

SPACING = 0.05


@pytest.fixture(scope="module")
def white(variant: str) -> Lighting:
    return Lighting(EnvironmentMap.constant(1.0))


def inside_out(sheet: Any) -> Any:
    return SimpleNamespace(points=sheet.points, normals=-sheet.normals, mitsuba=sheet.mitsuba)


def everywhere(transport: BounceTransport, value: float) -> mi.Color3f:
    return dr.full(mi.Color3f, value, len(transport.tracer.scene))


def numbers(color: Any) -> np.ndarray:
    """(M, 3) or (M,) of a Dr.Jit array."""
    return np.array(color).T


@pytest.mark.parametrize("room", ["sphere", "box"])
def test_a_furnace_converges_to_one_over_one_minus_albedo(dense_surfels, room: str) -> None:
    """A closed room whose walls emit 1: all light that leaves them is 1 + a + a^2 + .."""
    walls = inside_out(getattr(dense_surfels, room)())
    transport = BounceTransport.trace(SurfelTracer(dense_surfels.scene(walls)))
    assert numbers(transport.openness()).mean() < 0.005
    emitted = everywhere(transport, 1.0)
    for albedo in (0.3, 0.8):
        walls_albedo = everywhere(transport, albedo)
        light = 1 + numbers(transport.indirect(emitted, walls_albedo, bounces=64))
        assert light.mean() == pytest.approx(1 / (1 - albedo), rel=0.02)
        assert light.max() <= 1 / (1 - albedo) * (1 + 1e-5)
        once = numbers(transport.indirect(emitted, walls_albedo, bounces=1))
        assert once.mean() == pytest.approx(albedo, rel=0.01)


@pytest.fixture
def random_surfels(dense_surfels) -> Any:
    """Surfels at random, of random materials."""
    rng = generator(0, "tests", "cloud")
    normals = rng.normal(size=(600, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    cloud = SimpleNamespace(points=rng.uniform(-0.5, 0.5, (600, 3)), normals=normals)
    materials = {
        "base_color": rng.choice([0.2, 0.8, 1.0], (600, 3)),
        "roughness": rng.random(600),
        "metallic": rng.choice([0.0, 0.5, 1.0], 600),
    }
    return dense_surfels.scene(cloud, spacing=0.1, **materials)


def test_no_scene_gains_energy(sun_map, random_surfels) -> None:
    """Of n bounces at most a + .. + a^n of the brightest direct light, a the largest albedo."""
    transport = BounceTransport.trace(SurfelTracer(random_surfels))
    albedo = numbers(transport.albedo())
    assert (albedo >= 0).all()
    assert 0.98 < albedo.max() < 1
    assert 0.1 < numbers(transport.openness()).mean() < 0.9
    direct = transport.direct(Lighting(sun_map))
    brightest, before = numbers(direct).max(), 0.0
    for bounces in (1, 2, 3, 8, 32):
        found = numbers(transport.indirect(direct, mi.Color3f(transport.albedo()), bounces))
        series = sum(albedo.max() ** k for k in range(1, bounces + 1))
        assert found.max() <= brightest * series * (1 + 1e-5)
        assert found.min() >= 0
        assert found.sum() >= before
        before = found.sum()


@pytest.mark.parametrize("shape", ["plane", "sphere", "box"])
def test_nothing_bounces_where_a_convex_object_stands_alone(dense_surfels, white, shape: str) -> None:
    scene = dense_surfels.scene(getattr(dense_surfels, shape)())
    baked = BounceTransport.trace(SurfelTracer(scene)).bake(white)
    assert numbers(baked.indirect).max() <= 0.05
    assert numbers(baked.indirect).mean() < 1e-3
    assert numbers(baked.openness).mean() > 0.996  # at a box's edges the surfels of one face overhang another
    np.testing.assert_allclose(numbers(baked.direct).mean(), 1, atol=0.01)


def test_openness_under_a_ball_is_what_its_form_factor_leaves(dense_surfels) -> None:
    """A ball of radius r, its centre h above a point, fills (r / h)^2 of what the point sees."""
    radius, height = 0.5, 1.0
    scene = dense_surfels.scene(
        dense_surfels.plane(half=1.0), dense_surfels.sphere(radius=radius, height=height)
    )
    transport = BounceTransport.trace(SurfelTracer(scene), rays=256)
    under = (np.linalg.norm(scene.means[:, :2], axis=1) < 2 * SPACING) & (scene.means[:, 2] < 1e-6)
    assert under.sum() >= 12
    expected = 1 - (radius / height) ** 2
    assert numbers(transport.openness())[under].mean() == pytest.approx(expected, abs=0.02)


CORNELL = {"red": (0.570, 0.043, 0.044), "green": (0.105, 0.378, 0.076), "white": (0.886, 0.699, 0.666)}
"""Reflectances of ``mi.cornell_box()``, linear BT.709."""


def path_traced(sheets: list[Any], view: Camera, light: EnvironmentMap, depth: int, spp: int) -> np.ndarray:
    """(H, W, 3) radiance by paths of up to ``depth`` segments, of Lambert shapes of ``sheet.color``."""
    shapes = {
        f"shape{k}": {
            **sheet.mitsuba,
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(sheet.color)}},
        }
        for k, sheet in enumerate(sheets)
    }
    sensor = {**mitsuba_sensor(view), "sampler": {"type": "multijitter", "sample_count": spp}}
    scene = mi.load_dict({"type": "scene", "sensor": sensor, "light": light.to_mitsuba(), **shapes})
    integrator = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": 100, "hide_emitters": True})
    return np.array(mi.render(scene, integrator=integrator, spp=spp))[..., :3]


def colored(sheet: Any, color: tuple[float, float, float]) -> Any:
    return SimpleNamespace(**{**vars(sheet), "color": color})


def lambert_scene(dense_surfels, sheets: list[Any], spacing: float = SPACING) -> Any:
    color = np.concatenate([np.tile(sheet.color, (len(sheet.points), 1)) for sheet in sheets])
    return dense_surfels.scene(*sheets, base_color=color, spacing=spacing)


def bounced(scene: Any, view: Camera, light: EnvironmentMap, bounces: int) -> dict[str, np.ndarray]:
    """G-buffer of ``view``, and radiance that has bounced before it met what the camera sees, (H, W, 3)."""
    transport = BounceTransport.trace(SurfelTracer(scene))
    every = transport.surfels().base_color
    direct = transport.direct_of_faces(Lighting(light), Estimation(rays=32))
    indirect = transport.indirect(direct, every, bounces)
    seen = transport.tracer.gbuffer(view, list(indirect)).numpy()
    return {**seen, "bounced": seen["base_color"] * seen["values"] * seen["opacity"][..., None]}


def still_life(dense: Any) -> list[Any]:
    """A box on a floor and a ball above it, in three colours."""
    turn = Rotation.from_euler("z", 30, degrees=True).as_matrix()
    return [
        colored(dense.plane(half=3.0), (0.6, 0.55, 0.5)),
        colored(dense.turned(dense.box(half=0.5, height=0.5), turn), (0.7, 0.2, 0.15)),
        colored(dense.sphere(radius=0.5, height=1.5), (0.3, 0.5, 0.7)),
    ]


@pytest.mark.parametrize(("light", "depth", "bounces"), [("smooth", 3, 1), ("sun", 12, 10)])
def test_what_bounces_is_what_mitsubas_paths_bring(
    dense_surfels, sun_map, light: str, depth: int, bounces: int
) -> None:
    """Paths of up to ``depth`` segments less those of two: light that has met one surface or more before."""
    bands = generator(1, "tests", "bands").random((4, 8, 3)) * 3
    environment = sun_map if light == "sun" else EnvironmentMap(bands.astype(np.float32)).resized(64)
    sheets = still_life(dense_surfels)
    view = Camera.look_at((2.5, -3.2, 2.0), (0, 0, 0.7), fov_deg=35, width=48, height=48)
    ours = bounced(lambert_scene(dense_surfels, sheets), view, environment, bounces)
    many, two = (path_traced(sheets, view, environment, d, 1024) for d in (depth, 2))
    theirs, seen = many - two, ours["opacity"] > 0.99
    assert seen.mean() > 0.3
    ratio = ours["bounced"][seen].mean(0) / theirs[seen].mean(0)
    assert (ratio > 0.9).all()
    assert (ratio < 1.05).all()
    # Where it falls, too: blocks of 6 x 6 pixels, which leave Mitsuba little noise.
    blocks = [
        np.where(seen[..., None], image, 0).reshape(8, 6, 8, 6, 3).mean((1, 3))
        for image in (ours["bounced"], theirs)
    ]
    assert np.corrcoef(blocks[0].ravel(), blocks[1].ravel())[0, 1] > 0.97


def cornell_box(dense: Any) -> dict[str, Any]:
    """Five walls about the cube from (-1, -1, 0) to (1, 1, 2), open towards -y, in the box's own colours."""
    turns = {
        "floor": ("x", 0, (0, 0, 0), "white"),
        "ceiling": ("x", 180, (0, 0, 2), "white"),
        "back": ("x", 90, (0, 1, 1), "white"),
        "left": ("y", 90, (-1, 0, 1), "red"),
        "right": ("y", -90, (1, 0, 1), "green"),
    }
    walls = {}
    for name, (axis, angle, shift, color) in turns.items():
        sheet = dense.turned(
            dense.plane(half=1.0), Rotation.from_euler(axis, angle, degrees=True).as_matrix()
        )
        to_world = mi.ScalarTransform4f().translate(shift) @ sheet.mitsuba["to_world"]
        shape = {**sheet.mitsuba, "to_world": to_world}
        walls[name] = SimpleNamespace(
            points=sheet.points + shift, normals=sheet.normals, mitsuba=shape, color=CORNELL[color]
        )
    return walls


def from_the_front() -> EnvironmentMap:
    """Even light that comes from -y."""
    polar, turn = np.meshgrid(np.linspace(0, np.pi, 32), (np.arange(64) + 0.5) / 32 * np.pi, indexing="ij")
    lit = np.sin(polar) * np.cos(turn) < -0.3
    return EnvironmentMap(np.repeat(lit[..., None], 3, -1).astype(np.float32))


def test_light_in_the_cornell_box_takes_the_colour_of_the_wall_it_met(dense_surfels) -> None:
    """Of a wall alone exactly its reflectance; of all of them what Mitsuba's paths bring, red and green."""
    walls, light = cornell_box(dense_surfels), from_the_front()
    scene = lambert_scene(dense_surfels, list(walls.values()))
    transport = BounceTransport.trace(SurfelTracer(scene))
    direct = transport.direct(Lighting(light))
    wall = np.repeat(list(walls), [len(sheet.points) for sheet in walls.values()])
    for name in ("left", "right"):
        only = np.where((wall == name)[:, None], scene.base_color, 0)
        found = numbers(transport.indirect(direct, mi.Color3f(only.T.copy()), bounces=1))[wall == "floor"]
        expected = np.array(walls[name].color) / sum(walls[name].color)
        np.testing.assert_allclose(found.sum(0) / found.sum(), expected, atol=1e-3)

    view = Camera.look_at((0, -3.6, 1), (0, 0, 1), fov_deg=38, width=48, height=48)
    ours = bounced(scene, view, light, bounces=10)
    theirs = path_traced(list(walls.values()), view, light, 12, 1024)
    theirs = theirs - path_traced(list(walls.values()), view, light, 2, 1024)
    position = ours["position"]
    floor = (ours["opacity"] > 0.99) & (position[..., 2] < 0.05) & (position[..., 1] < 0.9)
    tints = []
    for side in (-1, 1):
        near = floor & (side * position[..., 0] > 0.5) & (side * position[..., 0] < 0.95)
        assert near.sum() > 30
        mean = ours["bounced"][near].mean(0)
        ratio = mean / theirs[near].mean(0)
        assert (ratio > 0.9).all()
        assert (ratio < 1.05).all()
        tints.append(mean[0] / mean[1])
    assert tints[0] > 1.2 * tints[1]


def test_the_same_seed_gives_the_same_bytes(dense_surfels, sun_map) -> None:
    scene, lighting = lambert_scene(dense_surfels, still_life(dense_surfels)), Lighting(sun_map)

    def bake(seed: int) -> list[np.ndarray]:
        baked = BounceTransport.trace(SurfelTracer(scene), seed=seed).bake(lighting, seed=seed)
        return [numbers(value) for value in (baked.direct, baked.indirect, baked.outgoing, baked.openness)]

    first = bake(3)
    for again, other, value in zip(bake(3), bake(4), first):
        np.testing.assert_array_equal(again, value)
        assert (other != value).any()


def test_an_object_that_has_moved_bounces_as_if_baked_there(dense_surfels, sun_map) -> None:
    """Within the noise between bakes of two seeds, and unlike what it was where it stood."""
    sheets, lighting = still_life(dense_surfels), Lighting(sun_map)
    scene = lambert_scene(dense_surfels, sheets)
    ball = np.arange(len(scene)) >= len(scene) - len(sheets[-1].points)
    there = moved(scene, ball, translation=np.array([0.9, -0.8, -0.95]))
    before = BounceTransport.trace(SurfelTracer(scene))
    after = before.moved(before.tracer.moved(there))

    def indirect(transport: BounceTransport) -> np.ndarray:
        return numbers(transport.bake(lighting).indirect)

    found = indirect(after)
    fresh, other = (indirect(BounceTransport.trace(SurfelTracer(there), seed=seed)) for seed in (0, 1))

    def apart(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.sqrt(np.mean((a - b) ** 2)))

    assert apart(found, fresh) <= 1.1 * apart(other, fresh)
    assert apart(indirect(before), fresh) > 1.5 * apart(other, fresh)
    np.testing.assert_allclose(found.mean(0), fresh.mean(0), rtol=0.01)


@pytest.mark.parametrize("share", [0.01, 0.3, 1.0])
def test_tracing_what_has_changed_is_tracing_all_anew(random_surfels, share: float) -> None:
    """To the byte, where the hierarchy keeps its order, however many surfels have moved, and wherever to."""
    which = np.arange(len(random_surfels)) < share * len(random_surfels)
    turn = Rotation.from_euler("xyz", [20, 40, 60], degrees=True).as_matrix()
    there = moved(random_surfels, which, rotation=turn, translation=np.array([0.1, 0.05, -0.1]))
    before = BounceTransport.trace(SurfelTracer(random_surfels), rays=16)
    tracer = before.tracer.moved(there)
    found, anew = (
        [numbers(transport.openness()), numbers(transport.indirect(ones, ones * 0.5))]
        for transport in (before.moved(tracer), BounceTransport.trace(tracer, rays=16))
        for ones in [everywhere(transport, 1.0)]
    )
    for value, expected in zip(found, anew):
        np.testing.assert_array_equal(value, expected)
    assert (numbers(before.openness()) != anew[0]).mean() > 0.3 * share
    back = before.moved(tracer).moved(tracer.moved(random_surfels))
    np.testing.assert_array_equal(numbers(back.openness()), numbers(before.openness()))


def test_what_cannot_be_traced_is_refused(dense_surfels) -> None:
    tracer = SurfelTracer(dense_surfels.scene(dense_surfels.plane(half=0.2)))
    with pytest.raises(TronError, match="rays is 0"):
        BounceTransport.trace(tracer, rays=0)
    with pytest.raises(TronError, match="too many"):
        BounceTransport.trace(tracer, rays=1 << 30)
    fewer = SurfelTracer(dense_surfels.scene(dense_surfels.plane(half=0.1)))
    with pytest.raises(TronError, match="come or gone"):
        BounceTransport.trace(tracer, rays=1).moved(fewer)


def test_surfels_treated_in_parts_meet_what_they_meet_at_once(dense_surfels, white, monkeypatch) -> None:
    """Which rays there are does not depend on the parts; shadow rays do, in the noise."""
    scene = lambert_scene(dense_surfels, still_life(dense_surfels))
    found = []
    for at_once in (1 << 20, 1 << 12):
        monkeypatch.setattr("tron.shading.bounces.bounce_rays.AT_ONCE", at_once)
        transport = BounceTransport.trace(SurfelTracer(scene), rays=8)
        ones = everywhere(transport, 1.0)
        met = numbers(transport.openness()), numbers(transport.indirect(ones, ones * 0.5))
        found.append((*met, numbers(transport.direct(white))))
    assert len(scene) > 2 << 12
    for whole, in_parts in list(zip(*found))[:2]:
        np.testing.assert_array_equal(in_parts, whole)
    np.testing.assert_allclose(found[1][2].mean(), found[0][2].mean(), rtol=2e-3)


@pytest.mark.parametrize("rays", [1, 8])
def test_few_surfels_and_rays_are_enough(dense_surfels, white, rays: int) -> None:
    """One surfel, and two that face each other from no sheet's distance, of any number of rays."""
    points, normals = np.array([[0, 0, 0], [0, 0, 0.045]]), np.array([[0, 0, 1], [0, 0, -1]])
    for count, meets in ((1, False), (2, True)):
        part = SimpleNamespace(points=points[:count], normals=normals[:count])
        baked = BounceTransport.trace(SurfelTracer(dense_surfels.scene(part)), rays=rays).bake(white)
        assert (numbers(baked.openness) < 1).all() == meets
        assert np.isfinite(numbers(baked.outgoing)).all()


def test_other_lights_and_scenes_compile_no_new_kernel(dense_surfels, sun_map, kernels_of) -> None:
    lights = [Lighting(sun_map), Lighting(EnvironmentMap(sun_map.image * 0.5, rotation_deg=30))]
    tracers = [SurfelTracer(dense_surfels.scene(dense_surfels.sphere(spacing))) for spacing in (0.16, 0.17)]
    dr.eval([tracer.bvh for tracer in tracers])

    def bake(number: int) -> None:
        BounceTransport.trace(tracers[number], seed=number).bake(lights[number])

    bake(0)
    first = kernels_of(lambda: bake(0))
    assert kernels_of(lambda: bake(1)) <= first, "compiled anew"


def room(dense_surfels) -> Any:
    """A small floor, wall and ball, some of each shiny and metallic."""
    wall = dense_surfels.turned(
        dense_surfels.plane(0.1, half=0.5), Rotation.from_euler("x", 90, degrees=True).as_matrix()
    )
    sheets = [
        dense_surfels.plane(0.1, half=0.8),
        SimpleNamespace(points=wall.points + np.array([0, 0.5, 0.5]), normals=wall.normals),
        dense_surfels.sphere(0.1, radius=0.3, height=0.5),
    ]
    count = sum(len(sheet.points) for sheet in sheets)
    rng = generator(0, "tests", "materials")
    materials = {
        "base_color": rng.uniform(0.2, 0.7, (count, 3)),
        "roughness": rng.uniform(0.2, 0.9, count),
        "metallic": rng.uniform(0.1, 0.9, count),
    }
    return dense_surfels.scene(*sheets, spacing=0.1, **materials)


def test_gradients_of_bounced_light_are_differences(dense_surfels, sun_map, cubemap_of) -> None:
    """By base color, roughness, metallic and the light's texels; what rays meet stands still."""
    scene = room(dense_surfels)
    transport = BounceTransport.trace(SurfelTracer(scene))
    visible = transport.visible(Lighting(sun_map))
    bands = generator(1, "tests", "bands").random((4, 8, 3)).astype(np.float32)
    cubemap = cubemap_of(EnvironmentMap(bands).resized(32), 64)
    rng = generator(0, "tests", "loss")
    weights = mi.Color3f(*[mi.Float(row) for row in rng.normal(size=(3, len(scene))).astype(np.float32)])
    surfels = transport.surfels()
    dr.eval(surfels)

    def direct_of(texels: mi.Float) -> mi.Color3f:
        return SplitSum(CubemapLight(texels, 64), 64).diffuse(surfels.normal) * visible

    still = direct_of(cubemap.texels)
    dr.eval(still)

    def lit(base: mi.Color3f, roughness: mi.Float, metallic: mi.Float, texels: mi.Float) -> mi.Color3f:
        there = replace(surfels, base_color=base, roughness=roughness, metallic=metallic)
        direct = still if texels is cubemap.texels else direct_of(texels)
        indirect = transport.indirect(direct, bounce_albedo(there, BrdfTable.load()), bounces=4)
        return weights * indirect

    given = [surfels.base_color, surfels.roughness, surfels.metallic, cubemap.texels]
    for k in range(4):
        arguments = list(given)
        arguments[k] = type(given[k])(given[k])
        dr.enable_grad(arguments[k])
        dr.backward(dr.sum(dr.sum(lit(*arguments))))
        found = np.atleast_2d(np.array(dr.grad(arguments[k])))
        direction = rng.normal(size=found.shape).astype(np.float32)
        size = 2e-2 if k == 3 else 2e-3  # light is all but linear in its texels
        ends = []
        for sign in (1, -1):
            moved_by = [mi.Float(row) for row in sign * size * direction]
            shifted = list(given)
            shifted[k] = given[k] + (mi.Color3f(*moved_by) if k == 0 else moved_by[0])
            ends.append(np.array(lit(*shifted), np.float64).sum())  # float32 would round the difference away
        expected = (ends[0] - ends[1]) / (2 * size)
        scale = float(np.linalg.norm(found))  # what a random direction's derivative is of the size of
        assert scale > 0
        # The reflectance table is linear between entries of roughness: kinks lie within a difference.
        exact = 0.02 if k == 1 else 0.002
        assert float((found * direction).sum()) == pytest.approx(expected, abs=exact * scale)


def test_gradients_reach_a_tracers_parameters(dense_surfels, sun_map) -> None:
    scene = room(dense_surfels)
    parameters = SurfelParameters.from_scene(scene)
    dr.enable_grad(parameters.base_color)
    transport = BounceTransport.trace(SurfelTracer(scene, parameters=parameters))
    lighting = Lighting(sun_map)
    for _ in range(2):  # as often as they are asked for
        baked = transport.bake(lighting)
        view = Camera.look_at((0.5, -1.5, 1.5), (0, 0, 0.3), fov_deg=50, width=16, height=16)
        seen = transport.tracer.gbuffer(view, baked.values())
        dr.backward(dr.sum(seen.values[0] + seen.values[1]))
        gradient = np.array(dr.grad(parameters.base_color)).reshape(-1, 3)
        assert (gradient[:, :2] > 0).mean() > 0.5
        np.testing.assert_array_equal(gradient[:, 2], 0)
        dr.set_grad(parameters.base_color, 0)
