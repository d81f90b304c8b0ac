"""Quality of the guidance on drawn errors whose measure is known."""

from collections.abc import Callable

import numpy as np
import pytest

from eval.relighting.guidance import GuidanceScores
from eval.relighting.shadows import same_depth, same_normal, shadow_pixels
from tron.color import agx
from tron.shards.schema import Clip, clip_members

MakeClip = Callable[..., Clip]


def grey(values: list[float]) -> np.ndarray:
    return np.repeat(np.array([values])[..., None], 3, axis=-1)


def test_leaks_and_darkening_follow_their_definitions():
    unshadowed = grey([1, 1, 1, 1, 1, 1, 1])
    reference = grey([0.1, 0.1, 0.4, 0.7, 1.0, 1.0, 0.95])  # shadow, shadow, shadow, between, lit, lit, lit
    leak = 0.15 * reference.mean()
    ours = grey([0.1 + 1.01 * leak, 0.1 + 0.99 * leak, 0.0, 0.0, 0.74, 0.76, 2.0])
    found = shadow_pixels(ours, reference, unshadowed, np.ones((1, 7), bool))
    np.testing.assert_array_equal(found.shadowed[0], [1, 1, 1, 0, 0, 0, 0])
    np.testing.assert_array_equal(found.leaking[0], [1, 0, 0, 0, 0, 0, 0])
    np.testing.assert_array_equal(found.lit[0], [0, 0, 0, 0, 1, 1, 1])
    np.testing.assert_array_equal(found.darkened[0], [0, 0, 0, 0, 1, 0, 0])


def test_only_judged_pixels_count():
    ours, reference, unshadowed = grey([1, 0.1]), grey([0.1, 1]), grey([1, 1])
    first = shadow_pixels(ours, reference, unshadowed, np.array([[True, False]]))
    assert [pixels.sum() for pixels in first] == [1, 1, 0, 0]
    none = shadow_pixels(ours, reference, unshadowed, np.zeros((1, 2), bool))
    assert [pixels.sum() for pixels in none] == [0, 0, 0, 0]


def test_an_error_of_the_surfels_own_unshadowed_light_moves_no_pixel_between_classes(drawn_clip: MakeClip):
    """Surfels that face the light too much have too much unshadowed light: that makes no shadow."""
    clip = drawn_clip("noon")
    before, after = GuidanceScores(), GuidanceScores()
    before.add(clip)
    clip.frames["unshadowed"] *= 3
    after.add(clip)
    assert [row for row in before.rows() if "shadow" in row.metric or "lit" in row.metric]
    assert after.rows() == before.rows()


def test_a_pixel_that_shows_another_surface_is_judged_only_with_silhouettes(drawn_clip: MakeClip):
    clip = drawn_clip("noon")
    clip.frames["irradiance_ref"] = clip.frames["irradiance"].copy()
    frame = {name: images[0] for name, images in clip.frames.items()}
    solid = frame["foreground"][..., 0] > 0.5
    assert same_normal(frame)[solid].all()
    assert same_depth(frame)[solid].all()
    clip.frames["irradiance"] = clip.frames["unshadowed"].copy()
    for spoilt, gone, left in (
        # x and z change places: the floor's shadow is on another surface now, by its normal
        ({"normal": clip.frames["normal_ref"][..., ::-1].copy()}, "_same_normal", ""),
        ({"depth": clip.frames["depth_ref"] + 0.04}, "", "_same_normal"),
    ):
        scores = GuidanceScores()
        scores.add(Clip(clip.meta, clip.frames | spoilt))
        rows = {row.metric: row.value for row in scores.rows()}
        assert rows["guidance.shadow_leak_with_silhouettes"] == 1
        assert rows[f"guidance.shadow_leak{left}"] == 1
        assert f"guidance.shadow_leak{gone}" not in rows


