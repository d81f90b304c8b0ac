"""Laws of evidence over views: medians by group, exposures, colours where surfels are."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tron.cameras import Camera, mitsuba_sensor
from tron.captures import Capture, View
from tron.color import to_display
from tron.gaussians import GaussianScene
from tron.reconstruction.light.surfel_colors import (
    Observations,
    bilinear,
    grouped_median,
    mean_colors,
    observe,
)
from tron.seeds import generator
from tron.tracing import SurfelTracer


def observations(surfel: np.ndarray, view: np.ndarray, color: np.ndarray, **other) -> Observations:
    order = np.argsort(surfel, kind="stable")
    towards = np.tile([0.0, 0.0, 1.0], (len(surfel), 1))
    clipped = other.get("clipped", np.zeros(len(surfel), bool))
    return Observations(
        surfel[order],
        view[order],
        color[order],
        towards,
        clipped[order],
        int(surfel.max()) + 1,
        int(view.max()) + 1,
    )


def test_medians_by_group_are_numpy_s() -> None:
    draw = generator(0, "tests", "medians")
    group = np.sort(draw.integers(0, 40, 300))
    values = draw.normal(size=(300, 3))
    found = grouped_median(values, group, 41)
    for number in range(40):
        np.testing.assert_allclose(found[number], np.median(values[group == number], axis=0))
    assert not found[40].any()


def test_exposures_of_photos_are_found_and_colours_freed_of_them() -> None:
    draw = generator(1, "tests", "exposures")
    truth, gain = draw.uniform(0.05, 0.8, (500, 3)), np.exp(draw.normal(0, 0.2, (20, 3)))
    gain /= np.exp(np.log(gain).mean(0))
    surfel, view = (index.ravel() for index in np.meshgrid(np.arange(500), np.arange(20), indexing="ij"))
    color = truth[surfel] * gain[view]
    glare = draw.random(len(surfel)) < 0.15  # highlights and bystanders
    color[glare] *= draw.uniform(2, 5, (glare.sum(), 1))
    found = mean_colors(observations(surfel, view, color))
    np.testing.assert_allclose(np.log(found.gain), np.log(gain), atol=0.02)
    np.testing.assert_allclose(np.log(found.gain).mean(0), 0, atol=1e-6)
    assert np.median(np.abs(np.log(found.color / truth))) < 0.01
    alike = mean_colors(observations(surfel, view, color), same_exposure=True)
    assert (alike.gain == 1).all()
    assert np.median(np.abs(np.log(alike.color / truth))) > 0.02


def test_clipped_colours_say_nothing_of_exposure() -> None:
    """More than half of the surfels are white in every photo: they look alike whatever the exposure."""
    draw = generator(4, "tests", "clipped")
    truth = np.where(np.arange(500)[:, None] < 200, draw.uniform(0.05, 0.3, (500, 3)), 2.0)
    gain = np.exp(draw.normal(0, 0.2, (20, 3)))
    gain /= np.exp(np.log(gain).mean(0))
    surfel, view = (index.ravel() for index in np.meshgrid(np.arange(500), np.arange(20), indexing="ij"))
    color = truth[surfel] * gain[view]
    white = (color > 0.9).any(1)
    found = mean_colors(observations(surfel, view, np.minimum(color, 0.9), clipped=white))
    np.testing.assert_allclose(np.log(found.gain), np.log(gain), atol=0.03)
    assert np.abs(np.log(found.color[:200] / truth[:200])).max() < 0.03


def test_a_photo_of_few_surfels_is_half_believed() -> None:
    """Of 41 photos one shows twenty surfels alone, the number at which its exposure counts half."""
    draw = generator(6, "tests", "few")
    truth = draw.uniform(0.05, 0.3, (400, 3))
    surfel, view = (index.ravel() for index in np.meshgrid(np.arange(400), np.arange(41), indexing="ij"))
    shown = (view > 0) | (surfel < 20)
    surfel, view = surfel[shown], view[shown]
    color = truth[surfel] * np.where(view == 0, 2.0, 1.0)[:, None]
    gain = np.log(mean_colors(observations(surfel, view, color)).gain)
    np.testing.assert_allclose(gain[0] - gain[1:].mean(0), 0.5 * np.log(2), atol=0.02)


def test_the_spread_is_what_is_left_when_exposures_are_taken_out() -> None:
    draw = generator(5, "tests", "spread")
    noise, gain = 0.05, np.exp(draw.normal(0, 0.15, (40, 3)))
    surfel, view = (index.ravel() for index in np.meshgrid(np.arange(300), np.arange(40), indexing="ij"))
    color = 0.3 * gain[view] * np.exp(noise * draw.normal(size=(len(surfel), 1)))
    spread = mean_colors(observations(surfel, view, color)).spread
    # The median of the absolute value of a normal variable is 0.6745 of its deviation.
    assert np.median(spread) == pytest.approx(0.6745 * noise, rel=0.1)


def test_what_no_photo_shows_is_known_as_such() -> None:
    surfel = np.array([0, 0, 2])
    found = mean_colors(observations(surfel, np.array([0, 1, 1]), np.full((3, 3), 0.3)))
    assert found.seen.tolist() == [True, False, True]
    assert not found.color[1].any()


def test_bilinear_is_exact_on_a_ramp() -> None:
    y, x = np.mgrid[0:6, 0:9] + 0.5
    place = generator(2, "tests").uniform(0.5, 5.5, (50, 2))
    np.testing.assert_allclose(bilinear(2 * x - y, place), 2 * place[:, 0] - place[:, 1], atol=1e-9)


def test_surfels_are_seen_as_the_photos_show_them(painted, painted_capture) -> None:
    # The photos are the surfels' own radiance, taken here for linear: what is seen is what was painted.
    tracer = SurfelTracer(painted)
    found = observe(tracer, painted_capture.train_views, 1.0, "srgb")
    assert (np.diff(found.surfel) >= 0).all()
    from tron.color import srgb_to_linear
    from tron.gaussians.harmonics import SH_C0

    painting = srgb_to_linear(np.clip(SH_C0 * painted.sh[:, 0] + 0.5, 0, 1))
    colors = mean_colors(found, same_exposure=True)
    seen = colors.count >= 2
    error = np.abs(colors.color - painting)[seen].mean() / painting.mean()
    shuffled = np.abs(np.roll(colors.color, 7, 0) - painting)[seen].mean() / painting.mean()
    assert error < 0.08 < shuffled
    # Nothing is seen from behind.
    towards = np.einsum("nc,nc->n", painted.normals()[found.surfel], found.to_camera)
    assert towards.min() > 0.15


def in_sight(scene: GaussianScene, camera: Camera) -> np.ndarray:
    """(M,) bool: surfels of the two spheres that a camera sees from less than 78 degrees, in closed form."""
    normals, towards = scene.normals(), camera.position - scene.means
    distance = np.linalg.norm(towards, axis=1, keepdims=True)
    towards = towards / distance
    ball = np.array([[-0.6, 0, 0], [0.5, 0.1, 0.2]])[scene.object_id - 1]
    other, radius = np.array([[0.5, 0.1, 0.2], [-0.6, 0, 0]])[scene.object_id - 1], (0.4, 0.5)
    np.testing.assert_allclose(
        normals, (scene.means - ball) / np.take((0.5, 0.4), scene.object_id - 1)[:, None], atol=1e-4
    )
    offset = other - scene.means
    along = (offset * towards).sum(1)
    beside = (offset**2).sum(1) - along**2
    hidden = (along > 0) & (beside < np.take(radius, scene.object_id - 1) ** 2)
    return ((towards * normals).sum(1) > 0.2) & ~hidden


def test_surfels_are_seen_where_nothing_is_in_the_way(
    painted: GaussianScene, painted_capture: Capture
) -> None:
    tracer, views = SurfelTracer(painted), painted_capture.train_views
    found = observe(tracer, views, 1.0, "srgb")
    shows = np.zeros((len(views), len(painted)), bool)
    shows[found.view, found.surfel] = True
    sight = np.stack([in_sight(painted, view.camera) for view in views])
    assert (shows & ~sight).sum() < 0.002 * shows.sum()
    # What is left out lies within a pixel of a silhouette; pixels are a twelfth of a ball.
    assert shows.sum() > 0.46 * sight.sum()
    assert ((shows.sum(0) >= 2) | (sight.sum(0) < 2)).mean() > 0.49


def test_a_hidden_surfel_is_not_seen(painted: GaussianScene, painted_capture: Capture) -> None:
    """A ball of surfels inside the first sphere: no photo shows it, and the sphere is seen as before."""
    first = painted.object_id == 1
    means = painted.means.copy()
    means[~first] = np.array([-0.6, 0, 0]) + 0.2 * painted.normals()[~first]
    found = observe(SurfelTracer(replace(painted, means=means)), painted_capture.train_views, 1.0, "srgb")
    counts = np.bincount(found.surfel, minlength=len(painted))
    assert counts[~first].sum() < 0.01 * counts[first].sum()
    assert (counts[first] >= 2).mean() > 0.4


def test_what_is_masked_is_not_seen_and_white_is_marked(
    painted: GaussianScene, painted_capture: Capture
) -> None:
    tracer, view = SurfelTracer(painted), painted_capture.train_views[0]
    whole = observe(tracer, [view], 1.0, "srgb")
    assert not whole.clipped.any()
    assert observe(tracer, [replace(view, image=np.ones_like(view.read()))], 1.0, "srgb").clipped.all()
    right = np.zeros(view.read().shape[:2], np.float32)
    right[:, 16:] = 1
    place = view.camera.project(painted.means)[0][:, 0]
    for hidden in (replace(view, valid=right), replace(view, mask=right * view.read("mask"))):
        seen = observe(tracer, [hidden], 1.0, "srgb").surfel
        assert (place[seen] > 16).all()
        # Beside the border as beside a silhouette: one pixel of it is not seen.
        assert set(whole.surfel[place[whole.surfel] > 18]) <= set(seen)
        assert len(seen) > 0


@pytest.mark.parametrize(
    ("material", "least", "most"),
    [
        ({"type": "conductor", "material": "Ag"}, 0.2, 1.0),
        ({"type": "dielectric"}, 0.08, 1.0),
        ({"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.4}}, 0.0, 0.01),
        ({"type": "roughplastic", "alpha": 0.1}, 0.0, 0.05),
    ],
    ids=["mirror", "glass", "matt", "gloss"],
)
def test_mirrors_and_glass_change_with_the_view(
    dense_surfels, material: dict[str, Any], least: float, most: float
) -> None:
    """Balls in a light of stripes, path-traced by Mitsuba, on which the surfels lie exactly."""
    import mitsuba as mi

    ball = dense_surfels.sphere(spacing=0.09)
    stripes = np.where(np.arange(64)[None, :, None] % 16 < 8, 3.0, 0.2) * np.ones((32, 1, 3))
    light = {"type": "envmap", "bitmap": mi.Bitmap(stripes.astype(np.float32))}
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 6},
            "light": light,
            "ball": {**ball.mitsuba, "bsdf": material},
        }
    )
    views = []
    for i in range(10):
        eye = (4 * np.cos(0.63 * i), 4 * np.sin(0.63 * i), 1.0 + i % 3)
        camera = Camera.look_at(eye, (0, 0, 0), fov_deg=35, width=48, height=48)
        sensor = mi.load_dict(mitsuba_sensor(camera))
        seen = np.array(mi.render(scene, sensor=sensor, spp=16, seed=mi.UInt32(i)))[..., :3]
        views.append(View(str(i), camera, to_display(seen, 0.5).astype(np.float32), "display"))
    surfels = dense_surfels.scene(ball, spacing=0.09)
    found = mean_colors(observe(SurfelTracer(surfels), views, 1.0, "agx"))
    assert found.seen.mean() > 0.3
    assert least <= found.mirroring(surfels.means) <= most
