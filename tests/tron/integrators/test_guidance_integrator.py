"""Laws of ``tron_guidance``: the library's guidance by Mitsuba's sensors, under its scene's own light."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tron import integrators
from tron.cameras import Camera, mitsuba_sensor
from tron.errors import TronError
from tron.estimation import Estimation
from tron.gaussians.scene import GaussianScene
from tron.integrators.guidance import environment_of
from tron.seeds import generator
from tron.shading.bounces.bounce import BounceTransport
from tron.shading.environments.environment import EnvironmentMap
from tron.shading.guidance import Guidance, Lighting, render_guidance
from tron.tracing import SurfelTracer

CAMERA = Camera.look_at((1.5, -2.5, 1.6), (0, 0, 0.3), fov_deg=45, width=36, height=24)
CENTRES = {"type": "stratified", "jitter": False, "sample_count": 1}
BUFFERS = ("pbr", "irradiance", "unshadowed", "shadowed", "indirect", "lit")


@pytest.fixture
def surfels(dense_surfels) -> GaussianScene:
    spacing = 0.2
    integrators.register()
    return dense_surfels.scene(
        dense_surfels.plane(spacing, 1.2), dense_surfels.sphere(spacing, 0.5, 0.5), spacing=spacing
    )


@pytest.fixture
def light() -> EnvironmentMap:
    image = generator(1, "map").random((16, 32, 3)) ** 4 * 5
    return EnvironmentMap(image.astype(np.float32), 40.0)


def scene_of(light: dict[str, Any] | None, spp: int = 1) -> mi.Scene:
    sensor = {**mitsuba_sensor(CAMERA, pixel_format="rgba"), "sampler": {**CENTRES, "sample_count": spp}}
    return mi.load_dict({"type": "scene", "sensor": sensor} | ({"light": light} if light else {}))


def plugin(surfels: GaussianScene, **properties: Any) -> mi.Integrator:
    given = {"shadow_rays": 16, **properties}
    return mi.load_dict({"type": "tron_guidance", "surfels": integrators.embed(surfels), **given})


def channels(image: mi.TensorXf, integrator: mi.Integrator) -> dict[str, np.ndarray]:
    pixels, names = np.array(image), integrator.aov_names()
    found = {"main": pixels[..., :3], "A": pixels[..., 3], "opacity": pixels[..., -1]}
    for name in BUFFERS:
        if f"{name}.R" in names:
            found[name] = pixels[..., 4 + names.index(f"{name}.R") :][..., :3]
    return found


def ours(surfels: GaussianScene, light: EnvironmentMap, **chosen: Any) -> Guidance:
    tracer, lighting, estimation = SurfelTracer(surfels), Lighting(light), Estimation(rays=16, **chosen)
    bounce = BounceTransport.trace(tracer).bake(lighting, estimation)
    return render_guidance(tracer, CAMERA, lighting, estimation, 0, bounce=bounce)


@pytest.mark.parametrize("buffer", ["pbr", "irradiance", "lit"])
def test_pixel_centres_see_the_librarys_guidance(surfels, light, buffer: str) -> None:
    integrator = plugin(surfels, buffer=buffer)
    seen = channels(mi.render(scene_of(light.to_mitsuba()), integrator=integrator), integrator)
    truth = ours(surfels, light)
    # A median's threshold may move a pixel's point and with it its shadow rays.
    for name in BUFFERS:
        wrong = np.abs(seen["main" if name == buffer else name] - getattr(truth, name)) > 2e-3
        assert wrong.mean() < 0.01, name
    assert buffer not in seen
    np.testing.assert_allclose(seen["A"], truth.mask, atol=1e-4)
    np.testing.assert_array_equal(seen["A"], seen["opacity"])
    assert (truth.irradiance < 0.9 * truth.unshadowed)[truth.mask > 0.9].any()
    assert (truth.lit > 1.02 * truth.shadowed)[truth.mask > 0.9].any()


def test_choices_about_bounced_light_are_the_librarys(surfels, light) -> None:
    chosen = {"bounces": 1, "reflections": 4, "brdf": "lambert"}
    integrator = plugin(surfels, buffer="lit", **chosen)
    seen = channels(mi.render(scene_of(light.to_mitsuba()), integrator=integrator), integrator)["main"]
    assert (np.abs(seen - ours(surfels, light, **chosen).lit) > 5e-3).mean() < 0.02
    assert (np.abs(seen - ours(surfels, light).lit) > 5e-3).mean() > 0.1, "the choices change nothing"
    integrator = plugin(surfels, bounces=0)
    seen = channels(mi.render(scene_of(light.to_mitsuba()), integrator=integrator), integrator)
    np.testing.assert_array_equal(seen["lit"], seen["shadowed"])


def test_transport_is_traced_once_and_light_baked_once(variant: str, surfels, light, monkeypatch) -> None:
    calls: list[str] = []
    for name in ("trace", "direct"):
        plain = getattr(BounceTransport, name)

        def counted(*args: Any, name: str = name, plain: Any = plain, **named: Any) -> Any:
            calls.append(name)
            return plain(*args, **named)

        monkeypatch.setattr(BounceTransport, name, counted)
    scene, integrator = scene_of(light.to_mitsuba()), plugin(surfels)
    parameters, emitter = mi.traverse(integrator), mi.traverse(scene)

    def lit() -> np.ndarray:
        return channels(mi.render(scene, integrator=integrator), integrator)["lit"]

    first = lit()
    # A GPU adds in no fixed order.
    np.testing.assert_allclose(lit(), first, rtol=0, atol=1e-6 if variant.startswith("cuda") else 0)
    assert calls == ["trace", "direct"]
    emitter["light.scale"] = 2.0
    emitter.update()
    np.testing.assert_allclose(lit(), 2 * first, rtol=1e-3, atol=1e-3)
    assert calls == ["trace", "direct", "direct"]
    parameters["base_color"] = mi.Float(np.array(parameters["base_color"]) * 0.5)
    parameters.update()
    assert lit().mean() < 1.9 * first.mean()
    assert calls == ["trace", "direct", "direct"], "what is met does not depend on materials"
    parameters["means"] = mi.Float(np.array(parameters["means"]) + np.float32(0.01))
    parameters.update()
    lit()
    assert calls == ["trace", "direct", "direct", "trace", "direct"]


def test_many_rays_a_pixel_average_the_same_light(surfels, light) -> None:
    integrator = plugin(surfels, shadow_rays=16, buffer="irradiance")
    described = mitsuba_sensor(CAMERA, pixel_format="rgba")
    scene = mi.load_dict({"type": "scene", "sensor": described, "light": light.to_mitsuba()})
    seen = channels(mi.render(scene, integrator=integrator, spp=64), integrator)["main"]
    fine = render_guidance(
        SurfelTracer(surfels), CAMERA.resized(36 * 8, 24 * 8), Lighting(light), Estimation(rays=16), 0
    )
    truth = fine.irradiance.reshape(24, 8, 36, 8, 3).mean((1, 3))
    assert np.sqrt(np.mean((seen - truth) ** 2)) < 0.05 * truth.mean()
    assert abs(seen.mean() / truth.mean() - 1) < 0.01


@pytest.mark.parametrize("kind", ["upright", "tilted", "mirrored", "sky"])
def test_the_background_is_what_mitsubas_path_tracer_shows(
    surfels, light, texture_error: float, kind: str
) -> None:
    """Orientation: the same scene without surfels, by Mitsuba itself."""
    emitter = light.to_mitsuba()
    if kind == "tilted":
        emitter["to_world"] = mi.ScalarTransform4f().rotate([1, 1, 0], 35)
    elif kind == "mirrored":
        emitter["to_world"] = emitter["to_world"] @ mi.ScalarTransform4f().scale([-1, 1, 1])
    elif kind == "sky":
        emitter = {"type": "sunsky", "to_world": mi.ScalarTransform4f().rotate([0, 1, 0], 170)}
    scene = scene_of(emitter)
    truth = np.array(mi.render(scene, integrator=mi.load_dict({"type": "path"})))[..., :3]
    integrator = plugin(surfels, shadow_rays=2)
    seen = channels(mi.render(scene, integrator=integrator), integrator)
    empty = seen["A"] == 0
    assert empty.mean() > 0.2
    assert truth[empty].std() > 0.05 * truth[empty].mean()
    limit = 1e-3 + texture_error if kind == "upright" else 0.02  # of resampling
    assert np.abs(seen["main"] - truth)[empty].mean() < limit * truth[empty].mean()
    if kind != "upright":
        return
    np.testing.assert_allclose(
        seen["main"][empty], truth[empty], rtol=1e-3, atol=1e-3 + texture_error * np.ptp(light.image)
    )


@pytest.mark.parametrize("rotation", [0.0, 90.0, 33.3, -120.0])
def test_an_upright_envmap_is_read_texel_by_texel(variant: str, light, rotation: float) -> None:
    turned = EnvironmentMap(light.image, rotation)
    scene = scene_of({**turned.to_mitsuba(), "scale": 2.0})
    read = environment_of(scene)
    np.testing.assert_allclose(read.image, 2 * light.image, rtol=1e-6)
    assert (read.rotation_deg - rotation) % 360 == pytest.approx(0, abs=1e-3) or (
        read.rotation_deg - rotation
    ) % 360 == pytest.approx(360, abs=1e-3)


@pytest.mark.parametrize("row,column", [(0, 5), (3, 0), (7, 31), (11, 9)])
def test_a_one_hot_light_stands_where_the_plugin_shows_it(
    variant: str, texture_error: float, row: int, column: int
) -> None:
    image = np.zeros((16, 32, 3), np.float32)
    image[row, column] = (1.0, 2.0, 3.0)
    scene = scene_of(EnvironmentMap(image, 25.0).to_mitsuba())
    d = generator(0, "directions").normal(size=(20000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    si = dr.zeros(mi.SurfaceInteraction3f, len(d))
    si.wi = -mi.Vector3f(d.T.astype(np.float32).copy())
    truth = np.array(scene.environment().eval(si)).T
    assert truth.max() > 0.1
    np.testing.assert_allclose(
        environment_of(scene).lookup(d), truth, atol=1e-4 + texture_error * np.ptp(image)
    )


def test_a_constant_emitter_is_a_constant_map(variant: str) -> None:
    scene = scene_of({"type": "constant", "radiance": {"type": "rgb", "value": [0.5, 1.0, 2.0]}})
    np.testing.assert_allclose(environment_of(scene).mean(), (0.5, 1, 2), rtol=1e-5)


def test_a_change_of_the_scenes_light_is_seen(surfels, light) -> None:
    scene, integrator = scene_of(light.to_mitsuba()), plugin(surfels)
    before = np.array(mi.render(scene, integrator=integrator))[..., :3]
    np.testing.assert_array_equal(before, np.array(mi.render(scene, integrator=integrator))[..., :3])
    parameters = mi.traverse(scene)
    parameters["light.scale"] = 3.0
    parameters.update()
    after = np.array(mi.render(scene, integrator=integrator))[..., :3]
    np.testing.assert_allclose(after, 3 * before, rtol=1e-3, atol=1e-3)


def test_a_given_environment_takes_the_place_of_the_scenes(surfels, light, tmp_path) -> None:
    light = light.baked()
    light.save(tmp_path / "light.exr")
    scene = scene_of({"type": "constant"})
    truth = ours(surfels, light).pbr
    for given in (integrators.embed(light), str(tmp_path / "light.exr")):
        integrator = plugin(surfels, environment=given)
        seen = channels(mi.render(scene, integrator=integrator), integrator)["main"]
        assert (np.abs(seen - truth) > 2e-3).mean() < 0.01


STEP = 0.001
"""Small: lookups are linear between texels, levels and the table's nodes. Sums are in float64 therefore."""


