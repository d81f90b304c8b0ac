"""Laws of intervals over scenes: coverage, scenes and not frames as the unit, differences in pairs."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy.stats

from eval.confidence import Interval, interval, mean_interval, quotient, scene_sums
from eval.demo import refinement
from eval.relighting.guidance import GuidanceScores, shadow_rows
from eval.relighting.scores import GROUPS, METRICS, Score, Scores
from eval.report.figures import interval_note, left_out, with_interval
from eval.results import Results, Row
from tron.seeds import generator
from tron.shards.schema import Clip


def drawn(trial: int, scenes: int, frames: int = 15) -> tuple[list[str], list[float]]:
    """Frames of scenes whose means spread by 2 dB about 30, frames by 0.5 dB within a scene."""
    rng = generator(0, "scenes", scenes, trial)
    values = 30 + 2 * rng.normal(size=(scenes, 1)) + 0.5 * rng.normal(size=(scenes, frames))
    return [f"s{k}" for k in range(scenes) for _ in range(frames)], values.ravel().tolist()


def ends(found: Interval | Row) -> tuple[float, float]:
    assert found.low is not None
    assert found.high is not None
    return found.low, found.high


def covered(scenes: int, trials: int, unit: Callable[[list[str]], list[str]] = list) -> float:
    """Share of intervals that hold the true mean, 30."""
    hits = 0
    for trial in range(trials):
        names, values = drawn(trial, scenes)
        low, high = ends(mean_interval(unit(names), values, seed=trial))
        hits += low <= 30 <= high
    return hits / trials


@pytest.mark.parametrize("scenes, least", [(4, 0.85), (8, 0.9), (20, 0.92)])
def test_intervals_hold_the_true_mean_about_as_often_as_they_say(scenes: int, least: float):
    assert least <= covered(scenes, trials=200) <= 0.99


def test_taking_frames_for_independent_would_promise_too_much():
    assert covered(8, trials=50, unit=lambda names: [str(k) for k in range(len(names))]) < 0.6


def test_frames_that_are_repeated_narrow_nothing():
    names, values = drawn(0, 5)
    once, four_times = mean_interval(names, values, 0), mean_interval(names * 4, values * 4, 0)
    assert once.scenes == four_times.scenes == 5
    assert four_times.low == pytest.approx(once.low)
    assert four_times.high == pytest.approx(once.high)


def test_an_interval_of_many_scenes_is_that_of_student():
    """An independent witness: of the mean of many normal values Student's interval is exact."""
    values = generator(0, "many").normal(30, 2, 60)
    found = mean_interval([str(k) for k in range(60)], values.tolist(), 0)
    low, high = scipy.stats.t.interval(0.95, 59, values.mean(), scipy.stats.sem(values))
    assert found.low == pytest.approx(low, abs=0.08)
    assert found.high == pytest.approx(high, abs=0.08)


def test_four_scenes_give_their_worst_and_best():
    found = mean_interval(list("aabbccdd"), [30.0, 32, 28, 28, 35, 33, 29, 30], 0)
    assert found == Interval(4, 28.0, 34.0)


def test_scenes_count_by_their_frames_as_in_the_mean():
    """Ratios of sums: a scene of nine frames weighs nine times one of a single frame."""
    per_scene = scene_sums(["a"] * 9 + ["b"], np.array([[10.0, 1]] * 9 + [[0.0, 1]]))
    np.testing.assert_array_equal(per_scene, [[90, 9], [0, 1]])
    assert quotient(per_scene.sum(0)) == 9.0
    found = interval(per_scene, quotient, 0)
    assert (found.low, found.high) == (0.0, 10.0)


def test_one_scene_has_no_interval():
    assert mean_interval(["a"] * 20, [1.0] * 20, 0) == Interval(1)
    row = Row(metric="a.b", value=1.0, unit="dB", n=20).within(Interval(1))
    assert with_interval(row) == "1.00 dB"
    assert "no interval is given" in interval_note(1, "20 frames")


def test_the_seed_alone_decides():
    names, values = drawn(3, 12)
    first, again, other = (mean_interval(names, values, seed) for seed in (0, 0, 1))
    assert first == again
    assert first != other
    assert other.low == pytest.approx(first.low, abs=0.2)


