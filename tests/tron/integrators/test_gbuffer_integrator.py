"""Laws of ``tron_gbuffer``: the tracer's G-buffer by Mitsuba's sensors, gradients through ``mi.render``."""

from __future__ import annotations

import dataclasses
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tron import integrators
from tron.cameras import Camera, mitsuba_sensor
from tron.errors import TronError
from tron.gaussians.scene import GaussianScene
from tron.integrators.gbuffer import CHANNELS
from tron.seeds import generator
from tron.tracing import SurfelTracer

CENTRES = {"type": "stratified", "jitter": False, "sample_count": 1}
CAMERA = Camera.look_at((1.5, -2.5, 1.6), (0, 0, 0.3), fov_deg=45, width=36, height=24)


@pytest.fixture
def surfels(dense_surfels) -> GaussianScene:
    """A ball on a floor, every surfel of another colour."""
    spacing = 0.2
    sheets = [dense_surfels.plane(spacing, 1.2), dense_surfels.sphere(spacing, 0.5, 0.5)]
    count = sum(len(sheet.points) for sheet in sheets)
    rng = generator(0, "tests", "colours")
    integrators.register()
    return dense_surfels.scene(
        *sheets,
        spacing=spacing,
        base_color=rng.random((count, 3)),
        roughness=rng.random(count),
        metallic=rng.random(count),
        sh=0.02 * rng.normal(size=(count, 16, 3)),
    )


def plugin(scene: GaussianScene) -> mi.Integrator:
    return mi.load_dict({"type": "tron_gbuffer", "surfels": integrators.embed(scene)})


def sensor(camera: Camera = CAMERA, **film: Any) -> dict[str, Any]:
    return {**mitsuba_sensor(camera, pixel_format="rgba", **film), "sampler": CENTRES}


def scene_of(described: dict[str, Any]) -> mi.Scene:
    return mi.load_dict({"type": "scene", "sensor": described})


def render(integrator: mi.Integrator, scene: mi.Scene, **options: Any) -> dict[str, np.ndarray]:
    """Channels by the names that the film gives them, components together."""
    image = np.array(mi.render(scene, integrator=integrator, **options))
    names = [field.name for field in scene.sensors()[0].film().bitmap().struct_()]
    assert names == ["R", "G", "B", "A", *integrator.aov_names()]
    channels = {"rgb": image[..., :3], "A": image[..., 3]}
    for name, parts in CHANNELS.items():
        columns = [names.index(f"{name}.{part}") for part in parts]
        channels[name] = image[..., columns] if len(columns) > 1 else image[..., columns[0]]
    return channels


def assert_same(seen: dict[str, np.ndarray], truth: dict[str, np.ndarray], atol: float = 2e-4) -> None:
    empty = truth["opacity"] == 0
    assert 0.05 < empty.mean() < 0.9
    for name in CHANNELS:
        expected = np.where(empty if truth[name].ndim == 2 else empty[..., None], 0, truth[name])
        # At a median's threshold float32 may choose either of two hits.
        wrong = np.abs(seen[name] - expected) > atol
        assert wrong.mean() < 0.005, name
    np.testing.assert_allclose(seen["rgb"], truth["rgb"], atol=atol)
    np.testing.assert_allclose(seen["A"], truth["opacity"], atol=atol)


@pytest.mark.parametrize("centre", [(18.0, 12.0), (11.0, 19.5)])
def test_pixel_centres_of_a_pinhole_see_the_tracers_gbuffer(surfels, centre) -> None:
    camera = Camera(40.0, 40.0, *centre, 36, 24, CAMERA.world_to_camera)
    truth = SurfelTracer(surfels).gbuffer(camera).numpy()
    assert_same(render(plugin(surfels), scene_of(sensor(camera))), truth)


def test_mitsubas_own_field_of_view_and_frame(surfels) -> None:
    """A camera described in Mitsuba's words alone: vertical field of view, look_at."""
    described = {
        "type": "perspective",
        "fov_axis": "y",
        "fov": 30.0,
        "to_world": mi.ScalarTransform4f().look_at([1.5, -2.5, 1.6], [0, 0, 0.3], [0, 0, 1]),
        "near_clip": 1e-4,
        "film": {
            "type": "hdrfilm",
            "width": 36,
            "height": 24,
            "pixel_format": "rgba",
            "rfilter": {"type": "box"},
        },
        "sampler": CENTRES,
    }
    focal = 12 / np.tan(np.radians(15))
    camera = Camera(focal, focal, 18, 12, 36, 24, CAMERA.world_to_camera)
    assert_same(render(plugin(surfels), scene_of(described)), SurfelTracer(surfels).gbuffer(camera).numpy())


