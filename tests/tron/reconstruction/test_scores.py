"""Laws of the figures: a perfect scene is perfect, albedo is known up to a factor, masks say what counts."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from tron.captures import View
from tron.gaussians import GaussianScene
from tron.metrics import PSNR_CAP
from tron.reconstruction.scores import (
    ViewScore,
    mean_figures,
    picture,
    score_views,
    wanted_picture,
)
from tron.seeds import generator
from tron.tracing import SurfelTracer


@pytest.fixture(scope="module")
def tracer(painted: GaussianScene) -> SurfelTracer:
    return SurfelTracer(painted)


def figures(tracer: SurfelTracer, view: View, background: str = "black") -> dict[str, float]:
    (score,) = score_views(tracer, [view], background)
    assert score.view == view.name
    return dict(score.figures)


@pytest.mark.parametrize("background", ["black", "white", "random"])
def test_a_perfect_scene_is_perfect(tracer, painted_capture, background: str) -> None:
    found = mean_figures(score_views(tracer, painted_capture.test_views, background))
    assert found["views"] == 3
    assert found["psnr"] > 60
    assert found["psnr_subject"] > 60
    assert found["ssim"] > 0.9999
    assert found["base_color_psnr"] > 60
    assert found["normal_mae_deg"] < 1e-3
    assert found["roughness_mae"] < 1e-6
    assert found["metallic_mae"] < 1e-6
    assert found["metallic_wrong"] == 0
    assert "lpips" not in found


@pytest.mark.parametrize("scale", [(0.2, 0.5, 1.0), (0.7, 0.7, 0.7)])
def test_base_color_is_judged_whatever_its_scale_in_each_channel(
    painted, painted_capture, scale: tuple[float, ...]
) -> None:
    darker = replace(painted, base_color=painted.base_color * np.array(scale, np.float32))
    tracer, view = SurfelTracer(darker), painted_capture.test_views[0]
    assert figures(tracer, view)["base_color_psnr"] > 60
    noise = generator(0, "noise").normal(size=painted.base_color.shape) * 0.2
    spoiled = replace(painted, base_color=(painted.base_color + noise).clip(0, 1))
    assert figures(SurfelTracer(spoiled), view)["base_color_psnr"] < 35


def test_figures_are_those_of_plain_sums(tracer, painted_capture) -> None:
    view = painted_capture.test_views[1]
    rng = generator(0, "photo")
    image = (view.read() + 0.1 * rng.normal(size=view.read().shape)).clip(0, 1)
    rough = (view.read("roughness") + 0.2).clip(0, 1)
    mask, opacity = view.read("mask"), tracer.gbuffer(view.camera).numpy()["opacity"]
    found = figures(tracer, replace(view, image=image, roughness=rough))
    seen = tracer.gbuffer(view.camera).numpy()["rgb"].clip(0, 1).astype(np.float64)
    wrong = (seen - mask[..., None] * image) ** 2
    assert found["psnr"] == pytest.approx(-10 * np.log10(wrong.mean()), abs=1e-3)
    assert found["psnr_subject"] == pytest.approx(-10 * np.log10(wrong[mask > 0.5].mean()), abs=1e-3)
    assert found["roughness_mae"] == pytest.approx(
        np.abs(tracer.gbuffer(view.camera).numpy()["roughness"] - rough)[opacity > 0.5].mean(), abs=1e-4
    )


def test_normals_that_are_off_by_an_angle_are_off_by_it(tracer, painted_capture) -> None:
    view, turn = painted_capture.test_views[0], np.radians(10)
    normal = view.read("normal")
    axis = np.cross(normal, (0.3, 0.5, 0.8))
    axis /= np.maximum(np.linalg.norm(axis, axis=-1, keepdims=True), 1e-9)
    turned = normal * np.cos(turn) + np.cross(axis, normal) * np.sin(turn)  # Rodrigues; the axis is across
    assert figures(tracer, replace(view, normal=turned))["normal_mae_deg"] == pytest.approx(10, abs=0.01)


def test_what_lies_outside_the_mask_counts_for_no_map(tracer, painted_capture) -> None:
    view = painted_capture.test_views[0]
    outside = view.read("mask") < 0.5
    spoiled = {}
    for name in ("normal", "base_color", "roughness", "metallic"):
        pixels = view.read(name).copy()
        pixels[outside] = 1 / np.sqrt(3)
        spoiled[name] = pixels
    assert figures(tracer, replace(view, **spoiled)) == figures(tracer, view)


def test_what_is_not_believed_counts_for_no_figure(tracer, painted_capture) -> None:
    view = painted_capture.test_views[0]
    valid = np.ones((view.camera.height, view.camera.width), np.float32)
    valid[4:14, 6:20] = 0
    spoiled = {"valid": valid}
    for name in ("image", "normal", "base_color", "roughness", "metallic"):
        spoiled[name] = view.read(name).copy()
        spoiled[name][valid == 0] = 1 / np.sqrt(3)
    judged = figures(tracer, replace(view, **spoiled))
    assert judged == figures(tracer, replace(view, valid=valid))
    assert judged["psnr"] == pytest.approx(figures(tracer, view)["psnr"], abs=3)
    assert figures(tracer, replace(view, valid=np.zeros_like(valid))) == {}


def test_a_map_that_is_exactly_right_has_a_finite_figure(tracer, painted_capture) -> None:
    """JSON has no infinity: metrics.json could not be read again."""
    view = painted_capture.test_views[0]
    found = figures(tracer, replace(view, base_color=np.zeros_like(view.read("base_color"))))
    assert found["base_color_psnr"] == PSNR_CAP
    json.dumps(found, allow_nan=False)


def test_what_a_view_lacks_is_not_measured(tracer, painted_capture) -> None:
    view = painted_capture.test_views[0]
    photo = View(view.name, view.camera, view.image, "display")
    assert set(figures(tracer, photo)) == {"psnr", "ssim"}
    empty = replace(view, mask=np.zeros((32, 32)))
    assert set(figures(tracer, empty)) == {"psnr", "ssim"}
    unknown = replace(view, normal=np.zeros((32, 32, 3)))
    assert "normal_mae_deg" not in figures(tracer, unknown)


def test_means_are_over_the_views_that_have_the_figure() -> None:
    scores = [ViewScore("a", {"psnr": 20.0, "ssim": 0.5}), ViewScore("b", {"psnr": 30.0})]
    assert mean_figures(scores) == {"views": 2, "psnr": 25.0, "ssim": 0.5}
    assert mean_figures([]) == {"views": 0}


def test_pictures_are_over_the_background_that_was_trained_with() -> None:
    buffers = {"rgb": np.full((2, 2, 3), 0.2), "opacity": np.array([[0.0, 0.5], [1.0, 1.0]])}
    np.testing.assert_allclose(picture(buffers, 1.0)[..., 0], [[1.0, 0.7], [0.2, 0.2]])
    np.testing.assert_allclose(picture(buffers)[..., 0], 0.2)


def test_the_wanted_picture_is_the_subject_alone(painted_capture) -> None:
    view = painted_capture.test_views[0]
    mask, image = view.read("mask")[..., None], view.read()
    np.testing.assert_allclose(wanted_picture(view, 1.0), mask * image + 1 - mask, atol=1e-6)
    photo = View(view.name, view.camera, view.image, "display")
    np.testing.assert_array_equal(wanted_picture(photo, 1.0), image)