def scored(**psnr: list[list[float]]) -> Scores:
    """Scores of methods; a list of frames for each scene."""
    scores = Scores()
    for method, scenes in psnr.items():
        for number, frames in enumerate(scenes):
            for value in frames:
                figures = {metric.name: 0.9 for metric in METRICS} | {"psnr": value}
                scores.kept[method, "foreground"].append(Score("sun", f"s{number}", f"c{number}", figures))
    return scores


def test_a_gain_says_how_far_it_rests_on_a_single_scene():
    pbr = [[20.0], [20.0], [20.0], [20.0], [20.0], [20.0]]
    neural = [[21.0], [21.0], [21.0], [21.0], [21.0], [26.0]]
    rows = {row.metric: row for row in scored(neural=neural, pbr=pbr).rows()}
    gain = rows["neural.gain_over_pbr"]
    assert gain.without_one == pytest.approx((1.0, 2.0))
    assert left_out(gain) == "+1.00 dB to +2.00 dB without any one scene"
    assert rows["pbr.psnr"].without_one is None
    few = {row.metric: row for row in scored(neural=neural[:2], pbr=pbr[:2]).rows()}
    assert few["neural.gain_over_pbr"].without_one is None
    assert left_out(few["neural.gain_over_pbr"]) == ""


def test_a_gain_is_of_differences_on_the_same_frames():
    rng = generator(0, "gains")
    pbr = rng.uniform(20, 40, (8, 5))
    neural = pbr + 1 + 0.1 * rng.normal(size=pbr.shape)
    rows = {row.metric: row for row in scored(neural=neural.tolist(), pbr=pbr.tolist()).rows()}
    gain, alone = rows["neural.gain_over_pbr"], rows["pbr.psnr"]
    low, high = ends(gain)
    assert 0.9 < low <= gain.value <= high < 1.1
    low, high = ends(alone)
    assert high - low > 2
    assert (gain.n, gain.scenes) == (40, 8)
    assert rows["pbr.psnr.sun"].low == alone.low


def test_the_best_of_a_group_is_chosen_anew_in_every_resample():
    """Against the best a gain is at most that against any; where rivals take turns it is less than both."""
    rng = generator(0, "rivals")
    turns = np.where(np.arange(8)[:, None] % 2, 5.0, -5.0)
    neural = 30 + rng.normal(size=(8, 3))
    first, second, third = neural - 3 + turns, neural - 3 - turns, neural - 9
    given = {"neural": neural, **dict.fromkeys(GROUPS["best_simple_baseline"], third)}
    given |= {"pbr": first, "shadow_ratio": second}
    rows = {row.metric: row for row in scored(**{name: psnr.tolist() for name, psnr in given.items()}).rows()}
    best, *each = (
        rows[f"neural.gain_over_{name}"] for name in ("best_simple_baseline", "pbr", "shadow_ratio")
    )
    for row in each:
        assert ends(best)[0] <= ends(row)[0] + 1e-9
        assert ends(best)[1] < ends(row)[1] - 1


def test_guidance_is_drawn_by_scene_too(drawn_clip: Callable[..., Clip]):
    scores = GuidanceScores()
    for seed in range(3):
        for light in ("noon", "softbox"):
            clip = drawn_clip(light, seed)
            clip.frames["irradiance_ref"] = clip.frames["irradiance"].copy()
            if seed != 1:
                clip.frames["irradiance"] = clip.frames["unshadowed"].copy()
            scores.add(clip)
    rows = {row.metric: row for row in scores.rows()}
    leak = rows["guidance.shadow_leak.sun"]
    assert (leak.scenes, leak.low, leak.high) == (3, 0.0, 1.0)
    assert 0 < leak.value < 1
    assert rows["guidance.irradiance_psnr"].scenes == rows["surfels.normal_mae_deg"].scenes == 3


