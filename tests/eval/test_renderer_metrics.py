"""Laws of the renderer benchmark's figures: flicker, moving shadows, folds, insets, paired differences."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from eval.relighting.scores import Score, Scores
from eval.renderer.benchmark import fold
from eval.renderer.clips import ClipScore, clip_rows, clip_steps
from eval.renderer.gains import between, everywhere, gain_rows, over_lit
from eval.renderer.pictures import busiest_square, with_inset
from eval.renderer.shadows import change_sums, correlation, slope, stayed
from eval.renderer.truths import Truths
from eval.results import Row
from eval.video.steadiness import Difference, warping_error
from tron.cameras import Camera
from tron.errors import TronError
from tron.seeds import generator
from tron.shards.schema import Clip

SHIFT = 3
"""Pixels by which the wall moves from frame to frame."""


def values(rows) -> dict[str, Row]:
    return {row.metric: row for row in rows}


def wall(drawn_clip: Callable[..., Clip], frames: int = 4, size: int = 24) -> tuple[Clip, np.ndarray]:
    """A flat wall that a camera passes by whole pixels a frame, and its texture as each frame shows it."""
    clip = drawn_clip(frames=frames, size=size)
    distance, focal = 2.0, 40.0
    step = SHIFT * distance / focal
    cameras = []
    for k in range(frames):
        world_to_camera = np.eye(4)
        world_to_camera[0, 3] = -step * k
        cameras.append(Camera(focal, focal, size / 2, size / 2, size, size, world_to_camera))
    x, y = np.meshgrid(*[(np.arange(size) + 0.5 - size / 2) / focal] * 2)
    depth = distance * np.sqrt(1 + x**2 + y**2)
    clip.meta.cameras[:] = [camera.to_dict() for camera in cameras]
    clip.frames["depth_ref"] = np.repeat(depth[None, ..., None], frames, 0).astype(np.float32)
    clip.frames["foreground"] = np.ones((frames, size, size, 1), np.float32)
    texture = generator(5, "wall").uniform(0, 1, (size, size + SHIFT * frames, 3))
    return clip, np.stack([texture[:, SHIFT * k : SHIFT * k + size] for k in range(frames)])


def test_a_clip_that_moves_by_whole_pixels_has_no_warping_error(drawn_clip: Callable[..., Clip]):
    clip, shown = wall(drawn_clip)
    moves = clip_steps(clip)
    assert len(moves) == 3
    assert all(np.allclose(move.displacement, (SHIFT, 0), atol=1e-4) for move in moves)
    found = warping_error(shown, moves)
    assert found.pixels > 3 * 24 * (24 - SHIFT - 3)
    assert found.squared / found.pixels < 1e-7


def test_noise_raises_the_warping_error_by_twice_its_variance(drawn_clip: Callable[..., Clip]):
    """Places are rounded to whole pixels, so a warped frame keeps the whole of its noise."""
    clip, shown = wall(drawn_clip, frames=8)
    sigma = 0.05
    noisy = shown + sigma * generator(6, "noise").standard_normal(shown.shape)
    found = warping_error(noisy, clip_steps(clip))
    assert found.squared / found.pixels == pytest.approx(2 * sigma**2, rel=0.1)


def test_a_picture_that_stands_still_before_a_moving_camera_has_a_warping_error(
    drawn_clip: Callable[..., Clip],
):
    clip, shown = wall(drawn_clip)
    found = warping_error(np.repeat(shown[:1], 4, 0), clip_steps(clip))
    assert found.squared / found.pixels > 0.1


def test_a_clip_without_true_depth_is_refused(drawn_clip: Callable[..., Clip]):
    clip, _ = wall(drawn_clip)
    del clip.frames["depth_ref"]
    with pytest.raises(TronError, match="no depth_ref"):
        clip_steps(clip)


def test_ratios_are_of_mean_squares_and_gains_of_the_same_frames():
    psnr = {"lit_buffer_averaged": 30.0, "lit.k1": 30.0, "lit.averaged": 30.5}
    scores: dict[str, list[ClipScore]] = {name: [] for name in ("truth", *psnr)}
    for scene, single, many in (("a", (8.0, 100), (4.0, 100)), ("b", (2.0, 50), (1.5, 50))):
        scores["truth"].append(ClipScore(scene, Difference(0.5, single[1]), [100.0, 100.0]))
        for name, first in psnr.items():
            of = Difference(*(many if name == "lit.averaged" else single))
            scores[name].append(ClipScore(scene, of, [first, first + 1]))
    rows = values(clip_rows(scores, ["lit"], 0))
    assert rows["renderer.warp_error_ratio"].value == pytest.approx(5.5 / 10)
    assert rows["renderer.warp_error_ratio"].scenes == 2
    assert rows["renderer.clip_gain_db"].value == pytest.approx(0.5)
    assert rows["renderer.warp_rms.truth"].value == pytest.approx(np.sqrt(1 / 150))
    assert "renderer.pair.warp_error_ratio" not in rows


def test_the_truth_correlates_with_itself_and_a_constant_with_nothing():
    truth = generator(1, "changes").standard_normal((200, 3))
    itself, nothing = change_sums(truth, truth), change_sums(truth, np.full_like(truth, 0.25))
    assert correlation(itself) == pytest.approx(1)
    assert slope(itself) == pytest.approx(1)
    assert correlation(nothing) == 0
    assert slope(nothing) == pytest.approx(0, abs=1e-12)
    assert correlation(change_sums(truth, -truth)) == pytest.approx(-1)
    assert slope(change_sums(truth, 0.5 * truth + 3)) == pytest.approx(0.5)


def test_sums_of_parts_are_the_sums_of_the_whole():
    rng = generator(2, "changes")
    x, y = rng.standard_normal((2, 90, 3))
    y += x
    whole = change_sums(x, y)
    assert change_sums(x[:30], y[:30]) + change_sums(x[30:], y[30:]) == pytest.approx(whole)
    assert correlation(whole) == pytest.approx(np.corrcoef(x.ravel(), y.ravel())[0, 1])
    assert slope(whole) == pytest.approx(np.polyfit(x.ravel(), y.ravel(), 1)[0])


def test_a_surface_stays_where_depth_normal_and_color_do(drawn_clip: Callable[..., Clip]):
    clip = drawn_clip(frames=2)
    for name in ("depth_ref", "normal_ref", "base_color_ref"):
        clip.frames[name][1] = clip.frames[name][0]
    solid = clip.frames["foreground"][0, ..., 0] > 0.5
    assert np.array_equal(stayed(clip.frames, 0, 1), solid)
    floor = np.argwhere(solid)[-3:]
    for (row, column), name in zip(floor, ("depth_ref", "normal_ref", "base_color_ref")):
        clip.frames[name][1, row, column] *= -0.5
    left = stayed(clip.frames, 0, 1)
    around = np.zeros_like(solid)
    for row, column in floor:
        around[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2] = True
    assert np.array_equal(left, solid & ~around), "those and the pixels around them"


def test_scenes_are_divided_into_folds_without_loss():
    scenes = [f"s{k}" for k in range(7)]
    groups = fold(scenes, 4, 3)
    assert sorted(name for group in groups for name in group) == scenes
    assert sorted(map(len, groups)) == [1, 2, 2, 2]
    assert fold(scenes, 4, 3) == groups
    assert len(fold(scenes[:2], 4, 3)) == 2


def test_the_inset_shows_the_square_in_which_two_pictures_differ_most():
    a = np.zeros((64, 64, 3))
    b = a.copy()
    b[40:56, 8:24] = 1
    b[3, 60] = 1
    assert busiest_square(a, b) == ((40, 8), 16)
    shown = with_inset(b, (40, 8), 16)
    assert shown.shape == (256 + 4 + 256, 256, 3)
    assert (shown[260:] == 1).all(), "all of the square is white"


def scored(**psnr: float) -> Scores:
    """Scores of two scenes under two kinds of light, of methods whose PSNR is constant."""
    scores = Scores()
    for method, mean in psnr.items():
        for scene, off in (("s0", -1.0), ("s1", 1.0)):
            for family in ("sun", "studio"):
                harder = 0.5 if (method, family) == ("neural_lit", "sun") else 0.0
                figures = {"psnr": mean + off - harder, "ssim": 0.9}
                for region in ("foreground", "frame"):
                    scores.kept[method, region].append(Score(family, scene, f"{scene}-{family}", figures))
    return scores


def test_gains_are_over_the_best_of_the_group_and_paired_by_scene():
    fits = {"pbr": 20.0, "pbr_x_irradiance": 21.0, "affine": 22.0, "shadow_ratio": 23.0}
    fits |= {"shadowed": 23.5, "affine_ratio": 25.0, "lit": 30.0, "affine_lit": 29.0}
    found = scored(**fits, neural=27.0, neural_lit=31.0)
    rows = values(gain_rows("ood_", {128: found}, 0))
    assert rows["renderer.ood_gain_db"].value == pytest.approx(2.0)
    assert rows["renderer.ood_gain_db"].low == pytest.approx(2.0), "scenes differ, their gains do not"
    assert rows["renderer.ood_gain_over_two_buffers_db"].value == pytest.approx(5.0)
    assert rows["renderer.ood_gain_over_pbr_db"].value == pytest.approx(7.0)
    assert rows["renderer.lit.ood_gain_db"].value == pytest.approx(0.75)
    assert rows["renderer.lit.ood_gain_db.sun"].value == pytest.approx(0.5)
    assert rows["renderer.ood_psnr.lit_full.studio"].value == pytest.approx(30.0)
    assert [row.value for row in over_lit(found, 0)] == [
        pytest.approx(1.0),
        pytest.approx(0.5),
    ]  # studio, sun


def test_a_gain_that_one_scene_carries_is_seen_without_it():
    scores = scored(lit=30.0, affine_lit=29.0, neural_lit=31.0)
    for region in ("foreground", "frame"):
        for method, psnr in (("lit", 20.0), ("affine_lit", 22.0), ("neural_lit", 28.0)):
            scores.kept[method, region].append(Score("sun", "s2", "s2-sun", {"psnr": psnr, "ssim": 0.5}))
    rows = values(gain_rows("ood_", {512: scores}, 0, every_size=True))
    # Means: lit 28, affine_lit 27.6, the network 30.2; without s2 30, 29 and 30.75.
    gain = rows["renderer.lit.ood_gain_db.512"]
    assert gain.value == pytest.approx(2.2)
    assert rows["renderer.lit.ood_gain_leave_one_out_db.512"].value == pytest.approx(0.75)
    assert rows["renderer.lit.ood_gain_kept.512"].value == pytest.approx(0.75 / 2.2)
    assert rows["renderer.lit.ood_worst_scene_gain_db.512"].value == pytest.approx(0.75), "6 in s2"
    assert rows["renderer.lit.ood_worst_scene_over_input_db.512"].value == pytest.approx(0.75), "8 in s2"
    found = {row.metric: row.value for row in everywhere(rows.values())}
    assert found == {
        "renderer.lit.everywhere.worst_scene_gain_db": pytest.approx(0.75),
        "renderer.lit.everywhere.worst_scene_over_input_db": pytest.approx(0.75),
        "renderer.lit.everywhere.gain_kept": pytest.approx(0.75 / 2.2),
    }


def test_the_best_by_ssim_is_not_the_best_by_psnr():
    """A blurred picture leads by PSNR; the network is held against what has most of the structure."""
    scores = Scores()
    for method, psnr, ssim in (("lit", 28.0, 0.9), ("lit_filtered", 31.0, 0.7), ("neural_lit", 30.0, 0.95)):
        scores.kept[method, "foreground"].append(Score("sun", "a", "a0", {"psnr": psnr, "ssim": ssim}))
    rows = values(gain_rows("", {128: scores}, 0))
    assert rows["renderer.lit.gain_db"].value == pytest.approx(-1.0)
    assert rows["renderer.lit.ssim_gain"].value == pytest.approx(0.05)
    assert rows["renderer.ssim.lit_filtered"].value == pytest.approx(0.7)


def test_two_data_sets_are_compared_frame_by_frame():
    ours, theirs = scored(neural_lit=31.0), scored(neural_lit=28.5)
    row = between("renderer.preview_gain_db.512", "neural_lit", ours, theirs, 0)
    assert row is not None
    assert row.value == pytest.approx(2.5)
    assert (row.low, row.scenes) == (pytest.approx(2.5), 2), "scenes differ, their gains do not"
    assert between("renderer.preview_gain_db.512", "neural", ours, theirs, 0) is None
    theirs.kept["neural_lit", "foreground"].pop()
    with pytest.raises(TronError, match="not hold the same clips"):
        between("renderer.preview_gain_db.512", "neural_lit", ours, theirs, 0)


@pytest.mark.parametrize("count", [2, 4])
def test_the_noise_that_is_left_in_the_truth_is_what_its_mean_is_off(
    count: int, drawn_clip: Callable[..., Clip]
):
    """Renders of known noise: the estimate, which sees no more than they do, is their mean's true PSNR."""
    clip = drawn_clip(size=96)
    clean, key = clip.frames["rgb"], clip.meta.key
    rng = generator(4, "truth", count)
    renders = [
        (clean * (1 + 0.1 * rng.standard_normal(clean.shape))).astype(np.float32) for _ in range(count)
    ]
    truths = Truths({key: renders})
    inside = clip.frames["foreground"][..., 0] > 0.5
    off = np.square(truths.displayed(clip) - clip.displayed("rgb"))[inside].mean()
    rows = values(truths.rows([clip], "renderer.psnr.truth", ".96", 0))
    assert rows["renderer.psnr.truth.96"].value == pytest.approx(-10 * np.log10(off), abs=0.15)
    assert rows["renderer.psnr.truth_full.96"].n == 2
    assert Truths({key: renders[:1]}).rows([clip], "renderer.psnr.truth", "", 0) == []


def test_truths_of_other_frames_are_refused(
    write_dataset: Callable[..., Path], tmp_path: Path, dataset: Path
):
    other = write_dataset(tmp_path / "other", frames=3)
    found = Truths.of([dataset, dataset], "test")
    assert {len(each) for each in found.renders.values()} == {1}, "a truth that is read twice counts once"
    with pytest.raises(TronError, match="shows other frames"):
        Truths.of([dataset, other], "test")


def test_sizes_after_the_first_stand_in_the_names_of_their_rows():
    scores = scored(pbr=20.0, lit=30.0, affine_lit=30.5, neural_lit=31.0)
    rows = values(gain_rows("", {128: scores, 256: scores}, 0))
    assert {f"renderer.lit.gain_db{end}" for end in ("", ".256", "_full.256.sun")} <= set(rows)
    assert "renderer.gain_db" not in rows, "there was no pair"
