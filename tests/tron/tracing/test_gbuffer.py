"""Laws of camera rays: the float64 reference, closed forms, sidedness, ordering, degenerate scenes."""

from __future__ import annotations

import numpy as np
import pytest

from tron.cameras import Camera
from tron.tracing import SurfelTracer, reference

pytestmark = pytest.mark.usefixtures("variant")

DOWN = {"up": (0.0, 1.0, 0.0), "fov_deg": 30.0}


def looking_down(width: int = 9, height: int = 9) -> Camera:
    """One unit above the origin, looking at it; the middle pixel of an odd image looks straight down."""
    return Camera.look_at((0, 0, 1), (0, 0, 0), width=width, height=height, **DOWN)


def compare(scene, camera, tolerance=1e-4):
    traced = SurfelTracer(scene).gbuffer(camera).numpy()
    directions = camera.rays().reshape(-1, 3)
    truth = reference.composite(scene, np.tile(camera.position, (len(directions), 1)), directions)
    steady = truth.margin > 1e-5
    assert (~steady).mean() < 0.05  # few pixels at these sizes stand at a threshold; the rest must agree
    opacity = 1 - truth.transmittance
    flat = {name: values.reshape(len(directions), -1).squeeze() for name, values in traced.items()}
    for name, expected in {
        "opacity": opacity,
        "depth": truth.median_depth,
        "lift": truth.lift,
        "rgb": truth.rgb,
        "normal_sum": truth.normal,
        "base_color": truth.base_color,
        "roughness": truth.roughness,
        "metallic": truth.metallic,
    }.items():
        found = flat[name]
        if name in ("base_color", "roughness", "metallic"):
            found = found * (opacity if found.ndim == 1 else opacity[:, None])
        np.testing.assert_allclose(found[steady], expected[steady], atol=tolerance, err_msg=name)
    lengths = np.linalg.norm(truth.face, axis=1)
    clear = steady & (lengths > 1e-2)
    np.testing.assert_allclose(
        flat["normal"][clear], truth.face[clear] / lengths[clear, None], atol=tolerance
    )
    return truth


@pytest.mark.parametrize("degree", [2, 4])
@pytest.mark.parametrize("sh_degree", [0, 3])
def test_agrees_with_the_float64_reference(random_scene, degree, sh_degree):
    truth = compare(
        random_scene(400, degree=degree, sh_degree=sh_degree),
        Camera.look_at((2.5, 1, 0.7), (0, 0, 0), fov_deg=50, width=30, height=22),
    )
    assert truth.hits.max() > 10  # the scene is dense enough for ordering to matter


def test_ending_early_loses_no_small_surfel_in_front_of_large_ones(disks):
    # The large disks begin near the camera, come first in the list and stop the ray at t = 1; the small ones
    # begin beyond them in the list's order, and the last of these still lies in front.
    means = [[0, 0, 0.0], [0, 0, 0.001], [0.05, -0.05, 0.07], [0, 0, 0.05]]
    scene = disks(means, [False] * 4, opacity=0.99, sigma=0.3)
    scene.log_scales[2:] = np.log(0.005)
    seen = SurfelTracer(scene).gbuffer(looking_down()).numpy()
    assert seen["depth"][4, 4] == pytest.approx(0.95)


def test_agrees_for_a_camera_among_the_surfels_with_an_off_centre_principal_point(random_scene):
    look = Camera.look_at((0.1, 0.0, 0.05), (1, 0.2, 0), fov_deg=100, width=19, height=13)
    compare(random_scene(300, seed=3), Camera(20.0, 14.0, 3.0, 11.0, 19, 13, look.world_to_camera))


@pytest.mark.parametrize(("degree", "response"), [(2, np.exp(-0.5)), (4, np.exp(-1 / 18))])
def test_one_surfel_has_its_closed_form(disks, degree, response):
    scene = disks([[0, 0, 0]], [False], opacity=0.7, sigma=0.1, degree=degree)
    camera = Camera(10.0, 10.0, 0.5, 0.5, 2, 1, looking_down().world_to_camera)
    seen = SurfelTracer(scene).gbuffer(camera).numpy()
    # Pixel 0 looks through the centre; pixel 1 meets the plane 0.1 = one sigma away.
    np.testing.assert_allclose(seen["opacity"][0], [0.7, 0.7 * response], rtol=1e-5)
    np.testing.assert_allclose(
        seen["depth"][0], [1.0, np.sqrt(1.01) if 0.7 * response > 0.5 else 0.0], rtol=1e-6
    )
    np.testing.assert_allclose(seen["normal"][0], [[0, 0, 1]] * 2, atol=1e-6)
    np.testing.assert_allclose(seen["base_color"][0], np.tile(scene.base_color, (2, 1)), rtol=1e-5)


