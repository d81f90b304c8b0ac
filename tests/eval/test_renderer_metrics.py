"""Laws of the renderer benchmark's figures: flicker, moving shadows, folds, insets, paired differences."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from eval.relighting.measured import Judged
from eval.relighting.scores import Score, Scores
from eval.renderer.changes import change_sums, correlation, slope, stayed
from eval.renderer.clips import Clips, ClipScore
from eval.renderer.curriculum import CAPTURES, PHOTOS, SYNTHETIC, Curriculum, stage_files
from eval.renderer.gains import Gains
from eval.renderer.judging import fold
from eval.renderer.kills import Ended, Kills
from eval.renderer.pictures import busiest_square, with_inset
from eval.renderer.repeats import Repeats
from eval.renderer.throughput import INFERENCE, TRAINING, Throughput
from eval.renderer.warping import Flicker, flicker, steps
from eval.results import Row
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


def test_a_clip_that_moves_by_whole_pixels_does_not_flicker(drawn_clip: Callable[..., Clip]):
    clip, shown = wall(drawn_clip)
    moves = steps(clip)
    assert len(moves) == 3
    assert all(np.allclose(move.displacement, (SHIFT, 0), atol=1e-4) for move in moves)
    found = flicker(shown, moves)
    assert found.pixels > 3 * 24 * (24 - SHIFT - 3)
    assert found.squared / found.pixels < 1e-7


def test_noise_raises_the_flicker_by_twice_its_variance(drawn_clip: Callable[..., Clip]):
    """Places are rounded to whole pixels, so a warped frame keeps the whole of its noise."""
    clip, shown = wall(drawn_clip, frames=8)
    sigma = 0.05
    noisy = shown + sigma * generator(6, "noise").standard_normal(shown.shape)
    found = flicker(noisy, steps(clip))
    assert found.squared / found.pixels == pytest.approx(2 * sigma**2, rel=0.1)


def test_a_picture_that_stands_still_before_a_moving_camera_flickers(drawn_clip: Callable[..., Clip]):
    clip, shown = wall(drawn_clip)
    found = flicker(np.repeat(shown[:1], 4, 0), steps(clip))
    assert found.squared / found.pixels > 0.1


def test_a_clip_without_true_depth_is_refused(drawn_clip: Callable[..., Clip]):
    clip, _ = wall(drawn_clip)
    del clip.frames["depth_ref"]
    with pytest.raises(TronError, match="no depth_ref"):
        steps(clip)


def test_ratios_are_of_mean_squares_and_gains_of_the_same_frames():
    found = Clips(5, "anchor")
    for scene, single, many in (("a", (8.0, 100), (4.0, 100)), ("b", (2.0, 50), (1.5, 50))):
        found.scores["truth"].append(ClipScore(scene, Flicker(0.5, single[1]), [100.0, 100.0]))
        found.scores["lit.k1"].append(ClipScore(scene, Flicker(*single), [30.0, 31.0]))
        found.scores["lit.anchor"].append(ClipScore(scene, Flicker(*many), [30.5, 31.5]))
    rows = values(found.rows(0))
    assert rows["renderer.warp_error_ratio"].value == pytest.approx(5.5 / 10)
    assert rows["renderer.warp_error_ratio"].scenes == 2
    assert rows["renderer.clip_gain_db"].value == pytest.approx(0.5)
    assert rows["renderer.warp_rms.truth"].value == pytest.approx(np.sqrt(1 / 150))
    assert "renderer.pair.warp_error_ratio" not in rows
    assert "K = 5, anchor" in str(found.sections(Path()))


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
    assert np.array_equal(stayed(clip, 0, 1), solid)
    floor = np.argwhere(solid)[-3:]
    for (row, column), name in zip(floor, ("depth_ref", "normal_ref", "base_color_ref")):
        clip.frames[name][1, row, column] *= -0.5
    left = stayed(clip, 0, 1)
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


def judged(**psnr: float) -> Judged:
    """Scores of two scenes under two kinds of light, of methods whose PSNR is constant."""
    scores = Scores()
    for method, mean in psnr.items():
        for scene, off in (("s0", -1.0), ("s1", 1.0)):
            for family in ("sun", "studio"):
                harder = 0.5 if (method, family) == ("neural_lit", "sun") else 0.0
                figures = {"psnr": mean + off - harder, "ssim": 0.9}
                for region in ("foreground", "frame"):
                    scores.kept[method, region].append(Score(family, scene, f"{scene}-{family}", figures))
    return Judged(scores, [], [])


def test_gains_are_over_the_best_of_the_group_and_paired_by_scene():
    fits = {"pbr": 20.0, "pbr_x_irradiance": 21.0, "affine": 22.0, "shadow_ratio": 23.0}
    fits |= {"shadowed": 23.5, "affine_ratio": 25.0, "lit": 30.0, "affine_lit": 29.0}
    found = Gains("models", "ood_", "Models", "", {128: judged(**fits, neural=27.0, neural_lit=31.0)})
    rows = values(found.rows(0))
    assert rows["renderer.ood_gain_db"].value == pytest.approx(2.0)
    assert rows["renderer.ood_gain_db"].low == pytest.approx(2.0), "scenes differ, their gains do not"
    assert rows["renderer.ood_gain_over_two_buffers_db"].value == pytest.approx(5.0)
    assert rows["renderer.ood_gain_over_pbr_db"].value == pytest.approx(7.0)
    assert rows["renderer.lit.ood_gain_db"].value == pytest.approx(0.75)
    assert rows["renderer.lit.ood_gain_db.sun"].value == pytest.approx(0.5)
    assert rows["renderer.ood_psnr.lit_full.studio"].value == pytest.approx(30.0)
    worst = found.worst_over_lit(0)
    assert {name: row.value for name, row in worst.items()} == {
        "Models: sun": pytest.approx(0.5),
        "Models: studio": pytest.approx(1.0),
    }


def test_sizes_after_the_first_stand_in_the_names_of_their_rows():
    scores = judged(pbr=20.0, lit=30.0, affine_lit=30.5, neural_lit=31.0)
    rows = values(Gains("synthetic", "", "S", "", {128: scores, 256: scores}).rows(0))
    assert {f"renderer.lit.gain_db{end}" for end in ("", ".256", "_full.256.sun")} <= set(rows)
    assert "renderer.gain_db" not in rows, "there was no pair"


def test_stages_are_compared_on_the_same_frames():
    def frames(mean: float) -> list[tuple[str, float]]:
        return [("s0", mean - 3), ("s0", mean - 1), ("s1", mean + 4)]

    psnr = {
        ("pair", number, place): frames(mean)
        for place, means in (
            (SYNTHETIC, (30.0, 29.5, 29.4)),
            (CAPTURES, (20.0, 21.0, 20.5)),
            (PHOTOS, (18.0, 24.0, 23.8)),
        )
        for number, mean in enumerate(means, 1)
    }
    names = {("pair", number): name for number, name in enumerate(("synthetic", "captures", "clips"), 1)}
    found = Curriculum(psnr, names)  # type: ignore[arg-type]
    rows = values(found.rows(0))
    assert rows["renderer.stage2_capture_gain_db"].value == pytest.approx(1.0)
    assert rows["renderer.stage2_photo_gain_db"].value == pytest.approx(6.0)
    assert rows["renderer.stage3_single_frame_loss_db.synthetic"].value == pytest.approx(0.1)
    assert rows["renderer.stage3_single_frame_loss_db"].value == pytest.approx(0.5), "the greatest of all"
    assert "stage 3 (clips)" in str(found.sections(Path()))


def test_stages_are_found_by_their_number(tmp_path: Path):
    with pytest.raises(TronError, match="no stages of a training"):
        stage_files(tmp_path)
    (tmp_path / "checkpoints").mkdir()
    for name in ("2-adapt.safetensors", "1-synthetic.safetensors", "3-video-00000100.ckpt"):
        (tmp_path / "checkpoints" / name).touch()
    assert {number: name for number, (name, _) in stage_files(tmp_path).items()} == {
        1: "synthetic",
        2: "adapt",
    }


def test_a_training_that_differs_takes_all_its_signals_with_it():
    ended = Ended("SIGKILL", 1.0, 40)
    rows = values(Kills([([ended] * 4, True), ([ended], False)]).rows(0))
    assert (rows["renderer.kill_identical"].value, rows["renderer.kill_identical"].n) == (4, 5)
    assert rows["renderer.kill_identical_share"].value == pytest.approx(0.8)


def test_frames_a_second_are_of_medians():
    seconds = {("lit", INFERENCE, 64): [0.5, 0.25, 9.0], ("pair", TRAINING, 64): [2.0, 2.0, 4.0]}
    rows = values(Throughput(seconds, 1).rows(0))  # type: ignore[arg-type]
    assert rows["renderer.frames_per_second.64"].value == 2.0
    assert rows["renderer.pair.training_frames_per_second.64"].value == 0.5


def test_the_worst_difference_between_seeds_is_reported_and_so_is_the_spread_of_trainings():
    trained = {seed: [("s0", 30.0 + seed), ("s1", 32.0 + seed)] for seed in range(3)}
    rows = values(Repeats({"pair": 0.0, "lit": 0.125}, 4, 2, trained).rows(0))
    assert rows["renderer.seed_max_difference"].value == 0.125
    assert rows["renderer.training_seed_spread_db"].value == pytest.approx(1.0)
    assert rows["renderer.training_seed_range_db"].value == pytest.approx(2.0)
