"""Stages run once, side by side, keep their seconds, and fail with the child's own words."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from eval import stages as stages_module
from eval.stages import Child, StageFailed, StageFile, Stages
from tron.errors import TronError
from tron.termination import termination_noted

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def scripts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of console scripts in place of the one beside this Python; fill it with `script`."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setattr(stages_module, "script_path", lambda name: str(folder / name))
    return folder


def script(folder: Path, name: str, body: str) -> None:
    (folder / name).write_text(f"#!{sys.executable}\nimport os, sys, time\n{body}\n")
    (folder / name).chmod(0o755)


def test_a_finished_stage_is_not_redone_and_keeps_its_seconds(tmp_path: Path, scripts: Path):
    script(scripts, "tron-x", f"open({str(tmp_path / 'runs')!r}, 'a').write('x'); time.sleep(0.2)")
    first = Stages(tmp_path).run("make", [Child("x", "tron-x", ["a=1"])])
    second = Stages(tmp_path).run("make", [Child("x", "tron-x", ["a=1"])])
    assert (tmp_path / "runs").read_text() == "x"
    assert 0.2 <= first == pytest.approx(second)


def test_a_stage_of_other_settings_is_not_taken_for_this_one(tmp_path: Path, scripts: Path):
    script(scripts, "tron-x", "")
    Stages(tmp_path).run("make", [Child("x", "tron-x", ["a=1"])])
    with pytest.raises(TronError, match=r"holds a stage made with make\.0\.a=1, not 2"):
        Stages(tmp_path).run("make", [Child("x", "tron-x", ["a=2"])])


def test_children_run_at_the_same_time_and_speak_behind_their_labels(
    tmp_path: Path, scripts: Path, capfd: pytest.CaptureFixture[str]
):
    body = f"""
mine, other = sys.argv[1:3]
open(os.path.join({str(tmp_path)!r}, mine), "w").close()
end = time.time() + 120
while not os.path.exists(os.path.join({str(tmp_path)!r}, other)):
    assert time.time() < end, "the other never started"
    time.sleep(0.01)
print("met", os.environ["GREETING"])
"""
    script(scripts, "tron-x", body)
    children = [
        Child("one", "tron-x", ["a", "b"], {"GREETING": "hello"}),
        Child("two", "tron-x", ["b", "a"], {"GREETING": "hallo"}),
    ]
    Stages(tmp_path).run("make", children)
    out = capfd.readouterr().out
    assert "[one] met hello" in out
    assert "[two] met hallo" in out


def test_a_failure_ends_with_the_childs_words_and_code_and_stops_the_other(tmp_path: Path, scripts: Path):
    script(
        scripts,
        "tron-bad",
        "print('warming up'); print('tron-bad: no such file (x.ply)', file=sys.stderr); sys.exit(2)",
    )
    script(scripts, "tron-slow", "time.sleep(60)")
    begin = time.monotonic()
    with pytest.raises(StageFailed) as failure:
        Stages(tmp_path).run("make", [Child("slow", "tron-slow", []), Child("bad", "tron-bad", ["a=1"])])
    assert time.monotonic() - begin < 20
    assert failure.value.exit_code == 2
    assert str(failure.value) == "tron-bad a=1 failed with exit code 2: tron-bad: no such file (x.ply)"
    record = StageFile.model_validate_json((tmp_path / "stages.json").read_bytes()).stages["make"]
    assert not record.finished
    assert record.seconds > 0


def test_the_seconds_of_failed_attempts_count(tmp_path: Path, scripts: Path):
    body = f"time.sleep(0.3); sys.exit(not os.path.exists({str(tmp_path / 'ready')!r}))"
    script(scripts, "tron-x", body)
    with pytest.raises(StageFailed):
        Stages(tmp_path).run("make", [Child("x", "tron-x", [])])
    (tmp_path / "ready").touch()
    assert Stages(tmp_path).run("make", [Child("x", "tron-x", [])]) >= 0.6


def test_the_seconds_of_a_stage_within_another_count_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    clock = iter([0.0, 2.0, 7.0, 8.0, 11.0, 12.0])
    monkeypatch.setattr(stages_module, "time", SimpleNamespace(perf_counter=lambda: next(clock)))
    stages = Stages(tmp_path)
    with stages.timed("part", [["outer"]]):
        for name in ("first", "second"):
            with stages.timed(name, [["inner"]]):
                pass
    assert {name: each.seconds for name, each in stages.records.items()} == {
        "part": 4,
        "first": 5,
        "second": 3,
    }


def test_a_child_killed_by_a_signal_fails_too(tmp_path: Path, scripts: Path):
    script(scripts, "tron-x", "print('about to go', flush=True); os.kill(os.getpid(), 9)")
    with pytest.raises(StageFailed, match="about to go") as failure:
        Stages(tmp_path).run("make", [Child("x", "tron-x", [])])
    assert failure.value.exit_code > 0


def test_ending_the_demo_ends_its_children_and_keeps_the_seconds(tmp_path: Path, scripts: Path):
    body = f"open({str(tmp_path / 'child')!r}, 'w').write(str(os.getpid())); time.sleep(60)"
    script(scripts, "tron-x", body)
    program = f"""
