"""The benchmark `relighting` on a drawn data set, end to end, with untrained networks: both return pbr."""

import json
from pathlib import Path

import numpy as np
import pytest

from eval.cli import cli
from eval.relighting.baselines import BASELINES, METHODS
from eval.relighting.benchmark import Relighting, choose_clips
from eval.relighting.scores import GROUPS, METRICS, Score, Scores
from eval.report.outcome import Outcome
from eval.report.page import Pictures, Table
from eval.results import Results
from tron.images import read_image

REQUIRED = [
    *(
        f"{method}.{metric}{region}"
        for method in (each.name for each in METHODS)
        for metric in (each.name for each in METRICS)
        for region in ("", "_full")
    ),
    *(
        f"neural.gain_over_{group}{region}{family}"
        for group in ("best_simple_baseline", "best_baseline")
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
        renderer=weights / "tiny.safetensors",
        pixel_mlp=weights / "pixel_mlp.safetensors",
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


def test_every_method_and_metric_of_the_lists_is_in_rows_tables_and_pictures(outcome: Outcome):
    rows = {row.metric for row in outcome.rows}
    blocks = {section.name: section.blocks for section in outcome.sections}
    tables = [block for block in (*blocks["results"], *blocks["lights"]) if isinstance(block, Table)]
    pictures = next(block for block in blocks["pictures"] if isinstance(block, Pictures))
    for method in METHODS:
        assert {f"{method.name}.{metric.name}" for metric in METRICS} <= rows
        assert all(method.title in [row[0].text for row in table.cells] for table in tables)
    for table in tables[:2]:
        assert {metric.title for metric in METRICS} <= set(table.headings)
    shown = {baseline.title for baseline in BASELINES if baseline.pictured}
    assert shown <= {picture.title for picture in pictures.pictures}
    for baseline in BASELINES:
        assert f"neural.gain_over_{baseline.name}" in rows


def test_networks_that_return_pbr_score_as_pbr(outcome: Outcome):
    found = values(outcome)
    for region in ("", "_full"):
        assert found[f"neural.psnr{region}"] == pytest.approx(found[f"pbr.psnr{region}"], abs=1e-3)
        assert found[f"pixel_mlp.psnr{region}"] == pytest.approx(found[f"pbr.psnr{region}"], abs=1e-3)
        best = max(found[f"{name}.psnr{region}"] for name in GROUPS["best_simple_baseline"])
        gain = found[f"neural.gain_over_best_simple_baseline{region}"]
        assert gain == pytest.approx(found[f"neural.psnr{region}"] - best, abs=1e-9)


def test_baselines_rank_as_they_must_in_a_world_of_shadows(outcome: Outcome):
    found = values(outcome)
    assert found["pbr.psnr"] < found["shadow_ratio.psnr"] < found["affine_ratio.psnr"]
    assert found["affine.psnr"] < found["affine_ratio.psnr"]


def test_every_shown_clip_has_its_pictures(outcome: Outcome):
    groups = {
        section.name: [block for block in section.blocks if isinstance(block, Pictures)]
        for section in outcome.sections
    }
    assert len(groups["pictures"]) == 3
    titles = [picture.title for picture in groups["pictures"][0].pictures]
    assert titles[:2] == ["pbr", "irradiance"]
    assert titles[-3:] == ["neural renderer", "path-traced truth", "|neural renderer − truth| ×3"]
    assert all(picture.alt for group in groups["pictures"] for picture in group.pictures)
    assert {"irradiance, surfels", "shadow errors", "normals, true"} <= {
        picture.title for picture in groups["guidance"][0].pictures
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
    assert not [name for name in metrics if name.startswith("pixel_mlp") or "best_baseline" in name]
    assert results.find("neural.gain_over_best_simple_baseline").reference == "target: at least 3 dB"  # type: ignore[union-attr]
    assert "null" not in json.dumps([row.value for row in results.rows])
    picture = read_image(next(path for path in (tmp_path / "pictures").glob("*-guidance.png")))
    assert picture.shape == (2 * 32, 4 * 32, 3)
    page = (tmp_path / "report.html").read_text()
    assert "12 frames are 2 independent scenes" in page
    row = results.find("neural.psnr_full")
    assert row is not None
    assert f"{row.value:.2f} [{row.low:.2f}, {row.high:.2f}]" in page
    out = capsys.readouterr().out
    assert f"{row.value:.2f} dB [{row.low:.2f}, {row.high:.2f}]" in out
    assert f"report: {tmp_path / 'report.html'}" in out
    assert "neural.psnr" in out
    assert "not measured" in out
    assert (tmp_path / "report.html").stat().st_size > 10_000


@pytest.mark.parametrize(
    "arguments, said",
    [
        (["benchmark=relighting"], "no data set to evaluate on"),
        (["dataset=/nowhere"], "manifest.json"),
        (["dataset={dataset}", "renderer=/nowhere/x.safetensors"], "/nowhere/x.safetensors"),
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
        for method, psnr in (("neural", 20 + gain), ("pbr", 20.0)):
            scores.kept[method, "foreground"].append(Score("sun", "scene", clip, {"psnr": psnr}))
    assert choose_clips(scores, 3) == ["a", "c", "e"]
    assert choose_clips(scores, 1) == ["a"]
    assert choose_clips(scores, 9) == ["a", "b", "c", "d", "e"]
    assert choose_clips(scores, 0) == []


def test_evaluation_is_the_same_twice_and_needs_no_network(outcome: Outcome, dataset: Path, tmp_path: Path):
    again, first = values(Relighting(dataset=dataset, pictures=0).run(tmp_path)), values(outcome)
    assert {name.split(".")[0] for name in first.keys() - again} == {"neural", "pixel_mlp"}
    assert again == {name: first[name] for name in again}
    assert all(np.isfinite(list(first.values())))
