"""The way into every command, tried on a toy one: what a user types wrong costs one line, not a traceback."""

import json
import logging
import pstats
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

import pytest
import yaml
from pydantic import BaseModel, ConfigDict, Field, model_validator

from tron.cli.command_line import ANEW, command
from tron.errors import TronError
from tron.runtime import activate

CONFIG = """
defaults:
  - _self_
  - lens: wide
  - optional experiment: null
output_dir: ???
frames: 3
quality: preview
note: null
trajectory:
  turns: 2
stages:
  - {name: first, steps: 5}
cluster:
  _target_: some.Cluster
  workers: 4
  names: [averylongname, averylongname, averylongname, averylongname, averylongname]
"""


class Trajectory(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    turns: int = Field(description="Turns around the target.")


class Lens(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    fov_deg: float = Field(gt=0, description="Horizontal field of view, degrees.")


class Stage(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    name: str = Field(description="What it is called.")
    steps: int = Field(description="How long it lasts.")


class Settings(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    output_dir: Path = Field(description="Folder of the results.")
    frames: int = Field(ge=1, description="Number of frames.")
    quality: Literal["preview", "final"] = Field(description="How many rays are spent.")
    trajectory: Trajectory
    lens: Lens
    stages: list[Stage] = Field(description="One after the other.")
    cluster: dict[str, Any] = Field(description="Where it runs.")
    note: str | None = Field(default=None, description="Free text.")

    @model_validator(mode="after")
    def _consistent(self) -> "Settings":
        if self.quality == "final" and self.frames > 100:
            raise ValueError("quality=final takes at most 100 frames")
        return self


Run = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def toy_conf(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    folder = tmp_path_factory.mktemp("packages")
    for name, text in {
        "toy_conf/__init__.py": "",
        "toy_conf/config.yaml": CONFIG,
        "toy_conf/lens/wide.yaml": "# 90 degrees\nfov_deg: 90\n",
        "toy_conf/lens/tele.yaml": "fov_deg: 20\n",
        "toy_conf/experiment/demo.yaml": "# @package _global_\n# Two frames, quickly.\nframes: 2\n",
    }.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    sys.path.insert(0, str(folder))
    yield "toy_conf"
    sys.path.remove(str(folder))


@pytest.fixture
def run(toy_conf: str, capsys: pytest.CaptureFixture[str], monkeypatch, tmp_path: Path) -> Run:
    """Runs the toy command in an empty folder: exit code, stdout, stderr."""
    monkeypatch.chdir(tmp_path)

    def main(settings: Settings) -> int | None:
        """Take a toy picture.

        A second paragraph.
        """
        seen.append(settings)
        return action(settings)

    def run(*arguments: str, does: Callable[[Settings], int | None] = lambda _: None):
        nonlocal action
        action = does
        seen.clear()
        with pytest.raises(SystemExit) as stop:
            command("tron-toy", toy_conf, Settings, main)(arguments)
        out, err = capsys.readouterr()
        return int(stop.value.code or 0), out, err

    action: Callable[[Settings], int | None] = lambda _: None  # noqa: E731
    seen: list[Settings] = []
    run.seen = seen  # type: ignore[attr-defined]
    return run


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["framez=3"], ["'framez'", "did you mean 'frames'?"]),
        (["turns=3"], ["'turns'", "did you mean 'trajectory.turns'?"]),
        (["trajectory.turnz=3"], ["'trajectory.turnz'", "did you mean 'trajectory.turns'?"]),
        (["+extra=3", "output_dir=o"], ["'extra'"]),
        (["expriment=demo"], ["'expriment'", "did you mean 'experiment'?"]),
        (["experiment=dem"], ["experiment 'dem'", "did you mean 'demo'?"]),
        (["lens=fisheye"], ["lens 'fisheye'", "tele, wide"]),
        (["lens=null"], ["lens 'none'", "tele, wide"]),
        (["lens={fov_deg: 3}"], ["unknown lens", "tele, wide"]),
        (["output_dir=o", "frames=three"], ["'frames'", "'three'", "integer"]),
        (["output_dir=o", "frames=0"], ["'frames'", "greater than or equal to 1"]),
        (["output_dir=o", "stages.0.stepz=1"], ["'stages.0.stepz'", "did you mean 'stages.0.steps'?"]),
        (["output_dir=o", "stages.0.steps=x"], ["'stages.0.steps'", "'x'", "integer"]),
        (["output_dir=o", "stages=[{name: a}]"], ["'stages.0.steps' has no value"]),
        (["output_dir=o", "frames=null"], ["'frames' has no value"]),
        (["output_dir=o", "~frames"], ["'frames' has no value"]),
        (["output_dir=o", "lens.fov_deg=-1"], ["'lens.fov_deg'", "greater than 0"]),
        (["output_dir=o", "quality=best"], ["'quality'", "'preview' or 'final'"]),
        (["output_dir=o", "quality=final", "frames=101"], ["toy: quality=final takes at most 100 frames"]),
        (["output_dir=o", "frames=1,2"], ["'frames'", "one value", "[1,2]"]),
        (["output_dir=o", "note=${nowhere}"], ["nowhere"]),
        (["frames=3"], ["'output_dir' has no value", "output_dir=VALUE"]),
        (["demo"], ["'demo'", "write key=value"]),
        (["note=a(1).ply"], ["cannot read", """'note="a(1).ply"'"""]),
        (["--multirun"], ["--multirun", "--help"]),
        (["--cfg", "hydra"], ["--cfg", "hydra"]),
        (["--log-level", "loud"], ["--log-level", "loud", "warning"]),
        (["--config-dir", "nowhere"], ["folder not found (nowhere)"]),
    ],
    ids=lambda value: "_".join(value) if isinstance(value, list) else None,
)
def test_a_mistake_is_one_line_that_names_it_and_nothing_runs(run: Run, tmp_path, arguments, said):
    code, out, err = run(*arguments)
    assert code == 2
    assert out == ""
    assert err.startswith("tron-toy: ")
    assert err.endswith("\n")
    assert len(err.splitlines()) == 1
    assert [each for each in said if each not in err] == [], err
    assert run.seen == []  # type: ignore[attr-defined]
    assert list(tmp_path.iterdir()) == []


def test_overrides_groups_and_experiments_reach_the_settings(run: Run):
    assert (
        run(
            "output_dir=o",
            "experiment=demo",
            "lens=tele",
            "trajectory.turns=5",
            "note=a b",
            "stages.0.steps=8",
        )[0]
        == 0
    )
    (settings,) = run.seen  # type: ignore[attr-defined]
    assert (settings.frames, settings.lens.fov_deg, settings.trajectory.turns) == (2, 20, 5)
    assert settings.stages == [Stage(name="first", steps=8)]
    assert (settings.output_dir, settings.note) == (Path("o"), "a b")
    assert run("output_dir=o", "experiment=demo", "frames=7")[0] == 0
    assert run.seen[0].frames == 7, "the command line wins over the experiment"  # type: ignore[attr-defined]


def test_a_quoted_value_may_hold_anything(run: Run):
    assert run('output_dir="a(1), =b.ply"')[0] == 0
    assert run.seen[0].output_dir == Path("a(1), =b.ply")  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("typed", "mend"),
    [
        ("note=a#b c=d", """quote the value: 'note="a#b c=d"'"""),
        ("stages={a: ../b#c}", """quote the texts in it, as in 'stages={name: "text"}'"""),
        ("stages=[../b#c]", """quote the texts in it, as in 'stages=["text"]'"""),
    ],
)
def test_what_cannot_be_read_is_mended_by_quotes_where_they_belong(run: Run, typed: str, mend: str):
    code, _, said = run("output_dir=o", typed)
    assert code == 2
    assert mend in said


def test_own_recipes_come_from_a_config_dir(run: Run, tmp_path: Path):
    (tmp_path / "my recipes" / "experiment").mkdir(parents=True)
    (tmp_path / "my recipes" / "experiment" / "mine.yaml").write_text("# @package _global_\nframes: 9\n")
    assert run("--config-dir", "my recipes", "experiment=mine", "output_dir=o")[0] == 0
    assert run.seen[0].frames == 9  # type: ignore[attr-defined]
    assert run("experiment=mine", "output_dir=o")[0] == 2
    assert "mine" in run("--config-dir", "my recipes", "--help")[1]


def test_nothing_is_written_and_the_working_directory_stays(run: Run, tmp_path: Path):
    where = []
    assert run("output_dir=o", does=lambda _: where.append(Path.cwd()))[0] == 0
    assert where == [tmp_path]
    assert list(tmp_path.iterdir()) == []


def test_cfg_prints_yaml_that_holds_every_override(run: Run):
    code, out, err = run("--cfg", "job", "output_dir=o", "experiment=demo")
    assert (code, err) == (0, "")
    assert yaml.safe_load(out) == {
        "output_dir": "o",
        "frames": 2,
        "quality": "preview",
        "note": None,
        "trajectory": {"turns": 2},
        "stages": [{"name": "first", "steps": 5}],
        "cluster": {"_target_": "some.Cluster", "workers": 4, "names": ["averylongname"] * 5},
        "lens": {"fov_deg": 90},
    }
    assert run.seen == []  # type: ignore[attr-defined]


def test_help_teaches_purpose_keys_defaults_recipes_and_examples(run: Run, monkeypatch):
    monkeypatch.setenv("COLUMNS", "72")
    code, out, err = run("--help", "all")
    assert (code, err) == (0, "")
    for text in (
        "Take a toy picture.",
        "output_dir=VALUE (required)   [path]",
        "Folder of the results.",
        "frames=3   [integer]",
        "quality=preview   [preview | final]",
        "trajectory.turns=2",
        "lens.fov_deg=90",
        "stages=[{name: first, steps: 5}]   [list of Stage]",
        "stages.N.steps   [integer]",
        "How long it lasts.",
        "cluster.*",
        "cluster.workers=4",
        "cluster.names=[averylongname, ",
        "90 degrees (default)",
        "note=null   [text | null]",
        "Two frames, quickly.",
        "tele",
        "tron-toy experiment=demo output_dir=outputs/first",
    ):
        assert text in out
    assert "_target_" not in out
    page = run("lens=tele", "--help", "all")[1]
    assert "lens.fov_deg=20 " in page, "the keys of the option that is asked about"
    assert max(map(len, out.splitlines())) <= 72


def test_help_of_one_name_tells_that_alone(run: Run):
    assert run("--help", "frames") == (0, "  frames=3   [integer]\n      Number of frames.\n", "")
    code, out, _ = run("--help=lens", "lens=tele")
    assert (code, out.splitlines()[0]) == (0, "  lens.fov_deg=20   [number]")
    assert "lens=NAME\n  tele\n  wide" in out
    assert "cluster.workers=4" in run("--help", "cluster.workers")[1]
    assert run("--help", "framez")[::2] == (
        2,
        "tron-toy: no setting 'framez': did you mean 'frames'? --help all lists every setting\n",
    )


def test_an_error_of_the_work_is_one_line_too(run: Run):
    def fail(_):
        raise TronError("file not found", where="a.ply", mend="check\nthe path")

    assert run("output_dir=o", does=fail) == (2, "", "tron-toy: file not found (a.ply): check the path\n")


def test_what_main_returns_is_the_exit_code(run: Run):
    assert run("output_dir=o", does=lambda _: 1)[0] == 1


def test_an_interruption_exits_130_without_a_traceback(run: Run):
    def interrupt(_):
        raise KeyboardInterrupt

    assert run("output_dir=o", does=interrupt) == (
        130,
        "",
        "tron-toy: interrupted; what is finished is kept, and the same command goes on from it\n",
    )


def test_a_command_that_keeps_nothing_does_not_promise_to_go_on(toy_conf, capsys):
    def interrupt(_):
        raise KeyboardInterrupt

    with pytest.raises(SystemExit, match="130"):
        command("tron-toy", toy_conf, Settings, interrupt, ended=ANEW)(["output_dir=o"])
    assert capsys.readouterr().err == f"tron-toy: interrupted; {ANEW}\n"


def test_a_mistyped_key_of_an_item_of_a_list_gets_the_items_keys(run: Run):
    code, _, said = run("output_dir=o", "stages=[{name: a, stps: 3}]")
    near = "did you mean 'stages.0.steps'? there are name, steps"
    assert (code, said) == (2, f"tron-toy: unknown key 'stages.0.stps': {near}\n")


def test_sigterm_unwinds_and_exits_143_without_a_traceback(run: Run):
    """And what `main` knows better about its own end is said instead."""
    before = signal.getsignal(signal.SIGTERM)

    def end(_):
        try:
            signal.raise_signal(signal.SIGTERM)
        except SystemExit as end:
            end.add_note("all is lost")
            raise

    assert run("output_dir=o", does=end) == (143, "", "tron-toy: terminated; all is lost\n")
    assert signal.getsignal(signal.SIGTERM) is before


def test_an_interruption_that_a_destructor_swallows_comes_again():
    """In a process of its own: those that run tests side by side have signal handlers of theirs."""
    program = """
import time
from tron.termination import termination_unwinds

class Held:
    def __del__(self):
        raise KeyboardInterrupt

with termination_unwinds():
    try:
        Held()
        time.sleep(10)
    except KeyboardInterrupt:
        print("came again")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.stdout == "came again\n", done.stderr


def test_an_interruption_that_an_import_makes_another_error_of_is_one(run: Run):
    def load(_):
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as error:
            try:
                raise ImportError("an error while initializing the extension") from error
            except ImportError:
                raise NameError("_drjit_ext") from None

    assert run("output_dir=o", does=load)[0] == 130


def test_a_defect_keeps_its_traceback(run: Run):
    def defect(_):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run("output_dir=o", does=defect)


def test_log_lines_are_neither_wrapped_nor_coloured_in_a_pipe(run: Run, monkeypatch):
    forget_the_log(monkeypatch)
    long = "word " * 60

    _, _, err = run("output_dir=o", does=lambda _: logging.getLogger("tron").info(long))
    assert long in err
    assert "\x1b" not in err


def forget_the_log(monkeypatch) -> None:
    """Neither handlers nor level of other tests, and none for them."""
    monkeypatch.setenv("TRON_LOG_LEVEL", "")
    for name in ("", "tron", "datagen", "train", "eval"):
        monkeypatch.setattr(logging.getLogger(name), "level", logging.WARNING)
    monkeypatch.setattr(logging.getLogger(), "handlers", [])


@pytest.mark.parametrize(
    ("level", "heard"),
    [
        (None, ["info", "warning", "foreign info"]),
        ("debug", ["debug", "info", "warning", "foreign info"]),
        ("warning", ["warning"]),
    ],
)
def test_the_log_is_as_loud_as_asked(run: Run, monkeypatch, level, heard):
    forget_the_log(monkeypatch)

    def speak(_):
        ours, foreign = logging.getLogger("tron.cli"), logging.getLogger("foreign")
        ours.debug("says debug")
        ours.info("says info")
        ours.warning("says warning")
        foreign.debug("says foreign debug")
        foreign.info("says foreign info")

    _, _, err = run("output_dir=o", *(["--log-level", level] if level else []), does=speak)
    assert [line.partition("says ")[2] for line in err.splitlines()] == heard


def test_processes_that_a_command_starts_log_at_its_level(run: Run):
    code = (
        "import logging, tron.cli.log as log; log.configure_logging(); logging.getLogger('train').debug('hi')"
    )
    said = []

    def start(_):
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        said.append(done.stderr)

    run("output_dir=o", does=start)
    run("output_dir=o", "--log-level", "debug", does=start)
    assert [text.endswith("DEBUG hi\n") for text in said] == [False, True]


def test_a_mistakes_traceback_is_shown_where_it_is_asked_for(run: Run):
    def fail(_):
        raise TronError("file not found", where="a.ply")

    code, _, err = run("output_dir=o", "--traceback", does=fail)
    assert code == 2
    assert "in fail" in err
    assert err.endswith("\ntron-toy: file not found (a.ply)\n")
    assert "Traceback" in run("framez=3", "--traceback")[2]


def test_commands_that_a_command_starts_show_tracebacks_too(run: Run):
    """As tron-eval's stages do."""
    child = (
        "import pydantic; from tron.cli.command_line import command; "
        "command('tron-child', 'conf.relight', pydantic.BaseModel, print)(['framez=3'])"
    )
    said = []

    def start(_):
        done = subprocess.run([sys.executable, "-c", child], capture_output=True, text=True, check=False)
        said.append((done.returncode, done.stderr))

    for options in (["--traceback"], []):  # the second is not told what the first was
        run("output_dir=o", *options, does=start)
    assert [code for code, _ in said] == [2, 2]
    assert ["Traceback" in text for _, text in said] == [True, False]


def test_a_profile_of_a_command_that_fails_at_work_is_kept(run: Run, tmp_path: Path, monkeypatch):
    monkeypatch.delitem(sys.modules, "drjit", raising=False)

    def slow(_):
        return sum(range(10_000))

    def fail(settings):
        slow(settings)
        raise TronError("no luck")

    (tmp_path / "o").mkdir()  # it had begun its work
    code, _, err = run("output_dir=o", "--profile", does=fail)
    assert code == 2
    stats = pstats.Stats(str(tmp_path / "o" / "profile" / "tron-toy.prof")).stats  # type: ignore[attr-defined]
    assert "slow" in {function for _, _, function in stats}
    assert "slow" in err
    assert err.endswith("\ntron-toy: no luck\n")
    assert not (tmp_path / "o" / "profile" / "tron-toy.kernels.json").exists()


def test_a_refused_command_leaves_no_profile_behind(run: Run, tmp_path: Path):
    def refuse(_):
        raise TronError("file not found", where="a.ply")

    code, _, err = run("output_dir=o", "--profile", does=refuse)
    assert (code, err) == (2, "tron-toy: file not found (a.ply)\n")
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize("error", [TronError("its own words"), ValueError("its own words")])
def test_a_profile_that_cannot_be_written_hides_no_error(run: Run, tmp_path: Path, error: Exception):
    def fail(_):
        raise error

    (tmp_path / "o").mkdir()
    (tmp_path / "o" / "profile").touch()  # where its folder would be
    if isinstance(error, TronError):
        code, _, err = run("output_dir=o", "--profile", does=fail)
        assert (code, err.splitlines()[-1]) == (2, "tron-toy: its own words")
        assert "profile: cannot write" in err
    else:
        with pytest.raises(ValueError, match="its own words"):
            run("output_dir=o", "--profile", does=fail)


def test_a_profile_that_cannot_be_written_is_one_line(run: Run, tmp_path: Path):
    (tmp_path / "o").touch()
    code, _, err = run("output_dir=o", "--profile", does=lambda _: None)
    assert code == 2
    assert err.splitlines()[-1].startswith("tron-toy: cannot write: ")


@pytest.mark.usefixtures("variant")
def test_a_profile_counts_kernels(run: Run, tmp_path: Path, variant: str):
    import drjit as dr
    import mitsuba as mi

    def render(_):
        activate(variant)
        for size in (1000, 3000):
            dr.eval(dr.sin(dr.arange(mi.Float, size) + 0.125))

    assert run("output_dir=o", "--profile", does=render)[0] == 0
    kernels = json.loads((tmp_path / "o" / "profile" / "tron-toy.kernels.json").read_text())
    assert (kernels["launches"], kernels["kernels"]) == (2, 1)
    assert kernels["cache_hits"] >= 1
    (kernel,) = kernels["slowest"]
    assert (kernel["launches"], kernel["largest_size"]) == (2, 3000)
    assert not dr.flag(dr.JitFlag.KernelHistory), "nothing is noted once the profile is written"