@pytest.mark.parametrize("buffer", [pytest.param("pbr", marks=pytest.mark.long), "lit"])
def test_gradients_of_materials_are_the_finite_differences(surfels, light, buffer: str) -> None:
    """Of lit also through the light that surfels send to one another; shadow rays are the same for both."""
    integrator, scene = plugin(surfels, buffer=buffer), scene_of(light.to_mitsuba())
    parameters = mi.traverse(integrator)
    weight = generator(0, "tests", "weight").normal(size=(24, 36, 3)).astype(np.float32)
    parameters["roughness"] = mi.Float(
        np.full(len(surfels), 0.3, np.float32)
    )  # the levels have a kink at 0.5, the table one at each of its nodes
    # Between the two F0 that lobes are fitted for: at metallic 0 their parts have a kink.
    parameters["metallic"] = mi.Float(np.full(len(surfels), 0.3, np.float32))

    def loss(**seeds: int) -> mi.TensorXf:
        image = mi.render(scene, parameters, integrator=integrator, spp=1, **seeds)
        return dr.sum(mi.TensorXf(weight) * image[..., :3], axis=None)

    # The levels and the table are linear between their entries.
    for name, within in (("base_color", 0.02), ("metallic", 0.02), ("roughness", 0.05)):
        start = np.array(parameters[name])
        towards = generator(1, "tests", name).normal(size=start.shape)
        ends = []
        for sign in (1, -1):
            parameters[name] = mi.Float((start + sign * STEP * towards).astype(np.float32))
            parameters.update()
            image = mi.render(scene, parameters, integrator=integrator, spp=1, seed=1)
            ends.append(float((np.array(image, np.float64)[..., :3] * weight).sum()))
        parameters[name] = mi.Float(start)
        dr.enable_grad(parameters[name])
        parameters.update()
        dr.backward(loss(seed=0, seed_grad=1))
        found = np.array(dr.grad(parameters[name]), np.float64) @ towards
        assert found == pytest.approx((ends[0] - ends[1]) / (2 * STEP), rel=within, abs=0.1), name
        dr.disable_grad(parameters[name])
        parameters.update()


