"""The benchmark `relighting` on a drawn data set, end to end; its untrained networks return lit or pbr."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from eval.cli import cli
from eval.relighting.baselines import BASELINES, FINER, METHODS
from eval.relighting.benchmark import Relighting, stand_ins
from eval.relighting.judging import choose_clips
from eval.relighting.scores import GROUPS, METRICS, Score, Scores
from eval.report.outcome import Outcome
from eval.results import Results
from tron.errors import TronError
from tron.io.images import read_image
from tron.shards.manifest import Manifest

REQUIRED = [
    *(
        f"{method}.{metric.name}{region}"
        for method in (each.name for each in METHODS)
        for metric in METRICS
        for region in ("", "_full")
        if region == "" or "frame" in metric.regions
    ),
    *(
        f"{network}.gain_over_{group}{region}{family}"
        for network in ("neural", "neural_lit")
        for group in (
            "best_simple_baseline",
            "best_direct_baseline",
            "best_fit_on_lit",
            "best_baseline",
            "lit",
        )
        for region in ("", "_full")
        for family in ("", ".sun", ".studio", ".overcast")
    ),
    *("guidance.irradiance_psnr", "guidance.irradiance_psnr.sun", "guidance.shadow_leak"),
    *("guidance.lit_darkened", "surfels.base_color_psnr", "surfels.normal_mae_deg"),
]


@pytest.fixture(scope="module")
def outcome(dataset: Path, weights: Path, tmp_path_factory: pytest.TempPathFactory) -> Outcome:
    benchmark = Relighting(
        dataset=dataset,
        renderer=(weights / "tiny_of_two.safetensors", weights / "tiny.safetensors"),
        pixel_mlp=(weights / "pixel_mlp.safetensors", weights / "pixel_mlp_of_two.safetensors"),
        pictures=3,
    )
    return benchmark.run(tmp_path_factory.mktemp("output"))


def values(outcome: Outcome) -> dict[str, float]:
    return {row.metric: row.value for row in outcome.rows}


def test_every_row_of_the_issue_is_there(outcome: Outcome):
    rows = {row.metric: row for row in outcome.rows}
    assert [metric for metric in REQUIRED if metric not in rows] == []
    assert len(rows) == len(outcome.rows)
    assert rows["neural.psnr"].n == 2 * 3 * 2  # scenes, lights, frames
    assert rows["neural.psnr.sun"].n == 2 * 2
    averaged = [
        row for row in outcome.rows if row.metric.startswith(("neural", "pbr", "guidance", "surfels"))
    ]
    assert all(row.scenes == 2 and row.low is not None for row in averaged)


def test_every_method_and_metric_of_the_lists_is_in_rows_and_pictures(outcome: Outcome):
    rows = {row.metric for row in outcome.rows}
    for method in METHODS:
        assert {f"{method.name}.{metric.name}" for metric in METRICS} <= rows
    first = next(group for group in outcome.pictures if group.section == "pictures")
    shown = {baseline.title for baseline in BASELINES if baseline.pictured}
    assert shown <= {caption.title for caption in first.captions}
    for baseline in (*BASELINES, *FINER):
        assert f"neural.gain_over_{baseline.name}" in rows
        assert f"neural_lit.gain_over_{baseline.name}" in rows
    assert {"neural_lit.gain_over_neural", "lit.gain_over_shadowed"} <= rows


def test_networks_score_as_the_buffer_that_they_return(outcome: Outcome):
    found = values(outcome)
    for region in ("", "_full"):
        for network in ("neural", "pixel_mlp"):
            assert found[f"{network}.psnr{region}"] == pytest.approx(found[f"pbr.psnr{region}"], abs=1e-3)
            lit = found[f"lit.psnr{region}"]
            assert found[f"{network}_lit.psnr{region}"] == pytest.approx(lit, abs=1e-3)
        best = max(found[f"{name}.psnr{region}"] for name in GROUPS["best_simple_baseline"])
        gain = found[f"neural.gain_over_best_simple_baseline{region}"]
        assert gain == pytest.approx(found[f"neural.psnr{region}"] - best, abs=1e-9)


def test_baselines_rank_as_they_must_in_a_world_of_shadows(outcome: Outcome):
    found = values(outcome)
    assert found["pbr.psnr"] < found["shadow_ratio.psnr"] < found["affine_ratio.psnr"]
    assert found["affine.psnr"] < found["affine_ratio.psnr"] < found["affine_lit.psnr"]
    assert found["shadowed.psnr"] < found["lit.psnr"] < found["lit.reflections.psnr"]
    assert found["lit.gain_over_shadowed"] == pytest.approx(found["lit.psnr"] - found["shadowed.psnr"])


def test_every_shown_clip_has_its_pictures(outcome: Outcome):
    groups = {
        name: [each for each in outcome.pictures if each.section == name] for name in ("pictures", "guidance")
    }
    assert len(groups["pictures"]) == 3
    titles = [caption.title for caption in groups["pictures"][0].captions]
    assert titles[:2] == ["pbr", "irradiance"]
    assert titles[-5:] == [
        "|lit − truth| ×3",
        "lit",
        "neural renderer",
        "path-traced truth",
        "|neural renderer − truth| ×3",
    ]
    assert "lit, filtered" in titles
    assert len(titles) == 13
    assert all(caption.alt for group in groups["pictures"] for caption in group.captions)
    assert {"irradiance, surfels", "shadow errors", "normals, true"} <= {
        caption.title for caption in groups["guidance"][0].captions
    }


def test_the_command_writes_results_report_and_pictures(
    dataset: Path, weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    with pytest.raises(SystemExit) as end:
        cli(
            [
                "benchmark=relighting",
                f"dataset={dataset}",
                f"renderer={weights / 'tiny.safetensors'}",
                f"output_dir={tmp_path}",
                "benchmark.pictures=1",
            ]
        )
    assert end.value.code == 0
    results = Results.load(tmp_path / "results.json")
    assert results.benchmark == "relighting"
    assert {"cpu", "commit", "packages"} <= set(results.environment)
    metrics = {row.metric for row in results.rows}
    assert not [name for name in metrics if name.startswith(("pixel_mlp", "neural."))]
    assert not [name for name in metrics if name.split(".")[-1] in ("best_baseline", "best_fit_on_lit")]
    assert [row.reference for row in results.rows if row.reference] == [], "the demo's targets judge the demo"
    assert "null" not in json.dumps([row.value for row in results.rows])
    picture = read_image(next(path for path in (tmp_path / "pictures").glob("*-guidance.png")))
    assert picture.shape == (2 * 32, 4 * 32, 3)
    page = (tmp_path / "report.html").read_text()
    assert "12 frames are 2 independent scenes" in page
    row = results.find("neural_lit.psnr_full")
    assert row is not None
    assert f"{row.value:.2f} dB" in page
    for method in METHODS:
        if method.name in {name.partition(".psnr")[0] for name in metrics}:
            assert page.count(f">{method.title}</th>") >= 2
    assert "no interval is given" in page
    assert "target" not in page.lower()
    assert page.index("<img") < page.index('class="tiles"'), "the first picture is on the first screen"
    out = capsys.readouterr().out
    assert f"{row.value:.2f} dB " in out
    assert f"report: {tmp_path / 'report.html'}" in out
    assert "neural_lit.psnr" in out
    assert "not measured" not in out
    assert (tmp_path / "report.html").stat().st_size > 10_000


@pytest.mark.parametrize(
    "arguments, said",
    [
        (["benchmark=relighting"], "no data set to evaluate on"),
        (["dataset=/nowhere"], "manifest.json"),
        (["dataset={dataset}", "renderer=/nowhere/x.safetensors"], "/nowhere/x.safetensors"),
        (["dataset={dataset}", "renderer=[/nowhere/y.safetensors]"], "/nowhere/y.safetensors"),
        (["dataset={dataset}", "benchmark.ood=/nowhere"], "manifest.json"),
        (["dataset={dataset}", "benchmark.test_split=elsewhere"], "no split 'elsewhere'"),
        (["dataset={dataset}", "benchmark.train_splits=[elsewhere]"], "no split 'elsewhere'"),
        (["benchmark=nonsense"], "unknown benchmark 'nonsense'"),
        (["benchmark.picture=3"], "did you mean 'benchmark.pictures'?"),
        (["benchmark.pictures=-1"], "benchmark.pictures"),
        (["threads=none"], "threads"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(
    arguments: list[str], said: str, dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    arguments = [argument.format(dataset=dataset) for argument in arguments]
    with pytest.raises(SystemExit) as end:
        cli([*arguments, f"output_dir={tmp_path / 'out'}"])
    assert end.value.code == 2
    err = capsys.readouterr().err
    assert said in err
    assert err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_shown_clips_span_the_ranking_from_the_worst_to_the_best():
    scores = Scores()
    for clip, gain in (("c", 3.0), ("a", 1.0), ("e", 5.0), ("b", 2.0), ("d", 4.0)):
        for method, psnr in (("neural_lit", 20 + gain), ("lit", 20.0)):
            scores.kept[method, "foreground"].append(Score("sun", "scene", clip, {"psnr": psnr}))
    assert choose_clips(scores, 3) == ["a", "c", "e"]
    assert choose_clips(scores, 1) == ["a"]
    assert choose_clips(scores, 9) == ["a", "b", "c", "d", "e"]
    assert choose_clips(scores, 0) == []


def test_evaluation_is_the_same_twice_and_needs_no_network(outcome: Outcome, dataset: Path, tmp_path: Path):
    again, first = values(Relighting(dataset=dataset, pictures=0).run(tmp_path)), values(outcome)
    missing = {name.split(".")[0] for name in first.keys() - again}
    assert missing == {"neural", "neural_lit", "pixel_mlp", "pixel_mlp_lit"}
    assert again == {name: first[name] for name in again}
    assert all(np.isfinite(list(first.values())))


def test_two_weights_of_one_method_are_refused_by_name(dataset: Path, weights: Path, tmp_path: Path):
    twice = (weights / "tiny.safetensors", weights / "tiny.safetensors")
    with pytest.raises(TronError, match="two weights of neural_lit"):
        Relighting(dataset=dataset, renderer=twice).run(tmp_path)


@pytest.mark.long
def test_data_of_another_kind_gives_rows_of_its_own_by_the_same_fits(
    outcome: Outcome, dataset: Path, weights: Path, write_dataset: Callable[..., Path], tmp_path: Path
):
    other = write_dataset(tmp_path / "other", scenes=3)
    benchmark = Relighting(
        dataset=dataset,
        renderer=weights / "tiny.safetensors",
        pixel_mlp=weights / "pixel_mlp.safetensors",
        ood=other,
        pictures=1,
    )
    found = benchmark.run(tmp_path / "out")
    rows = {row.metric: row for row in found.rows}
    for metric in (
        "lit.psnr",
        "shadowed.psnr",
        "lit.gain_over_shadowed",
        "neural_lit.gain_over_best_baseline",
    ):
        assert rows[f"{metric}.ood"].scenes == 3
        assert rows[metric].value == values(outcome)[metric]
    assert rows["lit.gain_over_shadowed.ood"].low is not None
    # its first two scenes are those of the data set itself
    alone = values(Relighting(dataset=dataset, ood=dataset, pictures=0).run(tmp_path / "same"))
    assert all(alone[f"{name}.ood"] == value for name, value in alone.items() if f"{name}.ood" in alone)
    assert alone["affine_lit.psnr.ood"] == alone["affine_lit.psnr"]
    assert [each.section for each in found.pictures].count("ood") == 1
    assert len(list((tmp_path / "out" / "pictures").glob("ood-*.png"))) == 1


def test_a_renderer_of_two_buffers_alone_is_the_one_that_is_reported(
    dataset: Path, weights: Path, tmp_path: Path
):
    found = Relighting(dataset=dataset, renderer=weights / "tiny_of_two.safetensors", pictures=1).run(
        tmp_path
    )
    assert "neural.gain_over_best_simple_baseline" in values(found)
    shown = next(each for each in found.pictures if each.section == "pictures")
    assert shown.captions[-1].title == "|neural renderer of two buffers − truth| ×3"


@pytest.fixture
def benchmark_alone(dataset: Path, tmp_path: Path) -> Path:
    """The data set without its training splits."""
    folder = tmp_path / "alone"
    folder.mkdir()
    whole = Manifest.load(dataset)
    kept = whole.of_split("test")
    for entry in kept:
        (folder / entry.name).write_bytes((dataset / entry.name).read_bytes())
    whole.model_copy(update={"shards": kept}).save(folder)
    return folder


def test_a_benchmark_without_training_data_is_judged_by_the_fits_of_another_data_set(
    benchmark_alone: Path, dataset: Path, tmp_path: Path
):
    with pytest.raises(TronError, match=r"no split train to fit.*benchmark\.fitted_on=DIR"):
        Relighting(dataset=benchmark_alone).run(tmp_path / "none")
    found = Relighting(dataset=benchmark_alone, fitted_on=dataset, pictures=0).run(tmp_path / "out")
    assert values(found) == values(Relighting(dataset=dataset, pictures=0).run(tmp_path / "same"))


def test_the_report_says_how_many_named_assets_are_stand_ins(benchmark_alone: Path):
    assert stand_ins(benchmark_alone) == ""
    found = {"title": "TRON-Synth", "maps": 33, "models": 29, "empty_maps": ["a", "b"], "empty_models": 1}
    (benchmark_alone / "sources.json").write_text(json.dumps({"stand_ins": found}))
    assert stand_ins(benchmark_alone) == "TRON-Synth: 3 of 62 named assets are procedural stand-ins."
    (benchmark_alone / "sources.json").write_text("[]")
    with pytest.raises(TronError, match=r"sources\.json is damaged"):
        stand_ins(benchmark_alone)
