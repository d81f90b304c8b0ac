"""Scans as their own viewer shows them, held against a float64 rasteriser of 3DGS that shares no code."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from eval.applications.splat_rasteriser import rasterise
from tron import seeds
from tron.cameras import Camera
from tron.gaussians.edit import removed, subset
from tron.gaussians.projections import PROJECTIONS
from tron.gaussians.scene import GaussianScene, quats_from_normals
from tron.gaussians.splat_files import write_splats
from tron.tracing import SurfelTracer
from tron.tracing.gbuffer import GBuffer
from tron.tracing.parameters import SurfelParameters

pytestmark = pytest.mark.usefixtures("variant")

CAMERA = Camera.look_at((0.3, -4, 0.6), (0, 0, 0), fov_deg=40, width=75, height=62)
SPLATS = [name for name, projection in PROJECTIONS.items() if projection and not projection.larger]


def scan(random_scene, count: int = 400, projection: str = "3dgs", **changed) -> GaussianScene:
    """Splats from round to flat and to needles, of a fifth of a pixel to twenty."""
    scene = random_scene(count)
    rng = seeds.generator(0, "tests", "projected", count)
    changed = {"log_scales": np.log(rng.uniform(0.01, 0.2, (count, 2)))} | changed
    thinner = np.log(np.where(rng.uniform(size=count) < 0.2, 1e-9, rng.uniform(0.05, 1, count)))
    changed = {"log_thickness": np.min(changed["log_scales"], axis=1) + thinner} | changed
    return replace(scene, oriented=False, projection=projection, **changed)


def seen(scene: GaussianScene, camera: Camera = CAMERA) -> GBuffer:
    return SurfelTracer(scene.facing(camera.position)).gbuffer(camera)


def truth(scene: GaussianScene, camera: Camera, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    write_splats(folder / "a.ply", scene)
    projection = PROJECTIONS[scene.projection]
    assert projection is not None
    return rasterise(folder / "a.ply", camera, projection.variance, projection.compensated)


@pytest.mark.parametrize("projection", SPLATS)
def test_the_picture_is_that_of_the_rasteriser(random_scene, tmp_path, projection):
    scene = scan(random_scene, projection=projection)
    found = seen(scene).numpy()
    image, opacity = truth(scene, CAMERA, tmp_path)
    # Left are splats that are cut there where three deviations and a tile end, at most at 3 % of an opacity.
    assert np.abs(found["opacity"] - opacity).max() < 0.03
    assert np.abs(found["rgb"] - image).mean() < 2e-4
    as_disks = seen(replace(scene, projection="disks")).numpy()
    assert np.abs(as_disks["rgb"] - image).mean() > 1e-2


@pytest.mark.parametrize("pixels", [(60.0, 90.0), (90.0, 60.0)])
def test_pixels_need_not_be_square_nor_the_axis_in_the_middle(random_scene, tmp_path, pixels):
    camera = replace(CAMERA, fx=pixels[0], fy=pixels[1], cx=30.0, cy=40.0)
    scene = scan(random_scene)
    image, _ = truth(scene, camera, tmp_path)
    assert np.abs(seen(scene, camera).numpy()["rgb"] - image).mean() < 2e-4


def test_stripes_of_a_view_are_the_view(random_scene):
    scene, tracer = scan(random_scene), None
    tracer = SurfelTracer(scene.facing(CAMERA.position))
    whole = tracer.gbuffer(CAMERA).numpy()
    for y in (0, 20, 40):
        part = tracer.gbuffer(CAMERA.window(0, y, CAMERA.width, 20)).numpy()
        for name in ("rgb", "opacity", "depth"):
            np.testing.assert_allclose(part[name], whole[name][y : y + 20], atol=2e-4)


def strings(count: int = 200) -> np.ndarray:
    """(M, 3) centres along a line that a camera at y < 0 sees across."""
    return np.stack([np.linspace(-1, 1, count), np.zeros(count), np.zeros(count)], axis=1)


def test_what_is_thinner_than_a_pixel_is_seen(random_scene, tmp_path):
    """Flat splats in a row, edge on: as disks they cover nothing."""
    means = strings()
    quats = quats_from_normals(np.tile([0.0, 0.0, 1.0], (len(means), 1)))
    values = {"means": means, "quats": quats, "opacity_logits": np.full(len(means), 4.0)}
    values["log_thickness"] = np.full(len(means), -np.inf)
    scene = scan(random_scene, len(means), log_scales=np.log(np.full((len(means), 2), 0.01)), **values)
    camera = Camera.look_at((0, -4, 0), (0, 0, 0), fov_deg=40, width=64, height=32)
    row = seen(scene, camera).numpy()["opacity"].max(0)[20:44]
    assert row.min() > 0.9
    assert seen(replace(scene, projection="disks"), camera).numpy()["opacity"].max() < 0.1
    np.testing.assert_allclose(row, truth(scene, camera, tmp_path)[1].max(0)[20:44], atol=0.02)


@pytest.mark.parametrize("projection", ["disks", "2dgs"])
def test_disks_have_no_thickness(random_scene, projection):
    thick = scan(random_scene, projection=projection)
    flat = replace(thick, log_thickness=np.empty(0))
    found, wanted = seen(thick).numpy(), seen(flat).numpy()
    for name, each in wanted.items():
        np.testing.assert_array_equal(found[name], each)


def plane(random_scene, tilt_deg: float, side: int = 40) -> GaussianScene:
    """Opaque splats that cover a plane through the origin, leaning away from the camera."""
    x, y = (each.ravel() for each in np.meshgrid(*[np.linspace(-1, 1, side)] * 2))
    lean = np.radians(tilt_deg)
    u, v = np.array([1.0, 0, 0]), np.array([0, np.sin(lean), np.cos(lean)])
    normal = np.cross(v, u)
    count = len(x)
    return scan(
        random_scene, count, means=x[:, None] * u + y[:, None] * v,
        quats=quats_from_normals(np.tile(normal, (count, 1))),
        log_scales=np.full((count, 2), np.log(2.0 / side)), opacity_logits=np.full(count, 3.0),
        log_thickness=np.full(count, np.log(0.1 / side)),
    )  # fmt: skip


@pytest.mark.parametrize("tilt_deg", [0, 50, 80])
def test_light_falls_on_the_plane_of_the_splats(random_scene, tilt_deg):
    """Splats are drawn at their centres' depths, a step for each; what is lit lies on their plane."""
    camera = Camera.look_at((0, -4, 0), (0, 0, 0), fov_deg=40, width=64, height=64)
    found = seen(plane(random_scene, tilt_deg), camera).numpy()
    lean = np.radians(tilt_deg)
    normal, along = np.array([0, -np.cos(lean), np.sin(lean)]), np.array([0, np.sin(lean), np.cos(lean)])
    rays = camera.rays()
    met = camera.position + rays * (-camera.position @ normal / (rays @ normal))[..., None]
    inside = (np.abs(met[..., 0]) < 0.8) & (np.abs(met @ along) < 0.8)
    assert inside.sum() > 100
    assert found["opacity"][inside].min() > 0.9
    height = found["position"][inside] @ normal
    assert np.quantile(np.abs(height), 0.99) < (2e-3 if tilt_deg < 60 else 1e-2)
    assert np.abs(found["lift"][inside]).max() < 4 * (2.0 / 40) / np.cos(lean)