def test_a_crop_window_is_a_part_of_the_picture(surfels) -> None:
    crop = {"crop_offset_x": 7, "crop_offset_y": 5, "crop_width": 13, "crop_height": 11}
    integrator = plugin(surfels)
    whole = render(integrator, scene_of(sensor()))
    part = render(integrator, scene_of(sensor(**crop)))
    for name, values in part.items():
        np.testing.assert_allclose(values, whole[name][5:16, 7:20], atol=2e-4, err_msg=name)


@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
def test_jittered_rays_average_to_the_mean_over_the_pixel(surfels, rfilter) -> None:
    described = sensor(rfilter={"type": rfilter}) | {"sampler": {"type": "independent"}}
    seen = render(plugin(surfels), scene_of(described), spp=256)
    fine = SurfelTracer(surfels).gbuffer(CAMERA.resized(36 * 8, 24 * 8)).numpy()
    coarse = {
        name: fine[name].reshape(24, 8, 36, 8, -1).mean((1, 3)).squeeze() for name in ("rgb", "opacity")
    }
    limit = 0.02 if rfilter == "box" else 0.06  # Mitsuba's gaussian is half a pixel wide
    for name, values in coarse.items():
        assert np.sqrt(np.mean((seen[name] - values) ** 2)) < limit, name


def test_an_orthographic_sensor_sends_parallel_rays(surfels) -> None:
    down = mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0]).scale([1.5, 1.5, 1])
    film = {"type": "hdrfilm", "width": 30, "height": 30, "pixel_format": "rgba", "rfilter": {"type": "box"}}
    described = {"type": "orthographic", "to_world": down, "film": film, "sampler": CENTRES}
    seen = render(plugin(surfels), scene_of(described))
    inside = seen["opacity"] > 0.9
    at = (np.arange(30) + 0.5) / 10 - 1.5
    x, y = np.meshgrid(at, -at)
    # Mitsuba's cameras look along their own +z with x to the left; from above, world x runs to the right.
    np.testing.assert_allclose(seen["position"][inside][:, 0], x[inside], atol=1e-4)
    np.testing.assert_allclose(seen["position"][inside][:, 1], y[inside], atol=1e-4)
    radius = np.hypot(x, y)
    ball, floor = radius < 0.4, (radius > 0.6) & inside
    height = 0.5 + np.sqrt(np.maximum(0.25 - radius**2, 0))
    # Flat surfels, a fifth of a unit apart, on a ball of half a unit.
    assert np.abs(seen["position"][..., 2] - height)[ball].mean() < 0.06
    assert np.abs(seen["position"][floor, 2]).max() < 1e-4


def test_a_thin_lens_is_sharp_in_focus_and_blurred_elsewhere(surfels) -> None:
    def through(aperture: float, focus: float) -> np.ndarray:
        described = {key: value for key, value in sensor().items() if "principal_point" not in key}
        described |= {"type": "thinlens", "aperture_radius": aperture, "focus_distance": focus}
        described |= {"sampler": {"type": "independent"}}
        return render(plugin(surfels), scene_of(described), spp=64)["rgb"]

    pinhole = SurfelTracer(surfels).gbuffer(CAMERA.resized(36 * 8, 24 * 8)).numpy()["rgb"]
    pinhole = pinhole.reshape(24, 8, 36, 8, 3).mean((1, 3))
    distance = float(np.linalg.norm(CAMERA.position - (0, 0, 0.3)))
    narrow, focused, blurred = through(1e-4, distance), through(0.15, distance), through(0.15, 0.4)

    def error(image: np.ndarray) -> float:
        return float(np.sqrt(np.mean((image - pinhole)[8:16, 12:24] ** 2)))

    assert error(narrow) < 0.03
    assert error(focused) < 0.5 * error(blurred)


def test_surfels_come_from_a_file_too(surfels, tmp_path) -> None:
    surfels.save(tmp_path / "scene.ply")
    from_file = mi.load_dict({"type": "tron_gbuffer", "filename": str(tmp_path / "scene.ply")})
    scene = scene_of(sensor())
    assert_same(render(from_file, scene), SurfelTracer(surfels).gbuffer(CAMERA).numpy())