def test_alpha_is_clipped(disks):
    scene = disks([[0, 0, 0]], [False], opacity=0.9999, sigma=0.1)
    assert SurfelTracer(scene).gbuffer(looking_down()).numpy()["opacity"][4, 4] == pytest.approx(
        0.99, abs=1e-6
    )


def test_back_faces_are_invisible_to_the_camera(disks):
    seen = SurfelTracer(disks([[0, 0, 0]], [True], opacity=0.9, sigma=0.2)).gbuffer(looking_down()).numpy()
    assert seen["opacity"].max() == 0.0
    assert np.abs(seen["normal"]).max() == 0.0
    assert np.isfinite(seen["base_color"]).all()


def test_nearest_surfel_covers_the_others_and_sets_the_median(disks):
    scene = disks([[0, 0, 0.0], [0, 0, 0.5], [0, 0, 0.2]], [False] * 3, opacity=0.9, sigma=0.3)
    seen = SurfelTracer(scene).gbuffer(looking_down()).numpy()
    weights = np.array([0.9, 0.09, 0.009])
    expected = weights @ scene.base_color[[1, 2, 0]] / weights.sum()
    np.testing.assert_allclose(seen["base_color"][4, 4], expected, rtol=1e-5)
    assert seen["depth"][4, 4] == pytest.approx(0.5)
    np.testing.assert_allclose(seen["position"][4, 4], [0, 0, 0.5], atol=1e-6)


def test_without_a_median_the_point_is_at_the_mean_depth(disks):
    scene = disks([[0, 0, 0.5], [0, 0, 0.0]], [False] * 2, opacity=0.2, sigma=0.3)
    seen = SurfelTracer(scene).gbuffer(looking_down()).numpy()
    assert seen["depth"][4, 4] == 0.0
    mean = (0.2 * 0.5 + 0.16 * 1.0) / 0.36
    np.testing.assert_allclose(seen["position"][4, 4], [0, 0, 1 - mean], atol=1e-5)


def test_ties_are_ordered_by_id(disks):
    scene = disks([[0, 0, 0]] * 2, [False] * 2, opacity=0.6, sigma=0.3)
    seen = SurfelTracer(scene).gbuffer(looking_down()).numpy()
    expected = (0.6 * scene.base_color[0] + 0.24 * scene.base_color[1]) / 0.84
    np.testing.assert_allclose(seen["base_color"][4, 4], expected, rtol=1e-5)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (5, 3), (16, 8)])
def test_pixels_do_not_depend_on_where_tiles_begin(random_scene, width, height):
    scene = random_scene(200, degree=4, sh_degree=0)
    whole = Camera.look_at((2, 2, 1), (0, 0, 0), fov_deg=60, width=20, height=12)
    crop = Camera(whole.fx, whole.fy, whole.cx - 3, whole.cy - 2, width, height, whole.world_to_camera)
    tracer = SurfelTracer(scene)
    full, part = tracer.gbuffer(whole).numpy(), tracer.gbuffer(crop).numpy()
    np.testing.assert_allclose(part["rgb"], full["rgb"][2 : 2 + height, 3 : 3 + width], atol=1e-5)


def test_scene_behind_the_camera_is_not_seen(random_scene):
    camera = Camera.look_at((5, 0, 0), (9, 0, 0), fov_deg=60, width=8, height=8)
    assert SurfelTracer(random_scene(100)).gbuffer(camera).numpy()["opacity"].max() == 0.0


def test_edge_on_huge_and_tiny_surfels_stay_finite(disks):
    scene = disks([[0, 0, 0], [0.01, 0, 0.1], [0, 0.02, 0.2]], [False] * 3, opacity=0.9, sigma=0.1)
    scene.log_scales[1] = np.log(1e4)
    scene.log_scales[2] = np.log(1e-5)
    side = Camera.look_at((1, 0, 0), (0, 0, 0), fov_deg=30, width=9, height=9)
    for camera in (side, looking_down()):
        seen = SurfelTracer(scene).gbuffer(camera).numpy()
        assert all(np.isfinite(values).all() for values in seen.values())
    assert seen["opacity"].min() > 0.85  # the huge one fills the view


def test_a_new_view_compiles_no_new_kernel(random_scene, kernels_of):
    """Nor does its way to NumPy, whatever its size."""
    tracer = SurfelTracer(random_scene(60, sh_degree=0))
    views = [Camera.look_at((2, y, 1), (0, 0, 0), fov_deg=40, width=17, height=13 + 8 * y) for y in (0, 1, 2)]
    tracer.gbuffer(views[0]).numpy()
    one, other = (kernels_of(lambda view=view: tracer.gbuffer(view).numpy()) for view in views[1:])
    assert one
    assert one == other
