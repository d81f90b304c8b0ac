"""Exposures of photos are found from what surfels show, and held at a mean of one; passers-by stand out."""

import numpy as np
import pytest
import torch

from tron.cameras import Camera
from tron.captures import View
from tron.captures.view import ToneCurve
from tron.color import agx, linear_to_srgb, srgb_to_linear
from tron.reconstruction.geometry.losses import targets
from tron.reconstruction.geometry.photo_exposure import PhotoExposures
from tron.seeds import generator

SIZE, COUNT = 32, 6


def shown(linear: np.ndarray, curve: ToneCurve) -> np.ndarray:
    return (linear_to_srgb(linear) if curve == "srgb" else agx(linear)).clip(0, 1).astype(np.float32)


def scene(curve: ToneCurve) -> tuple[list[View], np.ndarray, dict[str, torch.Tensor], np.ndarray]:
    """Photos of one picture with gains, the gains, what surfels show of it, and the picture."""
    draw = generator(0, "photo exposures")
    linear = draw.uniform(0.05, 0.6, (SIZE, SIZE, 3))
    gains = np.exp(draw.normal(0, 0.2, (COUNT, 3)))
    gains /= np.exp(np.log(gains).mean(0))
    camera = Camera.look_at((0, 0, 3), (0, 0, 0), up=(0, 1, 0), fov_deg=40, width=SIZE, height=SIZE)
    views = [
        View(f"{index}", camera, np.round(255 * shown(linear * gain, curve)) / 255, "display")
        for index, gain in enumerate(gains)
    ]
    rendered = {
        "rgb": torch.from_numpy(shown(linear, curve)),
        "opacity": torch.ones(SIZE, SIZE),
    }
    return views, gains, rendered, shown(linear, curve)


def observed(views: list[View], rendered, curve: ToneCurve, rounds: int = 6) -> PhotoExposures:
    exposures = PhotoExposures(views, curve, begin=0)
    for turn in range(rounds):
        for view in views:
            exposures.observe(
                view, len(views) * (1 + turn), rendered, targets(view, ("image", "mask"), "cpu")
            )
    return exposures


@pytest.mark.parametrize("curve", ["srgb", "agx"])
def test_gains_are_found_and_taken_out(curve: ToneCurve) -> None:
    views, gains, rendered, picture = scene(curve)
    exposures = observed(views, rendered, curve)
    found = np.stack([exposures.gains[view.name] for view in views])
    # AgX mixes channels before its curve, so that it blurs what belongs to each.
    assert np.abs(np.log(found / gains)).max() < (0.01 if curve == "srgb" else 0.06)
    np.testing.assert_allclose(np.log(found).mean(0), 0, atol=1e-12)
    for view in views:
        before = targets(view, ("image",), "cpu")
        after = exposures.balanced(view, before)["image"].numpy()
        assert (
            np.abs(after - picture).mean() < 0.15 * np.abs(before["image"].numpy() - picture).mean() + 0.003
        )


def test_a_common_factor_belongs_to_the_light() -> None:
    views, _, rendered, _ = scene("srgb")
    darker = {**rendered, "rgb": 0.8 * rendered["rgb"]}
    for one, other in zip(
        observed(views, rendered, "srgb").gains.values(), observed(views, darker, "srgb").gains.values()
    ):
        np.testing.assert_allclose(one, other, rtol=0.02)


def test_what_is_masked_uncovered_or_clipped_says_nothing() -> None:
    views, gains, rendered, _ = scene("srgb")
    spoiled = []
    for view in views:
        image, valid = view.read().copy(), np.ones((SIZE, SIZE), np.float32)
        image[:12], valid[:12] = 0.9, 0
        image[12:24] = 1.0  # clipped: more than half of what is left
        spoiled.append(View(view.name, view.camera, image, "display", valid=valid))
    thin = {**rendered, "opacity": torch.ones(SIZE, SIZE)}
    # In the first view alone: what is common to all belongs to the light.
    thin["opacity"][:, :20] = 0.75
    thin["rgb"] = rendered["rgb"].clone()
    thin["rgb"][:, :20] *= 0.5
    exposures = PhotoExposures(spoiled, "srgb", begin=0)
    for turn in range(6):
        for view in spoiled:
            exposures.observe(
                view,
                COUNT * (1 + turn),
                thin if view is spoiled[0] else rendered,
                targets(view, ("image", "mask", "valid"), "cpu"),
            )
    found = np.stack([exposures.gains[view.name] for view in spoiled])
    assert np.abs(np.log(found / gains)).max() < 0.015


def test_a_blur_changes_no_gain() -> None:
    """One of four pixels is bright in the first photo, and surfels show the mean of the four."""
    views, _, _, _ = scene("srgb")
    speckled = np.full((SIZE, SIZE, 3), 0.1)
    speckled[::2, ::2] = 0.7
    blurred = np.full((SIZE, SIZE, 3), 0.25)
    exposures = PhotoExposures(views, "srgb", begin=0)
    rendered = {"rgb": torch.from_numpy(shown(blurred, "srgb")), "opacity": torch.ones(SIZE, SIZE)}
    for turn in range(3):
        for view in views:
            photo = View(
                view.name, view.camera, shown(speckled if view is views[0] else blurred, "srgb"), "display"
            )
            exposures.observe(photo, COUNT * (1 + turn), rendered, targets(photo, ("image", "mask"), "cpu"))
    np.testing.assert_allclose(np.stack(list(exposures.gains.values())), 1, atol=0.01)


def test_what_a_poor_picture_said_of_a_photo_is_mended() -> None:
    """Surfels show half of the light when a photo is first compared, and all of it from then on."""
    views, gains, rendered, picture = scene("srgb")
    poor = {**rendered, "rgb": torch.from_numpy(shown(0.5 * srgb_to_linear(picture), "srgb"))}
    exposures = PhotoExposures(views, "srgb", begin=0)
    for turn in range(9):
        for view in views:
            seen = poor if turn == 0 and view is views[0] else rendered
            target = targets(view, ("image", "mask"), "cpu")
            exposures.observe(view, COUNT * (1 + turn), seen, target)
        if turn == 0:
            assert np.log(exposures.gains["0"] / gains[0]).min() > 0.4
    found = np.stack([exposures.gains[view.name] for view in views])
    assert np.abs(np.log(found / gains)).max() < 0.015


def test_before_they_are_looked_for_photos_are_what_they_are() -> None:
    views, _, rendered, _ = scene("srgb")
    exposures = PhotoExposures(views, "srgb", begin=50)
    target = targets(views[0], ("image",), "cpu")
    exposures.observe(views[0], 49, rendered, target)
    assert exposures.gains == {}
    assert exposures.balanced(views[0], target)["image"] is target["image"]


def test_they_outlive_a_checkpoint() -> None:
    views, _, rendered, _ = scene("srgb")
    exposures = observed(views, rendered, "srgb")
    again = PhotoExposures(views, "srgb", begin=0)
    again.restore(exposures.state())
    for name, gain in exposures.gains.items():
        np.testing.assert_array_equal(gain, again.gains[name])