def test_perfect_guidance_leaks_nowhere_and_its_psnr_is_capped(drawn_clip: MakeClip):
    clip = drawn_clip()
    clip.frames["irradiance_ref"] = clip.frames["irradiance"].copy()
    scores = GuidanceScores()
    scores.add(clip)
    rows = {row.metric: row.value for row in scores.rows()}
    assert rows["guidance.irradiance_psnr"] == 100
    assert rows["guidance.shadow_leak"] == 0
    assert rows["guidance.lit_darkened"] == 0
    assert rows["surfels.normal_mae_deg"] == pytest.approx(0, abs=1e-4)


def test_unshadowed_irradiance_leaks_in_every_shadow_of_the_sun(drawn_clip: MakeClip):
    clip = drawn_clip("noon")
    clip.frames["irradiance_ref"] = clip.frames["irradiance"].copy()
    clip.frames["irradiance"] = clip.frames["unshadowed"].copy()
    scores = GuidanceScores()
    scores.add(clip)
    assert {row.metric: row.value for row in scores.rows()}["guidance.shadow_leak.sun"] == 1


def test_the_headline_irradiance_is_that_of_the_worst_light(drawn_clip: MakeClip):
    scores = GuidanceScores()
    for light, error in (("noon", 0.05), ("softbox", 0.2), ("grey", 0.1)):
        clip = drawn_clip(light, frames=2)
        clip.frames["irradiance"] = np.full_like(clip.frames["irradiance"], 0.5)
        clip.frames["irradiance_ref"] = np.full_like(clip.frames["irradiance"], 0.5 * (1 + error))
        scores.add(clip)
    rows = {row.metric: row for row in scores.rows()}
    expected = -20 * np.log10(abs(agx(np.full(3, 0.4 * 0.5 * 1.2)) - agx(np.full(3, 0.4 * 0.5)))[0])
    assert rows["guidance.irradiance_psnr"].value == pytest.approx(expected, abs=1e-3)
    assert rows["guidance.irradiance_psnr"].value == rows["guidance.irradiance_psnr.studio"].value
    assert rows["guidance.irradiance_psnr.studio"].value < rows["guidance.irradiance_psnr.overcast"].value
    assert rows["guidance.irradiance_psnr.studio"].n == 2


def test_a_view_seen_under_two_lights_counts_once_for_the_surfels(drawn_clip: MakeClip):
    scores = GuidanceScores()
    for light in ("noon", "softbox"):
        scores.add(drawn_clip(light, frames=3))
    rows = {row.metric: row for row in scores.rows()}
    assert rows["surfels.base_color_psnr"].n == 3
    assert rows["surfels.base_color_psnr"].value == pytest.approx(-20 * np.log10(0.02), abs=0.2)
    assert rows["guidance.irradiance_psnr.sun"].n == 3


def test_normals_are_compared_where_both_exist(drawn_clip: MakeClip):
    clip = drawn_clip()
    foreground = clip.frames["foreground"][..., 0] > 0.5
    turned = clip.frames["normal_ref"].copy()
    turned[foreground] = turned[foreground] @ np.diag([1, -1, -1]).astype(np.float32)  # half a turn about x
    turned[:, :, :20] = 0  # holes of the surfels
    clip.frames["normal"] = turned
    scores = GuidanceScores()
    scores.add(clip)
    both = foreground.copy()
    both[:, :, :20] = False
    x = clip.frames["normal_ref"][both][:, 0]
    expected = np.degrees(np.arccos(np.clip(2 * x**2 - 1, -1, 1))).mean()  # n.n' = x^2 - y^2 - z^2
    value = {row.metric: row.value for row in scores.rows()}["surfels.normal_mae_deg"]
    assert value == pytest.approx(expected, abs=2.0)


def test_without_references_nothing_is_claimed(drawn_clip: MakeClip):
    clip = drawn_clip()
    clip.frames = {name: clip.frames[name] for name in clip_members(reference=False)}
    scores = GuidanceScores()
    scores.add(clip)
    assert scores.rows() == []