AWKWARD = {
    "behind the camera": {"means": (0.0, -6.0, 0.0)},
    "at the camera": {"means": (0.3, -4.0, 0.6)},
    "beside the camera": {"means": (3.0, -4.0, 0.6)},
    "just before it, large": {"means": (0.3, -3.7, 0.6), "log_scales": np.log((2.0, 2.0))},
    "a thousandth of a pixel": {"log_scales": np.log((3e-5, 3e-5))},
    "the whole picture": {"log_scales": np.log((30.0, 30.0))},
    "out of all proportion": {"log_scales": (39.0, 39.0)},
    "nothing": {"log_scales": (-39.0, -39.0)},
    "a needle": {"log_scales": np.log((1.0, 1e-3))},
    "a needle at the camera": {"log_scales": np.log((10.0, 1e-2)), "means": (0.3, -3.9, 0.6)},
}


@pytest.mark.parametrize("projection", SPLATS)
@pytest.mark.parametrize("name", AWKWARD)
def test_awkward_splats_make_no_nan_and_are_drawn_as_the_rasteriser_does(
    random_scene, tmp_path, name, projection
):
    count = 60
    rng = seeds.generator(0, "tests", "awkward", name)
    values = {"means": rng.uniform(-0.5, 0.5, (count, 3))}
    values |= {key: np.tile(value, (count, 1)) for key, value in AWKWARD[name].items()}
    values["means"] = values["means"] + rng.uniform(-0.01, 0.01, (count, 3))  # none as deep as another
    scene = scan(random_scene, count, projection, **values)
    scene.spacing = 0.05
    found = seen(scene).numpy()
    assert all(np.isfinite(each).all() for each in found.values())
    assert found["opacity"].min() >= 0
    if "proportion" not in name and name != "nothing":
        image, opacity = truth(scene, CAMERA, tmp_path)
        assert np.abs(found["opacity"] - opacity).mean() < 2e-3
        assert np.abs(found["rgb"] - image).mean() < 2e-3