def test_the_papers_estimate_is_the_librarys(surfels, light) -> None:
    paper = Estimation(rays=16, estimator="plain", two_sided=False)
    wanted = render_guidance(SurfelTracer(surfels), CAMERA, Lighting(light), paper, 0).irradiance
    integrator = plugin(surfels, buffer="irradiance", estimator="plain", two_sided=False)
    seen = channels(mi.render(scene_of(light.to_mitsuba()), integrator=integrator), integrator)["main"]
    assert (np.abs(seen - wanted) > 2e-3).mean() < 0.01
    assert np.abs(ours(surfels, light).irradiance - wanted).max() > 0.1, "the choice changes nothing"


def test_mistakes_are_named(surfels, tmp_path) -> None:
    for given, complaint in (
        ({"buffer": "albedo"}, "choose one of pbr, irradiance, unshadowed, shadowed"),
        ({"estimator": "median"}, "choose ratio or plain"),
        ({"brdf": "velvet"}, "choose conserving or lambert"),
        ({"bounces": -1}, "give 0 to 16"),
        ({"shadow_rays": 3}, "an even number"),
        ({"environment": str(tmp_path / "missing.exr")}, "missing.exr"),
        ({"environment": integrators.embed(surfels)}, "no EnvironmentMap"),
    ):
        with pytest.raises(RuntimeError) as error:
            plugin(surfels, **given)
        assert complaint in str(error.value).splitlines()[-1]
    with pytest.raises(RuntimeError) as error:
        mi.render(scene_of(None), integrator=plugin(surfels))
    assert isinstance(error.value.__cause__, TronError)
    assert "envmap" in str(error.value.__cause__)
