"""The demo's orchestration; stand-ins for the two long commands copy what those would make."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from eval import stages as stages_module
from eval.cli import cli
from eval.demo import Demo
from eval.relighting.benchmark import Relighting
from eval.results import Results, Target

STAND_IN = """#!{python}
import pathlib, shutil, sys
given = dict(argument.split("=", 1) for argument in sys.argv[1:])
out = pathlib.Path(given["output_dir"])
with open({log!r}, "a") as log:
    log.write(" ".join(["{name}", *sys.argv[1:]]) + "\\n")
{body}
"""
MAKE = "shutil.copytree({dataset!r}, out)\nprint('12 clips')"
TRAIN = """
out.mkdir(parents=True)
kind = given["renderer"].replace("unet", "tiny") + ("_of_two" if "renderer.config.guidance" in given else "")
shutil.copy(pathlib.Path({weights!r}) / (kind + ".safetensors"), out / "renderer.safetensors")
"""


@pytest.fixture
def stand_ins(tmp_path: Path, dataset: Path, weights: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Puts the stand-ins in place; returns the file that lists the commands that ran."""
    log = tmp_path / "commands.txt"
    for name, body in (
        ("tron-datagen", MAKE.format(dataset=str(dataset))),
        ("tron-train", TRAIN.format(weights=str(weights))),
    ):
        path = tmp_path / name
        path.write_text(STAND_IN.format(python=sys.executable, log=str(log), name=name, body=body))
        path.chmod(0o755)
    monkeypatch.setattr(stages_module, "script_path", lambda name: str(tmp_path / name))
    return log


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as end:
        cli(["benchmark=demo", "benchmark.relighting.pictures=1", *arguments])
    return end.value.code  # type: ignore[return-value]


def test_the_demo_goes_from_nothing_to_a_report_and_a_second_run_only_evaluates(
    stand_ins: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
):
    out = tmp_path / "demo"
    times = ["benchmark.max_seconds=7", "benchmark.pixel_mlp_seconds=3"]
    assert run(f"output_dir={out}", *times) == 0
    commands = stand_ins.read_text().splitlines()
    assert commands[0] == f"tron-datagen experiment=demo output_dir={out / 'dataset'}"
    assert commands[-1].startswith("tron-datagen experiment=demo train.scenes=0 ")
    trained = sorted(command.split()[2:] for command in commands[1:-1])
    assert [words[0] for words in trained] == ["renderer=pixel_mlp", "renderer=unet", "renderer=unet"]
    assert sum("renderer.config.guidance=[pbr,irradiance]" in words for words in trained) == 1
    limits = {
        name: {command.split()[-1] for command in commands if f"renderer={name} " in command}
        for name in ("unet", "pixel_mlp")
    }
    assert limits == {"unet": {"max_seconds=7"}, "pixel_mlp": {"max_seconds=3"}}
    results = Results.load(out / "results.json")
    assert results.benchmark == "demo"
    parts = [results.value(f"demo.{stage}_seconds") for stage in ("datagen", "train", "large", "eval")]
    assert all(parts)
    assert results.value("demo.seconds") == pytest.approx(sum(parts))  # type: ignore[arg-type]
    for method in ("neural", "neural_lit", "lit", "lit.supersampled", "lit.reflections", "pixel_mlp_lit"):
        assert results.find(f"{method}.psnr") is not None
    scenes = results.find("datagen.seconds_per_scene.demo")
    assert scenes is not None
    assert scenes.n == 6, "two scenes of each of three splits"
    assert scenes.value == pytest.approx(parts[0] / 6)  # type: ignore[operator]
    said = capfd.readouterr().out
    assert "[datagen] 12 clips" in said
    assert f"report: {out / 'report.html'}" in said
    assert "demo.seconds" in said
    assert results.find("demo.seconds").reference == "target: at most 900 s"  # type: ignore[union-attr]
    assert results.find("surfels.normal_mae_deg").reference == "target: at most 5 deg"  # type: ignore[union-attr]
    html = (out / "report.html").read_text()
    assert "Where the time went" in html
    assert "the whole demo, after set-up" in html
    assert "Larger frames, by the renderers that ship" in html
    assert "network that starts from lit, scene" in html

    assert run(f"output_dir={out}", *times) == 0
    assert stand_ins.read_text().splitlines() == commands
    again = Results.load(out / "results.json")
    for stage in ("datagen", "train"):
        assert again.value(f"demo.{stage}_seconds") == results.value(f"demo.{stage}_seconds")
    stages = json.loads((out / "stages.json").read_text())["stages"]
    assert list(stages) == ["datagen", "train", "large", "eval"]
    assert all(stage["finished"] for stage in stages.values())


def test_a_stage_that_fails_ends_the_demo_with_its_words_and_code(
    stand_ins: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
):
    (tmp_path / "tron-train").write_text(
        f"#!{sys.executable}\nimport sys\nsys.exit(print('tron-train: out of luck', file=sys.stderr) or 7)\n"
    )
    out = tmp_path / "demo"
    assert run(f"output_dir={out}") == 7
    assert "failed with exit code 7: tron-train: out of luck" in capfd.readouterr().err
    assert not (out / "results.json").exists()
    assert len(stand_ins.read_text().splitlines()) == 1  # the data set is made, and is kept


def test_other_settings_do_not_mix_with_a_finished_data_set(
    stand_ins: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
):
    (tmp_path / "tron-train").write_text(f"#!{sys.executable}\nraise SystemExit(1)\n")
    out = tmp_path / "demo"
    assert run(f"output_dir={out}") == 1  # the data set is finished, the training is not
    assert run(f"output_dir={out}", 'benchmark.datagen=["experiment=paper"]') == 2
    assert "output_dir holds a stage made with" in capfd.readouterr().err


@pytest.mark.parametrize(
    "given, judged",
    [
        ({}, True),
        ({"datagen": ["experiment=mine"]}, False),
        ({"train": ["experiment=tiny"]}, False),
    ],
)
def test_the_demos_targets_judge_the_demos_own_recipe_alone(given: dict[str, Any], judged: bool):
    target = Target(metric="lit.psnr", bound="at least", value=35.5)
    demo = Demo(relighting=Relighting(dataset=None), targets=[target], **given)
    assert demo.bounds() == ([target] if judged else [])
