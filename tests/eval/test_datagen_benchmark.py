"""The benchmark of the data engine: rows and pages from known records, and the real command at toy size."""

import json
from pathlib import Path

import numpy as np
import pytest

from eval import stages
from eval.cli import cli
from eval.datagen import counted_scenes
from eval.results import Results
from tron.io.images import write_image


def run(*arguments: str) -> None:
    with pytest.raises(SystemExit) as end:
        cli(["benchmark=datagen", *arguments])
    assert end.value.code == 0


@pytest.mark.long
def test_frames_are_counted_of_what_the_command_makes(tmp_path: Path):
    recipe = [
        *(
            "train_b.scenes=0",
            "validation.scenes=0",
            "test.scenes=0",
            "train.scenes=3",
            "train.lights=[overcast]",
        ),
        *(
            "train.path_spp=4",
            "train.guidance_spp=2",
            "views=4",
            "view_width=24",
            "view_height=24",
            "surfels=500",
        ),
        *("mesh_edge=0.2", "environment_height=32", "objects=[1,1]", "refine_steps=2"),
    ]
    typed = json.dumps(recipe).replace(", ", ",")
    sizes = ["~benchmark.sizes", '+benchmark.sizes={16: ["train.frames=2"]}']  # else those of the recipe too
    run(f"benchmark.throughput={typed}", *sizes, f"output_dir={tmp_path}")
    results = Results.load(tmp_path / "results.json")
    for metric in ("frames_per_hour.16", "seconds_per_frame.path_trace.16"):
        assert (results.value(metric) or 0) > 0
    page = (tmp_path / "report.html").read_text()
    assert '<section id="throughput">' in page
    assert '<section id="stages">' in page
    assert not (tmp_path / "throughput_16").exists(), "the dataset is removed"


def test_frames_an_hour_leave_out_the_scene_that_compiles():
    records = [
        {"scene": name, "worker": worker, "made": made, "seconds": {"build": 1.0}}
        for name, worker, made in (("a", "x", True), ("b", "y", True), ("c", "x", True), ("d", "y", False))
    ]
    assert [each["scene"] for each in counted_scenes(records)] == ["c"]
    assert [each["scene"] for each in counted_scenes(records[:2])] == ["a", "b"], "where there are no others"


def test_equal_errors_are_the_data_engines_record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The data engine is asked to make scenes once, and to judge them every time; its ratios become rows."""
    asked = []

    def work(children):
        (child,) = children
        asked.append(child.arguments)
        dataset = tmp_path / "models"
        (dataset / "equal_error").mkdir(parents=True, exist_ok=True)
        write_image(dataset / "equal_error" / "a-l0.png", np.full((4, 12, 3), 0.5, np.float32))
        ways = {
            name: {
                "error": 0.02,
                "seconds": 1.0,
                "paths": 8.0,
                "path_seconds": 2.5,
                "ratio": ratio,
                "ratio_with_bake": ratio + 0.1,
            }
            for name, ratio in (("lit_preview", 0.4), ("lit_16_rays", 1.2))
        }
        cases = [{"scene": name, "light": "dusk", "ways": ways} for name in ("a", "b")]
        (dataset / "equal_error.json").write_text(json.dumps({"cases": cases}))

    monkeypatch.setattr(stages, "run_together", work)
    command = ["benchmark.parts=[equal_error]", f"output_dir={tmp_path}"]
    for _ in range(2):
        run(*command, 'benchmark.equal_error=["experiment=models","assets=x"]')
    folder = f"output_dir={tmp_path / 'models'}"
    making = ["experiment=models", "assets=x", folder]
    judging = [*making, "mode=equal_error"]
    assert [list(each) for each in asked] == [making, judging, judging]
    results = Results.load(tmp_path / "results.json")
    row = results.find("guidance.ratio_to_path_tracing.equal_error")
    assert row is not None
    assert (row.value, row.scenes, row.ratio) == (0.4, 2, 0.8)
    assert results.value("guidance.ratio_to_path_tracing.equal_error.lit_16_rays") == 1.2
    assert results.value("guidance.ratio_to_path_tracing.equal_error.with_bake") == 0.5
    page = (tmp_path / "report.html").read_text()
    assert 'id="equal-error"' in page
