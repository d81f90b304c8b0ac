"""Scans of 2DGS as its own rasteriser draws them, held against its formula in float64."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tron import seeds
from tron.cameras import Camera
from tron.gaussians.harmonics import eval_sh
from tron.gaussians.scene import GaussianScene, quats_from_normals
from tron.tracing import SurfelTracer
from tron.tracing.parameters import SurfelParameters
from tron.tracing.reference import rotation_matrices

pytestmark = pytest.mark.usefixtures("variant")

CAMERA = Camera.look_at((0.3, -4, 0.6), (0, 0, 0), fov_deg=40, width=75, height=62)


def rasterised(
    scene: GaussianScene | SimpleNamespace,
    camera: Camera = CAMERA,
    counted: dict[int, np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(H, W, 3) display values over black, (H, W) opacity and mean distance: Huang et al. 2024, eq. 7 to 12.

    Planes of a pixel's column and row, brought to the splat's frame, cross in (u, v). ``counted``: pixels in
    which each splat is drawn; those that it does not name are found, and noted there.
    """
    position, scales = scene.means.astype(float), np.exp(scene.log_scales.astype(float))
    axes = rotation_matrices(scene.quats.astype(float))
    pixels = np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]])
    view = pixels @ camera.world_to_camera[:3]
    opacity = 1 / (1 + np.exp(-scene.opacity_logits.astype(float)))
    toward = position - camera.position
    colors = eval_sh(scene.sh.astype(float), toward / np.linalg.norm(toward, axis=1, keepdims=True))
    depth = (camera.world_to_camera[:3] @ np.c_[position, np.ones(len(position))].T)[2]
    x, y = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    image, through = np.zeros((camera.height, camera.width, 3)), np.ones((camera.height, camera.width))
    distance, slant = (
        np.zeros_like(through),
        np.hypot(1, np.hypot((x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy)),
    )
    for i in np.argsort(depth):
        if depth[i] < 0.2:
            continue
        to_world = np.zeros((4, 3))
        to_world[:3] = np.c_[scales[i, 0] * axes[i, :, 0], scales[i, 1] * axes[i, :, 1], position[i]]
        to_world[3, 2] = 1
        rows = view @ to_world  # of (u, v, 1) to (x w, y w, w)
        crossed = np.cross(x[..., None] * rows[2] - rows[0], y[..., None] * rows[2] - rows[1])
        with np.errstate(all="ignore"):
            u, v = crossed[..., 0] / crossed[..., 2], crossed[..., 1] / crossed[..., 2]
            met = u * rows[2, 0] + v * rows[2, 1] + rows[2, 2]
            disk = np.where(met > 0, u**2 + v**2, np.inf)
        middle = rows[:2, 2] / rows[2, 2]
        filtered = ((x - middle[0]) ** 2 + (y - middle[1]) ** 2) / 0.5
        alpha = np.minimum(opacity[i] * np.exp(-0.5 * np.fmin(disk, filtered)), 0.99)
        drawn = {} if counted is None else counted
        alpha *= drawn.setdefault(int(i), (alpha >= 1 / 255) & (through > 1e-3))
        image += (through * alpha)[..., None] * colors[i]
        distance += through * alpha * depth[i] * slant
        through *= 1 - alpha
    return image, 1 - through, distance / np.maximum(1 - through, 1e-12)


def scan(random_scene, count: int = 300, **changed) -> GaussianScene:
    """Splats with deviations of a twenty-fifth of a pixel to five, seen from all sides."""
    rng = seeds.generator(0, "tests", "2dgs", count)
    changed = {"log_scales": np.log(10 ** rng.uniform(-2.7, -0.6, (count, 2)))} | changed
    return replace(random_scene(count), oriented=False, projection="2dgs", **changed)


def seen(scene: GaussianScene, camera: Camera = CAMERA) -> dict[str, np.ndarray]:
    return SurfelTracer(scene.facing(camera.position)).gbuffer(camera).numpy()


def test_the_picture_is_that_of_the_formula(random_scene):
    scene = scan(random_scene)
    found, (image, opacity, _) = seen(scene), rasterised(scene)
    np.testing.assert_allclose(found["opacity"], opacity, atol=5e-3)
    assert np.abs(found["rgb"] - image).mean() < 1e-4
    without = seen(replace(scene, projection="disks"))
    assert np.abs(without["rgb"] - image).mean() > 3e-3


def test_hundreds_before_one_pixel_are_all_drawn(random_scene):
    count = 300
    rng = seeds.generator(0, "tests", "2dgs", "crowd")
    scene = scan(
        random_scene, count,
        means=rng.normal(size=(count, 1)) * CAMERA.position / 8 + rng.normal(0, 0.005, (count, 3)),
        opacity_logits=np.full(count, -3.3), log_scales=np.full((count, 2), np.log(1e-3)),
    )  # fmt: skip
    found, (image, opacity, _) = seen(scene), rasterised(scene)
    assert opacity.max() > 0.95  # 80 hits of at most 0.036
    np.testing.assert_allclose(found["opacity"], opacity, atol=5e-3)
    assert np.abs(found["rgb"] - image).max() < 2e-2


AWKWARD = {
    "behind the camera": {"means": (0.0, -6.0, 0.0)},
    "at the camera": {"means": (0.3, -4.0, 0.6)},
    "beside the camera": {"means": (3.0, -4.0, 0.6)},
    "just before it, large": {"means": (0.3, -3.5, 0.6), "log_scales": np.log((0.2, 0.2))},
    "a thousandth of a pixel": {"log_scales": np.log((3e-5, 3e-5))},
    "the whole picture": {"log_scales": np.log((30.0, 30.0))},
    "out of all proportion": {"log_scales": (39.0, 39.0)},
    "nothing": {"log_scales": (-39.0, -39.0)},
    "a needle": {"log_scales": np.log((1.0, 1e-3))},
    "edge on": {"means": (0.0, 0.0, 0.6), "quats": (1.0, 0.0, 0.0, 0.0)},
}


@pytest.mark.parametrize("name", AWKWARD)
def test_awkward_splats_make_no_nan_and_are_drawn(random_scene, name):
    count = 60
    rng = seeds.generator(0, "tests", "2dgs", name)
    values = {"means": rng.uniform(-0.5, 0.5, (count, 3))}
    values |= {key: np.tile(value, (count, 1)) for key, value in AWKWARD[name].items()}
    if name != "edge on":
        values["means"] = values["means"] + rng.uniform(-0.01, 0.01, (count, 3))  # none as deep as another
    scene = scan(random_scene, count, **values)
    found = seen(scene)
    assert all(np.isfinite(each).all() for each in found.values())
    if "proportion" not in name:
        image, opacity, _ = rasterised(scene)
        assert np.abs(found["opacity"] - opacity).mean() < 2e-3
        assert np.abs(found["rgb"] - image).mean() < 2e-3


def test_light_falls_on_the_plane_of_the_splats(random_scene):
    """Splats are met at the depths of their centres, a step for each; what is lit lies on their plane."""
    x, y = (each.ravel() for each in np.meshgrid(*[np.linspace(-1, 1, 40)] * 2))
    normal = np.array([0, -np.cos(1.0), np.sin(1.0)])
    count = len(x)
    scene = scan(
        random_scene, count,
        means=x[:, None] * [1, 0, 0] + y[:, None] * [0, np.sin(1.0), np.cos(1.0)],
        quats=quats_from_normals(np.tile(normal, (count, 1))),
        log_scales=np.full((count, 2), np.log(0.05)), opacity_logits=np.full(count, 3.0),
    )  # fmt: skip
    camera = Camera.look_at((0, -4, 0), (0, 0, 0), fov_deg=20, width=32, height=32)
    found = seen(scene, camera)
    inside = (slice(8, 24), slice(8, 24))
    assert found["opacity"][inside].min() > 0.9
    assert np.abs(found["position"][inside] @ normal).max() < 2e-3


def test_gradients_are_those_of_the_formula(random_scene):
    """Of a random functional of picture, opacity and mean distance, by finite differences in float64."""
    # Its pixels are no small angles.
    camera = Camera.look_at((0.3, -4, 0.6), (0, 0, 0), fov_deg=40, width=25, height=20)
    scene = scan(random_scene, 40).facing(camera.position)
    rng = seeds.generator(0, "tests", "2dgs", "loss")
    counted: dict[int, np.ndarray] = {}  # which is not differentiated
    _, covered, mean = rasterised(scene, camera, counted=counted)
    parameters = SurfelParameters.from_scene(scene)
    names = ("means", "quats", "log_scales", "opacity_logits", "sh")
    for name in names:
        dr.enable_grad(getattr(parameters, name))
    view = SurfelTracer(scene, parameters=parameters).gbuffer(camera).rows()
    steady = np.abs(np.array(view.opacity).reshape(mean.shape) - covered) < 1e-4  # no splat at its cut
    assert steady.mean() > 0.98
    image, opacity, distance = (
        rng.normal(size=(channels, *mean.shape)).transpose(1, 2, 0) * steady[..., None]
        for channels in (3, 1, 1)
    )
    opacity, distance = opacity[..., 0], distance[..., 0]
    distance *= (covered > 0.1) & (covered < 0.45)  # elsewhere there is a median, which is a constant

    def flat(weights: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(weights.reshape(-1, weights.size // distance.size).T, np.float32)

    along = dr.dot(view.position - mi.Point3f([float(v) for v in camera.position]), view.direction)
    assert np.abs(np.array(along) - mean.ravel())[distance.ravel() != 0].max() < 1e-3
    loss = dr.dot(mi.Vector3f(flat(image)), mi.Vector3f(view.rgb))
    loss += mi.Float(flat(opacity)[0]) * view.opacity + mi.Float(flat(distance)[0]) * along
    dr.backward(dr.sum(loss))

    exact = {name: getattr(scene, name).astype(float) for name in names}

    def value(moved: dict[str, np.ndarray]) -> float:
        found = rasterised(SimpleNamespace(**moved), camera, counted=counted)
        return sum(float((w * each).sum()) for w, each in zip((image, opacity, distance), found, strict=True))

    for name in names:
        gradient = np.array(dr.grad(getattr(parameters, name)))
        assert np.isfinite(gradient).all()
        largest = float(np.abs(gradient).max())
        for entry in rng.permutation(np.flatnonzero(gradient))[:24]:
            shift = np.zeros_like(exact[name])
            shift.flat[entry] = 1e-5
            ends = [value({**exact, name: exact[name] + k * shift}) for k in (1, -1)]
            expected = (ends[0] - ends[1]) / 2e-5
            assert gradient[entry] == pytest.approx(expected, rel=2e-3, abs=2e-4 * largest), (name, entry)
