"""SIGTERM and SIGKILL at any step: the run goes on to the weights of an uninterrupted one, byte for byte."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from train.checkpoints import find_position
from train.cli import main
from train.curriculum import Stage
from train.examples.data import TrainingData
from train.module import RendererModule
from train.settings import Settings
from tron import seeds

EMA = {"optimizer": {"warmup_steps": 2, "ema_decay": 0.9}}
STEPS = {"one": 6, "two": 4}


@pytest.fixture(scope="module")
def run(make_settings, dataset) -> Callable[..., bytes]:
    def train(output: Path, **changes) -> bytes:
        main(Settings.model_validate(make_settings(dataset, output, **(EMA | changes))))
        return (output / "renderer.safetensors").read_bytes()

    return train


@pytest.fixture(scope="module")
def uninterrupted(run, tmp_path_factory) -> bytes:
    return run(tmp_path_factory.mktemp("uninterrupted"))


def position(output: Path) -> tuple[int, int]:
    stages = [Stage(name=name, split="train", steps=steps) for name, steps in STEPS.items()]
    found = find_position(output / "checkpoints", stages)
    return found.stage, found.step


@pytest.mark.parametrize(("stage", "step"), [(0, 0), (0, 4), (0, 5), (1, 0), (1, 3)])
def test_a_signal_ends_behind_the_step_with_a_checkpoint_and_nothing_is_lost(
    run, uninterrupted, monkeypatch, tmp_path, stage, step
):
    """Also behind the last step of a stage, and with averaged weights."""
    train_a_step = RendererModule.training_step

    number = signal.SIGINT if step % 2 else signal.SIGTERM

    def signalled(self, batch, index):
        if (list(STEPS)[stage], step) == (self.stage.name, self.global_step):
            os.kill(os.getpid(), number)
        return train_a_step(self, batch, index)

    before = signal.getsignal(number)
    with monkeypatch.context() as patch:
        patch.setattr(RendererModule, "training_step", signalled)
        with pytest.raises(KeyboardInterrupt if number == signal.SIGINT else SystemExit):
            run(tmp_path)
    assert signal.getsignal(number) == before
    assert position(tmp_path) == (stage, step + 1)
    assert run(tmp_path) == uninterrupted


def test_a_request_that_comes_twice_at_once_is_one_and_a_later_one_ends_at_once(run, monkeypatch, tmp_path):
    """`timeout` tells its command and then the whole group, a launcher tells all and its command again."""
    train_a_step = RendererModule.training_step

    def signalled(self, batch, index):
        if (self.stage.name, self.global_step) == ("one", 3):
            for _ in range(2):
                os.kill(os.getpid(), signal.SIGTERM)
        return train_a_step(self, batch, index)

    monkeypatch.setattr(RendererModule, "training_step", signalled)
    for seconds, step in ((60.0, 4), (0.0, 2)):
        monkeypatch.setattr("tron.termination.SAME_SECONDS", seconds)
        with pytest.raises(SystemExit) as ended:
            run(tmp_path / str(step))
        assert ended.value.code == 128 + signal.SIGTERM
        assert position(tmp_path / str(step)) == (0, step)


def test_sigterm_before_training_ends_at_once_and_binds_nothing(run, monkeypatch, tmp_path):
    opened = TrainingData.open

    def signalled(self, *arguments):
        os.kill(os.getpid(), signal.SIGTERM)
        opened(self, *arguments)
        raise AssertionError("the signal had no effect")

    monkeypatch.setattr(TrainingData, "open", signalled)
    with pytest.raises(SystemExit) as ended:
        run(tmp_path)
    assert ended.value.code == 128 + signal.SIGTERM
    assert not (tmp_path / "config.yaml").exists()


PROGRAM = """
import os, sys
import train.module
from train.cli import main
from train.settings import Settings

number, stage, step = int(sys.argv[1]), sys.argv[2], int(sys.argv[3])
train_a_step = train.module.RendererModule.training_step

def signalled(self, batch, index):
    if (self.stage.name, self.global_step) == (stage, step):
        os.kill(os.getpid(), number)
    return train_a_step(self, batch, index)

train.module.RendererModule.training_step = signalled
main(Settings.model_validate({settings!r}))
"""


@pytest.mark.long
@pytest.mark.parametrize("attempt", range(2))
def test_processes_ended_at_random_steps_leave_what_the_next_go_on_from(
    make_settings, dataset, uninterrupted, tmp_path, attempt
):
    """Each attempt is ended three times, by SIGKILL or SIGTERM, and then left alone."""
    settings = make_settings(str(dataset), str(tmp_path), **EMA)
    program = PROGRAM.format(settings=settings)
    random = seeds.generator(0, "ended", attempt)
    ends = sorted((int(random.integers(10)), bool(random.integers(2))) for _ in range(3))
    for at, killed in [*ends, (-1, False)]:
        stage, step = ("one", at) if at < STEPS["one"] else ("two", at - STEPS["one"])
        number = signal.SIGKILL if killed else signal.SIGTERM
        words = [sys.executable, "-c", program, str(int(number)), stage, str(step)]
        code = subprocess.run(words, env=os.environ | {"OMP_NUM_THREADS": "1"}, check=False).returncode
        if at >= 0:
            # A run that had come further than this step is not ended by it.
            assert code in (-signal.SIGKILL if killed else 128 + signal.SIGTERM, 0)
    assert code == 0
    assert (tmp_path / "renderer.safetensors").read_bytes() == uninterrupted
