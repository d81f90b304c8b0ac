"""Scores of predictions with known errors, and the rows made of them."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from eval.relighting.baselines import fit_baselines, predictions
from eval.relighting.buffers import Buffers, Region, region_mask
from eval.relighting.fits import Show
from eval.relighting.scores import GROUPS, OPTIONAL, Scores
from tron.color import to_display
from tron.errors import TronError
from tron.metrics import PSNR_CAP
from tron.shards.schema import Clip

MakeClip = Callable[..., Clip]


def both(images: dict[str, np.ndarray]) -> dict:
    return {"foreground": images, "frame": images}


def fitted_and_shown(
    clips: list[Clip], networks: dict[str, Show] | None = None
) -> dict[Region, dict[str, np.ndarray]]:
    """Pictures of the first of some clips by baselines fitted on all of them, and by networks."""
    fits = fit_baselines(clips, seed=0)
    return predictions(clips[0], {name: fitted.show for name, fitted in fits.items()} | (networks or {}))


def rows_of(scores: Scores) -> dict[str, tuple[float, int]]:
    return {row.metric: (row.value, row.n) for row in scores.rows()}


def test_a_known_error_has_its_known_psnr(drawn_clip: MakeClip):
    clip = drawn_clip(frames=3)
    truth = clip.displayed("rgb") * 0.5 + 0.2
    scores = Scores()
    scores.add(clip, both({"pbr": truth + 0.1, "neural": truth - 0.01}), truth)
    rows = rows_of(scores)
    assert rows["pbr.psnr"] == (pytest.approx(20.0, abs=1e-3), 3)
    assert rows["pbr.psnr_full"] == (pytest.approx(20.0, abs=1e-3), 3)
    assert rows["neural.psnr.sun"] == (pytest.approx(40.0, abs=1e-2), 3)


def test_psnr_is_averaged_over_frames_not_taken_of_the_mean_error(drawn_clip: MakeClip):
    clip = drawn_clip(frames=2)
    truth = np.full_like(clip.displayed("rgb"), 0.5)
    shown = truth.copy()
    shown[0] += 0.1
    shown[1] += 0.001
    scores = Scores()
    scores.add(clip, both({"pbr": shown}), truth)
    assert rows_of(scores)["pbr.psnr"][0] == pytest.approx((20 + 60) / 2, abs=1e-2)


def test_a_perfect_prediction_is_capped_and_never_infinite(drawn_clip: MakeClip):
    clip = drawn_clip()
    truth = clip.displayed("rgb")
    scores = Scores()
    scores.add(clip, both({"neural": truth}), truth)
    assert rows_of(scores)["neural.psnr"][0] == PSNR_CAP
    assert rows_of(scores)["neural.ssim"][0] == pytest.approx(1.0)


def test_errors_outside_the_foreground_count_in_the_full_frame_only(drawn_clip: MakeClip):
    clip = drawn_clip()
    truth = clip.displayed("rgb")
    outside = ~region_mask(clip, "foreground")[..., None]
    scores = Scores()
    scores.add(clip, both({"pbr": truth + 0.2 * outside}), truth)
    rows = rows_of(scores)
    assert rows["pbr.psnr"][0] == PSNR_CAP
    share = outside.mean()
    assert rows["pbr.psnr_full"][0] == pytest.approx(-10 * np.log10(0.04 * share), abs=1e-2)


def test_gains_are_over_the_best_of_their_group_and_absent_without_all_of_it(drawn_clip: MakeClip):
    clip = drawn_clip()
    truth = np.full_like(clip.displayed("rgb"), 0.5)

    def off(error: float) -> np.ndarray:
        return truth + np.float32(error)

    # The best of the simple baselines is off by 0.02, the best of those of direct light by 0.015.
    simple = {name: off(0.1) for name in GROUPS["best_simple_baseline"]} | {"affine": off(0.02)}
    needed = [name for name in GROUPS["best_direct_baseline"] if name not in {*simple, *OPTIONAL}]
    direct = {**simple, **{name: off(0.2) for name in needed}, "affine_ratio": off(0.015)}
    others = {name: off(0.2) for name in GROUPS["best_baseline"] if name not in {*direct, *OPTIONAL}}
    given = {"neural": off(0.01), **simple}
    scores = Scores()
    scores.add(clip, both(given), truth)
    rows = rows_of(scores)
    assert rows["neural.gain_over_best_simple_baseline"][0] == pytest.approx(20 * np.log10(2), abs=1e-2)
    assert not [name for name in rows if "best_direct_baseline" in name or "best_baseline" in name]
    scores = Scores()
    scores.add(clip, both({**given, **direct, "lit": off(0.02)}), truth)
    rows = rows_of(scores)  # a network of two buffers may be missing among the baselines, one on lit may not
    gain = 20 * np.log10(1.5)
    assert rows["neural.gain_over_best_direct_baseline_full.sun"][0] == pytest.approx(gain, abs=1e-2)
    assert not [name for name in rows if "best_baseline" in name or "best_fit_on_lit" in name]
    scores = Scores()
    of_lit = {"pixel_mlp_lit": off(0.005), "neural_lit": off(0.004)}
    scores.add(clip, both({**given, **direct, **others, **of_lit, "pixel_mlp": off(0.004)}), truth)
    rows = rows_of(scores)
    better = 20 * np.log10(2.5)
    assert rows["neural.gain_over_best_direct_baseline"][0] == pytest.approx(-better, abs=1e-2)
    assert rows["neural_lit.gain_over_best_baseline"][0] == pytest.approx(0, abs=1e-2)
    assert rows["neural_lit.gain_over_neural"][0] == pytest.approx(better, abs=1e-2)
    assert rows["neural_lit.gain_over_best_fit_on_lit"][0] == pytest.approx(20 * np.log10(1.25), abs=1e-2)


def test_the_best_of_all_is_the_best_of_all_that_was_scored(drawn_clip: MakeClip):
    clip = drawn_clip()
    truth = np.full_like(clip.displayed("rgb"), 0.5)
    given = {"pbr": 0.1, "lit": 0.02, "lit.reflections": 0.005, "neural_lit": 0.01}
    scores = Scores()
    scores.add(clip, both({name: truth + np.float32(error) for name, error in given.items()}), truth)
    assert scores.best(GROUPS["best_of_all"]) == "lit.reflections"
    gain = rows_of(scores)["neural_lit.gain_over_best_of_all"][0]
    assert gain == pytest.approx(-20 * np.log10(2), abs=1e-2)


def test_what_was_not_given_has_no_row(drawn_clip: MakeClip):
    clip = drawn_clip()
    scores = Scores()
    scores.add(clip, fitted_and_shown([clip]), clip.displayed("rgb"))
    names = set(rows_of(scores))
    assert "affine_ratio.psnr" in names
    assert not [name for name in names if name.startswith(("neural", "pixel_mlp"))]


def test_a_frame_without_foreground_has_no_foreground_score(drawn_clip: MakeClip):
    clip = drawn_clip(frames=3)
    clip.frames["foreground"][1] = 0
    truth = clip.displayed("rgb")
    scores = Scores()
    scores.add(clip, both({"pbr": truth}), truth)
    assert rows_of(scores)["pbr.psnr"][1] == 2
    assert rows_of(scores)["pbr.psnr_full"][1] == 3


def test_without_shadows_and_bounces_every_product_is_the_truth(drawn_clip: MakeClip):
    clip = drawn_clip()
    clip.frames["irradiance"] = clip.frames["unshadowed"].copy()
    clip.frames["rgb"] = clip.frames["shadowed"] = clip.frames["pbr"].copy()
    shown = fitted_and_shown([clip])
    truth = clip.displayed("rgb")
    for region, images in shown.items():
        for method in ("pbr", "shadow_ratio", "shadowed", "affine", "affine_ratio"):
            np.testing.assert_allclose(images[method], truth, atol=1e-4, err_msg=f"{region} {method}")


def where_sky_and_surface_differ(clip: Clip) -> np.ndarray:
    """Truth in which surfaces are a blend of pbr and irradiance, and the sky is as pbr shows it."""
    pbr, irradiance = (to_display(clip.frames[name], clip.meta.exposure) for name in ("pbr", "irradiance"))
    surfaces = np.clip(0.4 * pbr + 0.4 * irradiance + 0.05, 0, 1)
    return np.where(region_mask(clip, "foreground")[..., None], surfaces, pbr).astype(np.float32)


def as_photographed(clip: Clip, truth: np.ndarray) -> Clip:
    clip.frames["rgb"] = truth
    clip.meta.color_space["rgb"] = "display"
    return clip


@pytest.mark.parametrize("method", ["affine", "affine_ratio"])
def test_a_blend_of_surfaces_leaves_the_sky_as_it_is(drawn_clip: MakeClip, method: str):
    clips = [drawn_clip(light, seed) for light in ("noon", "grey") for seed in (0, 1)]
    for clip in clips:
        as_photographed(clip, where_sky_and_surface_differ(clip))
    shown = fitted_and_shown(clips)
    truth = clips[0].displayed("rgb")
    inside = region_mask(clips[0], "foreground")
    np.testing.assert_allclose(shown["foreground"][method][inside], truth[inside], atol=1e-4)
    np.testing.assert_allclose(shown["frame"][method], truth, atol=1e-4)


def test_half_a_surface_shows_half_of_pbr_in_full_frames_alone(drawn_clip: MakeClip):
    clip = drawn_clip()
    clip.frames["mask"] = np.full_like(clip.frames["mask"], 0.25)
    shown = fitted_and_shown([clip], {"pixel_mlp": lambda buffers: np.full_like(buffers["pbr"], 0.9)})
    assert np.all(shown["foreground"]["pixel_mlp"] == np.float32(0.9))
    expected = 0.25 * 0.9 + 0.75 * shown["frame"]["pbr"]
    np.testing.assert_allclose(shown["frame"]["pixel_mlp"], expected, atol=1e-6)


def test_the_neural_renderer_draws_its_own_sky(drawn_clip: MakeClip):
    clip = drawn_clip()
    shown = fitted_and_shown([clip], {"neural": lambda buffers: np.full_like(buffers["pbr"], 0.9)})
    np.testing.assert_array_equal(shown["frame"]["neural"], shown["foreground"]["neural"])


def test_the_network_is_given_linear_buffers_and_the_exposure(drawn_clip: MakeClip):
    clip = drawn_clip()

    def network(buffers: Buffers) -> np.ndarray:
        np.testing.assert_array_equal(buffers["irradiance"], clip.frames["irradiance"])
        return to_display(buffers["pbr"], buffers.exposure)

    shown = fitted_and_shown([clip], {"neural": network})
    np.testing.assert_array_equal(shown["frame"]["neural"], shown["frame"]["pbr"])


def test_nothing_to_fit_on_is_one_line(drawn_clip: MakeClip):
    with pytest.raises(TronError, match="no training clips"):
        fit_baselines([], seed=0)
    clip = drawn_clip()
    clip.frames["foreground"] = np.zeros_like(clip.frames["foreground"])
    with pytest.raises(TronError, match="no training clips with a foreground"):
        fit_baselines([clip], seed=0)


def test_a_captured_photo_is_shown_as_it_is(drawn_clip: MakeClip):
    clip = drawn_clip()
    clip.meta.color_space["rgb"] = "display"
    np.testing.assert_array_equal(clip.displayed("rgb"), clip.frames["rgb"])


def test_styles_of_scenes_have_rows_of_their_own_where_there_are_several(drawn_clip):
    scores, styles = Scores(), ["object", "table"]
    for number, style in enumerate(styles):
        clip = drawn_clip(seed=number)
        clip = replace(clip, meta=clip.meta.model_copy(update={"extra": {"style": style}}))
        truth = clip.displayed("rgb")
        scores.add(clip, {"foreground": {"pbr": np.clip(truth + 0.1 * (number + 1), 0, 1)}}, truth)
        assert scores.styles == ([] if number == 0 else styles)
    rows = {row.metric: row for row in scores.rows()}
    both = [rows[f"pbr.psnr.{style}"] for style in styles]
    assert both[0].value > both[1].value
    assert rows["pbr.psnr"].value == pytest.approx(np.mean([row.value for row in both]))