def test_hundreds_of_splats_as_large_as_the_picture_are_drawn(random_scene):
    scene = scan(random_scene, 300, log_scales=np.full((300, 2), np.log(20.0)))
    camera = CAMERA.resized(512, 512)
    assert np.isfinite(seen(scene, camera).numpy()["rgb"]).all()


def test_gradients_are_those_of_the_rasteriser(random_scene, tmp_path):
    """Of a random functional of the picture, by finite differences in float64."""
    scene = scan(random_scene, 30, "antialiased")
    scene = scene.facing(CAMERA.position)
    rng = seeds.generator(0, "tests", "projected", "loss")
    weights = rng.normal(size=(CAMERA.height, CAMERA.width, 3))
    parameters = SurfelParameters.from_scene(scene)
    names = ("means", "quats", "log_scales", "opacity_logits", "sh")
    for name in names:
        dr.enable_grad(getattr(parameters, name))
    view = SurfelTracer(scene, parameters=parameters).gbuffer(CAMERA)
    dr.backward(
        dr.sum(dr.sum(mi.Vector3f(weights.reshape(-1, 3).T.astype(np.float32).copy()) * view.rows().rgb))
    )
    step = 1e-4  # few cuts are crossed

    def loss(moved: GaussianScene) -> float:
        return float((truth(moved, CAMERA, tmp_path)[0] * weights).sum())

    for name in names:
        gradient = np.array(dr.grad(getattr(parameters, name)))
        assert np.isfinite(gradient).all()
        direction = gradient / np.linalg.norm(gradient)
        shift = (step * direction).reshape(getattr(scene, name).shape).astype(np.float32)
        ends = [loss(replace(scene, **{name: getattr(scene, name) + k * shift})) for k in (1, -1)]
        expected = (ends[0] - ends[1]) / (2 * step)
        assert np.linalg.norm(gradient) == pytest.approx(expected, rel=0.02), (
            name
        )  # cuts are not differentiated


def test_the_projection_stays_with_the_scene(random_scene, tmp_path):
    scene = scan(random_scene, projection="mip")
    scene.save(tmp_path / "a.ply")
    half = np.arange(len(scene)) % 2 == 0
    kept = (GaussianScene.load(tmp_path / "a.ply"), subset(scene, half), removed(scene, half))
    assert {each.projection for each in (*kept, scene.upright(), scene.facing(np.zeros(3)))} == {"mip"}
    with pytest.raises(Exception, match="projection is fisheye"):
        replace(scene, projection="fisheye").validate()
