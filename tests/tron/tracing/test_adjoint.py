"""Gradients from pixels to every parameter of a scene, against differences of the float64 reference."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tron import seeds
from tron.cameras import Camera
from tron.errors import TronError
from tron.gaussians.fields import PARAMETERS
from tron.tracing import Surface, SurfelTracer, reference
from tron.tracing.gbuffer import trace_gbuffer
from tron.tracing.hierarchy.bvh import build_bvh
from tron.tracing.parameters import SurfelParameters, pack
from tron.tracing.tiled.tiles import build_tiles
from tron.tracing.tracer import trace_rays

pytestmark = pytest.mark.usefixtures("variant")

CAMERA = Camera.look_at((2.0, 0.7, 0.5), (0, 0, 0), fov_deg=50, width=21, height=14)
STEP = 1e-6
FIELDS = ("rgb", "opacity", "base_color", "roughness", "metallic", "normal", "position")


def differentiable(scene) -> SurfelParameters:
    parameters = SurfelParameters.from_scene(scene)
    for name in PARAMETERS:
        dr.enable_grad(getattr(parameters, name))
    return parameters


def render(parameters: SurfelParameters, camera: Camera = CAMERA) -> Surface:
    records = pack(parameters)
    return trace_gbuffer(records, build_tiles(records.detached(), camera), camera).rows()


def in_float64(scene) -> SimpleNamespace:
    arrays = {name: getattr(scene, name).astype(np.float64) for name in PARAMETERS}
    return SimpleNamespace(**arrays, kernel_degree=scene.kernel_degree, spacing=scene.spacing)


def camera_rays(camera: Camera = CAMERA) -> tuple[np.ndarray, np.ndarray]:
    directions = camera.rays().reshape(-1, 3)
    return np.tile(camera.position, (len(directions), 1)), directions


def surface_fields(truth: reference.ReferenceHits, origins, directions) -> dict[str, np.ndarray]:
    """Normalised fields of the reference, written again."""
    opacity = 1 - truth.transmittance
    some = np.maximum(opacity, 1e-9)
    distance = np.where(truth.median_depth > 0, 0.0, truth.mean_depth / some)  # the median is a constant
    length = np.maximum(np.linalg.norm(truth.normal, axis=1), 1e-9)
    return {
        "rgb": truth.rgb,
        "opacity": opacity,
        "base_color": truth.base_color / some[:, None],
        "roughness": truth.roughness / some,
        "metallic": truth.metallic / some,
        "normal": truth.normal / length[:, None],
        "position": origins + distance[:, None] * directions,
    }


class Loss:
    """A random linear functional of every differentiable field, over pixels that stand near no threshold."""

    def __init__(self, scene, camera: Camera = CAMERA) -> None:
        self.rays, self.camera = camera_rays(camera), camera
        truth = reference.composite(scene, *self.rays)
        opacity = 1 - truth.transmittance
        length = np.linalg.norm(truth.normal, axis=1)
        self.kept = (truth.margin > 1e-4) & (truth.gap > 1e-5) & (opacity > 0.05) & (length > 0.05)
        assert self.kept.mean() > 0.3
        rng = seeds.generator(0, "tests", "loss")
        fields = surface_fields(truth, *self.rays)
        self.weights = {
            name: rng.normal(size=fields[name].shape)
            * (self.kept if fields[name].ndim == 1 else self.kept[:, None])
            for name in FIELDS
        }

    def reference(self, scene) -> float:
        fields = surface_fields(reference.composite(scene, *self.rays), *self.rays)
        return sum(float((self.weights[name] * fields[name]).sum()) for name in FIELDS)

    def traced(self, seen: Surface) -> mi.Float:
        total = mi.Float(0)
        for name in FIELDS:
            weight, value = self.weights[name].astype(np.float32), getattr(seen, name)
            if weight.ndim == 1:
                total += dr.sum(mi.Float(weight) * value)
            else:
                total += dr.sum(dr.sum(mi.Vector3f(weight.T.copy()) * mi.Vector3f(value)))
        return total


def difference(loss: Loss, scene: SimpleNamespace, name: str, entry: int) -> float:
    values = getattr(scene, name)
    results = []
    for sign in (1, -1):
        moved = values.copy()
        moved.flat[entry] += sign * STEP
        results.append(loss.reference(SimpleNamespace(**{**vars(scene), name: moved})))
    return (results[0] - results[1]) / (2 * STEP)


def assert_gradients(scene, loss: Loss, parameters: SurfelParameters, names, entries: int = 16) -> None:
    truth = in_float64(scene)
    for name in names:
        gradient = np.array(dr.grad(getattr(parameters, name)))
        assert np.isfinite(gradient).all()
        touched = np.flatnonzero(gradient)
        assert len(touched) > 0, name
        rng = seeds.generator(0, "tests", "entries", name)
        chosen = rng.choice(touched, min(entries, len(touched)), replace=False)
        expected = [difference(loss, truth, name, entry) for entry in chosen]
        scale = np.abs(expected).max()
        np.testing.assert_allclose(gradient[chosen], expected, atol=1e-3 * scale, rtol=1e-3, err_msg=name)


@pytest.mark.parametrize("degree", [2, 4])
@pytest.mark.parametrize("sh_degree", [0, 3])
def test_gradients_of_every_parameter_agree_with_float64_differences(random_scene, degree, sh_degree):
    scene = random_scene(50, degree=degree, sh_degree=sh_degree)
    loss, parameters = Loss(scene), differentiable(scene)
    dr.backward(loss.traced(render(parameters)))
    assert_gradients(scene, loss, parameters, PARAMETERS)


def test_gradients_beyond_the_hit_list_agree_with_float64_differences(disks):
    rng = seeds.generator(0, "tests", "crowd")
    heights = rng.permutation(np.linspace(-0.3, 0.3, 120))
    means = np.column_stack([rng.uniform(-0.2, 0.2, (120, 2)), heights])
    scene = disks(means, [False] * 120, opacity=0.02, sigma=0.4)
    camera = Camera.look_at((0.1, 0.1, 2), (0, 0, 0), up=(0, 1, 0), fov_deg=20, width=6, height=5)
    assert reference.composite(scene, *camera_rays(camera)).hits.min() > 64
    loss, parameters = Loss(scene, camera), differentiable(scene)
    dr.backward(loss.traced(render(parameters, camera)))
    assert_gradients(
        scene, loss, parameters, ("means", "quats", "log_scales", "opacity_logits", "base_color"), 8
    )


@pytest.mark.parametrize("sh_degree", [1, 3])
def test_gradient_by_the_view_direction_of_harmonics(random_scene, sh_degree):
    scene = random_scene(60, sh_degree=sh_degree)
    origins, directions = camera_rays()
    truth = reference.composite(scene, origins, directions)
    kept = truth.margin > 1e-4
    weights = seeds.generator(0, "tests", "view").normal(size=truth.rgb.shape) * kept[:, None]
    records = pack(SurfelParameters.from_scene(scene))
    direction = mi.Vector3f(directions.T.copy())
    dr.enable_grad(direction)
    origin = mi.Point3f([float(v) for v in CAMERA.position])
    seen = trace_rays(records, build_bvh(records), origin, direction, mi.Bool(True))
    dr.backward(dr.sum(dr.sum(mi.Vector3f(weights.T.astype(np.float32).copy()) * mi.Vector3f(seen.rgb))))
    gradient = np.array(dr.grad(direction)).T
    for axis in range(3):
        ends = []
        for sign in (1, -1):
            views = directions.astype(np.float64)
            views[:, axis] += sign * STEP
            ends.append((reference.composite(scene, origins, directions, views).rgb * weights).sum(1))
        expected = (ends[0] - ends[1]) / (2 * STEP)
        assert np.abs(expected).max() > 0.1
        np.testing.assert_allclose(gradient[:, axis], expected, atol=1e-3)


def test_rays_of_any_kind_have_the_gradients_of_camera_rays(random_scene):
    scene = random_scene(80)
    loss = Loss(scene)
    by_tiles, by_hierarchy = differentiable(scene), differentiable(scene)
    dr.backward(loss.traced(render(by_tiles)))
    records = pack(by_hierarchy)
    origin = mi.Point3f([float(v) for v in CAMERA.position])
    direction = mi.Vector3f(camera_rays()[1].T.copy())
    seen = trace_rays(records, build_bvh(records.detached()), origin, direction, mi.Bool(True))
    dr.backward(loss.traced(seen))
    for name in PARAMETERS:
        first, second = (np.array(dr.grad(getattr(p, name))) for p in (by_tiles, by_hierarchy))
        np.testing.assert_allclose(first, second, atol=1e-4 * np.abs(first).max(), err_msg=name)


def test_where_alpha_is_clipped_opacity_has_no_gradient(disks):
    parameters = differentiable(disks([[0, 0, 0]], [False], opacity=0.9999, sigma=0.3))
    camera = Camera.look_at((0, 0, 1), (0, 0, 0), up=(0, 1, 0), fov_deg=1, width=3, height=3)
    dr.backward(dr.sum(render(parameters, camera).opacity))
    for name in PARAMETERS:
        assert np.abs(np.array(dr.grad(getattr(parameters, name)))).max() == 0


def test_empty_pixels_give_zero_and_not_nan(disks):
    parameters = differentiable(disks([[0, 0, 0]], [True], opacity=0.9, sigma=0.3))  # its back is seen
    seen = render(parameters)
    dr.backward(dr.sum(seen.position.x + seen.normal.x + seen.roughness + seen.rgb.x + seen.base_color.x))
    for name in PARAMETERS:
        assert (np.array(dr.grad(getattr(parameters, name))) == 0).all()


def test_a_gradient_step_compiles_no_new_kernel(random_scene, kernels_of):
    scene = random_scene(80, sh_degree=1)

    def step(camera: Camera, scale: float) -> None:
        parameters = SurfelParameters.from_scene(scene)
        parameters.means = parameters.means * dr.opaque(mi.Float, scale)
        dr.eval(parameters.means)
        for name in PARAMETERS:
            dr.enable_grad(getattr(parameters, name))
        dr.backward(dr.sum(render(parameters, camera).rgb.x))
        dr.eval([dr.grad(getattr(parameters, name)) for name in PARAMETERS])

    views = [Camera.look_at((2, y, 1), (0, 0, 0), fov_deg=40, width=16, height=12 + 8 * y) for y in (0, 1, 2)]
    first = kernels_of(lambda: step(views[0], 1.0))
    assert first
    for k, view in enumerate(views[1:]):
        assert kernels_of(lambda view=view, k=k: step(view, 1.1 + k)) <= first, "compiled anew"


def test_without_gradients_nothing_more_is_done(random_scene):
    def kernels(parameters: SurfelParameters) -> int:
        records = pack(parameters)
        lists = build_tiles(records.detached(), CAMERA)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            trace_gbuffer(records, lists, CAMERA)
            return len([entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT])

    scene = random_scene(30)
    assert kernels(SurfelParameters.from_scene(scene)) == kernels(differentiable(scene))


def test_shadows_have_no_gradient(disks):
    scene = disks([[0, 0, 0.5]], [True], opacity=0.5, sigma=0.3)
    tracer = SurfelTracer(scene, parameters=differentiable(scene))
    through = tracer.transmittance(mi.Point3f(0, 0, 0), mi.Vector3f(0, 0, 1))
    assert 0 < float(through[0]) < 1
    assert not dr.grad_enabled(through)


def test_gradients_come_as_often_as_they_are_asked_for(random_scene):
    scene = random_scene(60)
    parameters = differentiable(scene)
    tracer = SurfelTracer(scene, parameters=parameters)
    camera = Camera.look_at((2.5, 1, 0.7), (0, 0, 0), fov_deg=50, width=12, height=8)
    gradients = []
    for _ in range(3):
        dr.backward(dr.sum(tracer.gbuffer(camera).opacity))
        gradients.append(np.array(dr.grad(parameters.opacity_logits)))
        dr.clear_grad(parameters.opacity_logits)
    assert np.abs(gradients[0]).max() > 0
    np.testing.assert_allclose(gradients[1], gradients[0], rtol=1e-5)
    np.testing.assert_allclose(gradients[2], gradients[0], rtol=1e-5)


def test_a_tracer_follows_its_parameters(random_scene):
    scene = random_scene(60)
    parameters = SurfelParameters.from_scene(scene)
    tracer = SurfelTracer(scene, parameters=parameters)
    camera = Camera.look_at((2.5, 1, 0.7), (0, 0, 0), fov_deg=50, width=12, height=8)
    moved = dataclasses.replace(scene, means=scene.means + np.float32([0.1, -0.2, 0.3]))
    parameters.means = mi.Float(moved.means.ravel())
    tracer.update()
    expected = SurfelTracer(moved).gbuffer(camera).numpy()
    np.testing.assert_allclose(tracer.gbuffer(camera).numpy()["rgb"], expected["rgb"], atol=1e-6)
    with pytest.raises(TronError, match="follows parameters"):
        tracer.moved(moved)