def test_single_rays_by_mitsubas_sample(surfels) -> None:
    camera, integrator = CAMERA, plugin(surfels)
    directions = camera.rays().reshape(-1, 3)
    ray = mi.Ray3f(mi.Point3f([float(v) for v in camera.position]), mi.Vector3f(directions.T.copy()))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, len(directions))
    color, valid, extra = integrator.sample(  # type: ignore[attr-defined]
        mi.load_dict({"type": "scene"}), sampler, ray
    )
    truth = SurfelTracer(surfels).gbuffer(camera).numpy()
    np.testing.assert_allclose(np.array(color).T.reshape(24, 36, 3), truth["rgb"], atol=2e-4)
    np.testing.assert_array_equal(np.array(valid).reshape(24, 36), truth["opacity"] > 0)
    assert len(extra) == len(integrator.aov_names())


def test_new_parameters_are_a_new_scene(surfels) -> None:
    integrator, scene = plugin(surfels), scene_of(sensor())
    parameters = mi.traverse(integrator)
    moved = surfels.means + np.array([0.3, -0.2, 0.1], np.float32)
    parameters["means"] = mi.Float(moved.ravel())
    parameters.update()
    surfels.means = moved
    assert_same(render(integrator, scene), SurfelTracer(surfels).gbuffer(CAMERA).numpy())


def test_harmonics_that_were_zero_can_be_learnt(surfels) -> None:
    flat = dataclasses.replace(surfels, sh=np.concatenate([surfels.sh[:, :1], 0 * surfels.sh[:, 1:]], 1))
    integrator, scene = plugin(flat), scene_of(sensor())
    parameters = mi.traverse(integrator)
    dr.enable_grad(parameters["sh"])
    dr.backward(dr.sum(mi.render(scene, parameters, integrator=integrator, spp=1)[..., :3], axis=None))
    gradient = np.abs(np.array(dr.grad(parameters["sh"])).reshape(-1, 16, 3)).max((0, 2))
    assert (gradient > 0).all()
    before = render(integrator, scene)["rgb"]
    coefficients = flat.sh.copy()
    coefficients[:, 1] += 0.5
    parameters["sh"] = mi.Float(coefficients.ravel())
    parameters.update()
    assert np.abs(render(integrator, scene)["rgb"] - before).max() > 0.1


def test_gradients_through_render_are_the_finite_differences(surfels) -> None:
    integrator, scene = plugin(surfels), scene_of(sensor())
    parameters = mi.traverse(integrator)
    weight = generator(0, "tests", "weight").normal(size=(24, 36, 17)).astype(np.float32)
    weight[..., 4:8] = 0  # positions and depths step where medians do

    def loss() -> mi.TensorXf:
        image = mi.render(scene, parameters, integrator=integrator, spp=1)
        return dr.sum(mi.TensorXf(weight) * image, axis=None)

    for name, step, tolerance in (
        ("base_color", 0.1, 1e-3),
        ("sh", 0.02, 1e-3),
        ("opacity_logits", 0.02, 5e-2),
    ):
        start = np.array(parameters[name])
        towards = generator(1, "tests", name).normal(size=start.shape)
        ends = []
        for sign in (1, -1):
            parameters[name] = mi.Float((start + sign * step * towards).astype(np.float32))
            parameters.update()
            ends.append(float(loss().array[0]))
        parameters[name] = mi.Float(start)
        dr.enable_grad(parameters[name])
        parameters.update()
        for _ in range(2):  # a second step needs no update in between
            dr.set_grad(parameters[name], 0)
            dr.backward(loss())
            gradient = np.array(dr.grad(parameters[name]), np.float64)
            expected = (ends[0] - ends[1]) / (2 * step)
            assert gradient @ towards == pytest.approx(expected, rel=tolerance, abs=tolerance), name
        dr.disable_grad(parameters[name])
        parameters.update()


@pytest.mark.parametrize(
    ("given", "complaint"),
    [
        ({"filename": "/nowhere/scene.ply"}, "/nowhere/scene.ply"),
        ({}, "give `filename`, a PLY, or `surfels`"),
        ({"filename": "a.ply", "surfels": 1}, "2 times"),
        ({"surfels": "a scene"}, "no GaussianScene"),
    ],
)
def test_what_is_no_scene_is_refused_with_a_way_out(variant: str, given, complaint: str) -> None:
    integrators.register()
    with pytest.raises(RuntimeError) as error:
        mi.load_dict({"type": "tron_gbuffer", **given})
    last = str(error.value).splitlines()[-1]
    assert last.startswith("TronError")
    assert complaint in last


def test_registration_asks_for_a_variant_and_can_be_repeated(variant: str, monkeypatch) -> None:
    integrators.register()
    integrators.register()
    monkeypatch.setattr(mi, "variant", lambda: "scalar_rgb")
    with pytest.raises(TronError, match="scalar_rgb"):
        integrators.register()