from pathlib import Path
from eval import stages
stages.script_path = lambda name: str(Path({str(scripts)!r}) / name)
stages.Stages(Path({str(tmp_path)!r})).run("make", [stages.Child("x", "tron-x", [])])
"""
    demo = subprocess.Popen([sys.executable, "-c", program], cwd=ROOT, stdout=subprocess.DEVNULL)
    end = time.monotonic() + 60
    while not (tmp_path / "child").exists() or not (tmp_path / "child").read_text():
        assert time.monotonic() < end
        time.sleep(0.05)
    demo.send_signal(signal.SIGTERM)
    assert demo.wait(60) == 128 + signal.SIGTERM
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "child").read_text()), 0)
    record = StageFile.model_validate_json((tmp_path / "stages.json").read_bytes()).stages["make"]
    assert record.seconds > 0
    assert not record.finished


def test_a_missing_command_is_one_line(tmp_path: Path):
    with pytest.raises(TronError, match=r"tron-nonsense not found .*pip install -e '\.\[all\]'$"):
        Stages(tmp_path).run("make", [Child("x", "tron-nonsense", [])])


def test_a_damaged_record_is_one_line(tmp_path: Path):
    for text, said in (("{]", "stages.json is damaged"), ('{"stages": 3}', "not a record of stages")):
        (tmp_path / "stages.json").write_text(text)
        with pytest.raises(TronError, match=said):
            Stages(tmp_path)


def test_a_signal_while_the_lock_of_a_child_is_held_ends_the_demo_all_the_same(tmp_path: Path, scripts: Path):
    body = f"open({str(tmp_path / 'child')!r}, 'w').write(str(os.getpid())); time.sleep(60)"
    script(scripts, "tron-x", body)
    program = f"""
import os, signal, subprocess
from pathlib import Path
from eval import stages

class Signalled:
    signals = [signal.SIGINT]
    def __init__(self, lock): self.lock = lock
    def __getattr__(self, name): return getattr(self.lock, name)
    def __enter__(self): return self.lock.__enter__()
    def __exit__(self, *error): return self.lock.__exit__(*error)
    def acquire(self, *arguments):
        taken = self.lock.acquire(*arguments)
        while self.signals and Path({str(tmp_path / "child")!r}).exists():
            os.kill(os.getpid(), self.signals.pop())
        return taken

class Popen(subprocess.Popen):
    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self._waitpid_lock = Signalled(self._waitpid_lock)

stages.subprocess.Popen = Popen
stages.script_path = lambda name: str(Path({str(scripts)!r}) / name)
stages.Stages(Path({str(tmp_path)!r})).run("make", [stages.Child("x", "tron-x", [])])
"""
    demo = subprocess.run([sys.executable, "-c", program], cwd=ROOT, timeout=60, capture_output=True)
    assert demo.returncode == -signal.SIGINT, demo.stderr
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "child").read_text()), 0)


def test_a_noted_signal_is_not_lost_where_the_block_raises():
    before = signal.getsignal(signal.SIGTERM)

    def block():
        with termination_noted() as termination:
            os.kill(os.getpid(), signal.SIGTERM)
            assert termination.asked
            raise StageFailed("tron-x", 1, "words")

    with pytest.raises(SystemExit) as end:
        block()
    assert end.value.code == 128 + signal.SIGTERM
    assert signal.getsignal(signal.SIGTERM) is before


def test_an_ignored_signal_stays_ignored():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with termination_noted() as termination:
            os.kill(os.getpid(), signal.SIGINT)
        assert not termination.asked
    finally:
        signal.signal(signal.SIGINT, before)
