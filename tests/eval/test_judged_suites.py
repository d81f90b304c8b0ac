"""benchmark=judge and benchmark=video on a suite's folders: who wins, who is absent, what is asked again."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from eval.cli import cli
from eval.judge.loopback import Handler, by_psnr, serving
from eval.protocol.method import Method, write_method
from eval.protocol.suite import Suite
from eval.results import Results
from tron.seeds import generator

pytest.importorskip("openai")


def run(benchmark: str, *arguments: object) -> int:
    with pytest.raises(SystemExit) as end:
        cli([f"benchmark={benchmark}", *map(str, arguments)])
    return int(end.value.code or 0)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory, write_drawn_suite: Callable[..., Path]) -> Path:
    """A suite and two methods: one with little noise and one with more, that flickers too."""
    folder = tmp_path_factory.mktemp("judged")
    suite = Suite.load(write_drawn_suite(folder / "suite", scenes=2, frames=4, size=32))
    for name, sigma, flash in (("fine", 0.02, 0.0), ("coarse", 0.1, 0.2)):
        method = Method(name=name, suite=suite.id, color_space="linear", background="environment")
        with write_method(folder / "methods" / name, method) as out:
            for scene in suite.scenes.values():
                for light in scene.lights:
                    truth = scene.truth(light)
                    noise = generator(1, name, scene.name, light).standard_normal(truth.shape)
                    bright = 1 + flash * (-1.0) ** np.arange(len(truth))[:, None, None, None]
                    out.frames(scene.name, light, np.maximum(truth * bright * (1 + sigma * noise), 0))
    return folder


@pytest.fixture
def judge(place: Path) -> type[Handler]:
    suite = Suite.load(place / "suite")
    truths = [
        suite.display(picture * np.float32(light.exposure))
        for scene in suite.scenes.values()
        for name, light in scene.lights.items()
        for picture in scene.truth(name)
    ]

    class Counting(Handler):
        asked = 0
        judge = staticmethod(by_psnr(truths))

        def do_POST(self) -> None:
            type(self).asked += 1
            super().do_POST()

    return Counting


def given(place: Path, url: str, *more: object) -> list[object]:
    said = [f"suite={place / 'suite'}", f"methods={place / 'methods'}", f"benchmark.endpoint={url}"]
    said += ["benchmark.ours=fine", "benchmark.views=2", "benchmark.seeds=[0,1]", "benchmark.model=psnr"]
    return [*said, *more]


def test_the_better_method_wins_the_truth_wins_over_it_and_answers_are_replayed(
    place: Path, judge: type[Handler], tmp_path: Path
):
    first = tmp_path / "first"
    with serving(judge) as url:
        assert run("judge", *given(place, url, f"output_dir={first}")) == 0
        asked = judge.asked  # type: ignore[attr-defined]
        assert (
            asked == 2 * 8 + 2 * 2 * 2 * 2 * 2 * 2
        )  # controls; scenes, lights, views, seeds, rivals, orders
        assert run("judge", *given(place, url, f"output_dir={first}")) == 0
        assert judge.asked == asked  # type: ignore[attr-defined]
    results = Results.load(first / "results.json")
    assert results.value("judge.win_rate.coarse") == 1
    assert results.value("judge.win_rate.truth") == 0
    assert results.value("judge.control_won") == results.value("judge.fit") == 1
    assert (first / "sent/control-spoiled").is_dir()
    assert "judge.check." in (first / "results.json").read_text()
    assert "fine" in (first / "report.html").read_text()
    again = tmp_path / "again"
    replayed = [
        "benchmark.judge=replay",
        f"benchmark.answers={first / 'answers.jsonl'}",
        f"output_dir={again}",
    ]
    assert run("judge", *given(place, "https://nowhere.invalid/v1", *replayed)) == 0
    assert Results.load(again / "results.json").value("judge.win_rate.coarse") == 1


def test_answers_that_are_not_stored_are_no_mean_of_the_others(
    place: Path, judge: type[Handler], tmp_path: Path
):
    with serving(judge) as url:
        assert run("judge", *given(place, url, f"output_dir={tmp_path}")) == 0
    path = tmp_path / "answers.jsonl"
    kept = [
        line for line in path.read_text().splitlines(True) if '"control-whole"' in line or '"truth"' in line
    ]
    path.write_text("".join(kept))
    assert run("judge", *given(place, "http://x/v1", "benchmark.judge=replay", f"benchmark.answers={path}",
                               f"output_dir={tmp_path}")) == 0  # fmt: skip
    results = Results.load(tmp_path / "results.json")
    assert results.value("judge.win_rate.truth") == 0
    assert results.value("judge.win_rate.coarse") is None
    assert results.absent["judge.win_rate.coarse"] == "32 answers are not stored"


def test_a_judge_that_loses_the_control_ranks_nothing(place: Path, tmp_path: Path):
    handler = type("Blind", (Handler,), {"judge": staticmethod(lambda *_: "TIE")})
    with serving(handler) as url:
        assert run("judge", *given(place, url, f"output_dir={tmp_path}")) == 0
    results = Results.load(tmp_path / "results.json")
    assert results.value("judge.control_won") == results.value("judge.fit") == 0
    assert results.value("judge.win_rate.coarse") is None
    assert "unfit" in results.absent["judge.win_rate.coarse"]
    assert "unfit" in (tmp_path / "report.html").read_text()
    assert len((tmp_path / "answers.jsonl").read_text().splitlines()) == 16, "methods are not asked about"


@pytest.mark.parametrize(
    "lacking, said",
    [
        ("methods=null", "suite needs methods too"),
        ("benchmark.ours=nobody", "no method nobody; there are coarse, fine"),
        ("benchmark.model=null", "suite needs model too"),
        ("benchmark.endpoint=null", "suite needs a judge"),
        ("benchmark.judge=replay", "no stored answers"),
    ],
)
def test_what_is_not_said_is_one_line_before_anything_is_asked(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], lacking: str, said: str
):
    assert run("judge", *given(place, "http://127.0.0.1:1/v1", lacking, f"output_dir={tmp_path}")) == 2
    assert said in capsys.readouterr().err
    assert not list(tmp_path.glob("*.jsonl"))


def test_methods_with_a_fault_are_absent_by_name(place: Path, judge: type[Handler], tmp_path: Path):
    methods = tmp_path / "methods"
    shutil.copytree(place / "methods", methods)
    next((methods / "coarse").glob("*/*/0001.exr")).unlink()
    with serving(judge) as url:
        assert run("judge", *given(place, url, f"methods={methods}", f"output_dir={tmp_path / 'j'}")) == 0
    results = Results.load(tmp_path / "j/results.json")
    assert "0001.exr is missing" in results.absent["judge.win_rate.coarse"]
    assert results.value("judge.win_rate.truth") == 0
    assert run("video", f"suite={place / 'suite'}", f"methods={methods}", f"output_dir={tmp_path / 'v'}") == 0
    results = Results.load(tmp_path / "v/results.json")
    assert "0001.exr is missing" in results.absent["video.warping.coarse"]
    assert results.value("video.warping.coarse") is None
    assert results.value("video.warping.fine") is not None


def test_clips_are_held_beside_the_truth(place: Path, tmp_path: Path):
    assert (
        run("video", f"suite={place / 'suite'}", f"methods={place / 'methods'}", f"output_dir={tmp_path}")
        == 0
    )
    results = Results.load(tmp_path / "results.json")
    for measure in ("warping", "flicker", "far"):
        fine, coarse = (results.value(f"video.{measure}_excess.{name}") for name in ("fine", "coarse"))
        assert fine is not None
        assert coarse is not None
        assert 1 < fine < coarse
        assert results.value(f"video.{measure}_excess.truth") is None
    assert results.value("video.order_correct") == 1
    assert set(results.absent) == {
        f"vbench.{each}"
        for each in (
            "motion_smoothness",
            "subject_consistency",
            "background_consistency",
            "aesthetic_quality",
            "imaging_quality",
        )
    }
    assert "no benchmark.vbench" in (tmp_path / "report.html").read_text()