def test_a_scene_without_shadow_says_nothing_of_leaks():
    shadow, sunny = np.array([10, 4, 90, 0]), np.array([0, 0, 100, 10])  # shadowed, leaking, lit, darkened
    rows = {row.metric: row for row in shadow_rows("", [("a", shadow), ("b", sunny), ("c", shadow)], seed=0)}
    leak, darkened = rows["guidance.shadow_leak"], rows["guidance.lit_darkened"]
    assert (leak.value, leak.scenes, leak.low, leak.high) == (0.4, 2, 0.4, 0.4)
    assert darkened.scenes == 3
    assert ends(darkened) == (0.0, 0.1)
    assert [row.metric for row in shadow_rows("", [("b", sunny)], seed=0)] == ["guidance.lit_darkened"]
    assert list(shadow_rows("", [], seed=0)) == []


def test_refinement_is_drawn_by_scene(tmp_path: Path):
    for number, psnr in enumerate((30.0, 31.0, 34.0, 36.0)):
        figures = {"base_color_psnr": psnr, "normal_mae_deg": 1.0, "silhouette_error": 0.01}
        record = {"refinement": {"steps": 9, "before": figures, "after": figures}}
        folder = tmp_path / "scenes" / f"s{number}"
        folder.mkdir(parents=True)
        (folder / "record.json").write_text(json.dumps(record))
    rows = refinement(tmp_path, seed=0)
    after = next(row for row in rows if row.metric == "refinement.base_color_psnr.after")
    assert (after.value, after.low, after.high, after.scenes) == (32.75, 30.0, 36.0, 4)


def test_results_keep_an_interval_and_lack_its_keys_without_one(tmp_path: Path):
    plain = Row(metric="a.b", value=2.0, unit="dB", n=8)
    rows = [plain, plain.model_copy(update={"metric": "a.c"}).within(Interval(4, 1.0, 3.0))]
    Results(benchmark="demo", environment={}, rows=rows).save(tmp_path / "results.json")
    written = json.loads((tmp_path / "results.json").read_text())["rows"]
    assert not {"low", "high", "scenes"} & set(written[0])
    assert (written[1]["low"], written[1]["high"], written[1]["scenes"]) == (1.0, 3.0, 4)
    assert Results.load(tmp_path / "results.json").rows == rows


@pytest.mark.parametrize(
    "ends", [{"low": 1.0}, {"low": 3.0, "high": 1.0, "scenes": 4}, {"low": 1.0, "high": 3.0, "scenes": 1}]
)
def test_half_an_interval_is_refused(ends: dict[str, float]):
    with pytest.raises(ValueError, match="interval"):
        Row(metric="a.b", value=2.0, unit="dB", n=8, **ends)  # type: ignore[arg-type]


def test_intervals_are_written_in_the_unit_of_their_figure():
    def row(value: float, unit: str, low: float, high: float) -> Row:
        return Row(metric="a.b", value=value, unit=unit, n=8).within(Interval(5, low, high))

    assert with_interval(row(34.1, "dB", 32.9, 35.2)) == "34.10 dB [32.90, 35.20]"
    assert with_interval(row(0.005, "fraction", 0.001, 0.009)) == "0.50% [0.10, 0.90]"
    minus = "\N{MINUS SIGN}"
    assert with_interval(row(0.5, "dB", -0.2, 1.2), signed=True) == f"+0.50 dB [{minus}0.20, +1.20]"
    assert with_interval(row(1.5, "deg", 1, 2)) == "1.50° [1.00, 2.00]"


@pytest.mark.parametrize("scenes, said", [(2, "34.10 dB"), (4, "34.10 dB"), (5, "34.10 dB [32.90, 35.20]")])
def test_an_interval_over_fewer_than_five_scenes_is_not_printed(scenes: int, said: str):
    row = Row(metric="a.b", value=34.1, unit="dB", n=99, low=32.9, high=35.2, scenes=scenes)
    assert with_interval(row) == said
    assert ("no interval is given" in interval_note(scenes)) == ("[" not in said)


def test_the_note_says_how_many_scenes_and_that_few_are_few():
    few, many = interval_note(5, "60 frames"), interval_note(30, "900 frames")
    assert "60 frames are 5 independent scenes" in few
    assert "There are 4 scenes" in interval_note(4)
    assert "wide" in few
    assert "900 frames are 30 independent scenes" in many
    assert "wide" not in many
