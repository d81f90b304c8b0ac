"""Several devices: gloo processes on the CPU train what one does; none waits for one that has ended."""

import csv
import importlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import get_args

import lightning
import pytest
import torch
import yaml
from lightning.fabric.plugins.environments.lightning import find_free_network_port
from safetensors.torch import load_file

from train import processes as training_processes
from train.checkpoints import find_position
from train.cli import main
from train.curriculum import Stage
from train.processes import Processes, launch
from train.settings import Precision, Settings
from tron.cli.recipes import check, compose_recipe
from tron.errors import TronError
from tron.storage import locked

LONGEST = 240.0  # seconds for a run of two processes on a machine that has other work
two_cores = pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="two processes need two cores")

STAGES = [
    {"name": "one", "split": "train", "steps": 40, "batch_size": 2, "crop": 16},
    {
        "name": "two",
        "split": "train_b",
        "frames": 5,
        "steps": 8,
        "batch_size": 2,
        "crop": 16,
        "rehearsal_split": "train",
        "rehearsal_ratio": 0.25,
        "still_ratio": 0.5,
    },
]


LONGER = [STAGES[0] | {"steps": 200}, STAGES[1]]
"""Long enough to be killed in its first stage."""


@pytest.fixture
def typed(make_settings, dataset, tmp_path) -> Callable[..., list[str]]:
    """The command line of a small run of two processes."""

    def words(output: Path, *more: str, **changes) -> list[str]:
        settings = make_settings(str(dataset), str(output), stages=STAGES, checkpoint_every=10)
        settings |= {"validation": {"every": 7, "clips": 3, "split": "train_b"}, "devices": 2} | changes
        if "renderer=pixel_mlp" in more:
            del settings["renderer"]
        recipe = tmp_path / "recipes" / "experiment" / "small.yaml"
        recipe.parent.mkdir(parents=True, exist_ok=True)
        recipe.write_text("# @package _global_\n" + yaml.safe_dump(settings))
        script = Path(sys.executable).with_name("tron-train")
        return [str(script), "--config-dir", str(tmp_path / "recipes"), "experiment=small", *more]

    return words


@pytest.fixture
def alone(make_settings, dataset, tmp_path) -> Callable[..., Path]:
    """A run of one process with batches of twice the size."""

    def run(**more) -> Path:
        stages = [stage | {"batch_size": 4} for stage in more.pop("stages", STAGES)]
        changes = {"validation": {"every": 7, "clips": 3, "split": "train_b"}} | more
        settings = make_settings(dataset, tmp_path / "alone", stages=stages, checkpoint_every=10, **changes)
        main(Settings.model_validate(settings))
        return tmp_path / "alone"

    return run


def require_equal(one: Path, several: Path, tolerance: float) -> None:
    a, b = (load_file(folder / "renderer.safetensors") for folder in (one, several))
    difference = max(float((a[name] - b[name]).abs().max()) for name in a)
    moved = max(float((a[name]).abs().max()) for name in a)
    print(f"largest difference of a weight {difference:.2e}, largest weight {moved:.2f}")
    assert difference <= tolerance
    rows, others = (list(csv.DictReader((folder / "metrics.csv").open())) for folder in (one, several))
    steps = [(row["stage"], row["step"]) for row in rows]
    # A run that is stopped has a row more.
    others = [row for row in others if (row["stage"], row["step"]) in steps]
    assert steps == [(row["stage"], row["step"]) for row in others]
    # One that is killed between a checkpoint and the validation of its step goes on without the latter.
    pairs = enumerate(zip(rows, others))
    lost = [i for i, (row, other) in pairs if row["val_psnr"] and not other["val_psnr"]]
    assert len(lost) <= 1
    for name, places in (("loss", 1e-5), ("learning_rate", 0), ("val_psnr", 2e-3), ("val_psnr_full", 2e-3)):
        values = [[float(row[name] or "nan") for row in table] for table in (rows, others)]
        for i in lost if name.startswith("val") else []:
            values[0][i] = float("nan")
        torch.testing.assert_close(*map(torch.tensor, values), rtol=places, atol=places, equal_nan=True)


def wait_for(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + LONGEST
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def free(folder: Path) -> bool:
    try:
        with locked(folder):
            return True
    except TronError:
        return False


def kill_at_a_checkpoint(command: list[str], output: Path) -> str:
    """Start a run and kill its first process once a checkpoint is there; gives what it said."""
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    wait_for(lambda: list((output / "checkpoints").glob("1-one-*0.ckpt")) or process.poll() is not None)
    process.send_signal(signal.SIGKILL)
    _, said = process.communicate()
    wait_for(lambda: free(output))  # the processes that it started notice and end
    return said


@two_cores
@pytest.mark.long
def test_two_processes_killed_and_resumed_equal_one_with_twice_the_batch(alone, typed, tmp_path):
    output = tmp_path / "two"
    # In float64, but for the samples; the tiny renderer has layers in float32 whatever it is told.
    command = typed(output, "renderer=pixel_mlp", precision="64-true", stages=LONGER)
    for _ in range(8):  # on a crowded machine a run may end before this process gets to kill it
        said = kill_at_a_checkpoint(command, output)
        position = find_position(output / "checkpoints", [Stage.model_validate(stage) for stage in STAGES])
        if position.stage == 0:
            break
        shutil.rmtree(output)
    assert position.stage == 0, said
    assert 0 < position.step < 200, said
    again = subprocess.run(command, stderr=subprocess.PIPE, text=True, timeout=LONGEST, check=False)
    assert again.returncode == 0, again.stderr
    assert f"from step {position.step}" in again.stderr
    assert again.stderr.count("Stage 2 of 2") == 1, "one process speaks"
    pixels = {"_target_": "tron.neural.networks.pixel_mlp.PixelMLP"}
    # Measured: 1.6e-8, of 0.4. Samples are float32, some pixels a rounding apart in other batches.
    require_equal(alone(renderer=pixels, precision="64-true", stages=LONGER), output, 1e-6)


def torchrun(rank: int, ranks: int, port: int) -> dict[str, str]:
    """What torchrun tells a process that is alone on its machine."""
    return os.environ | {
        "TORCHELASTIC_RUN_ID": "test",
        "RANK": str(rank),
        "GROUP_RANK": str(rank),
        "LOCAL_RANK": "0",
        "WORLD_SIZE": str(ranks),
        "LOCAL_WORLD_SIZE": "1",
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(port),
    }


@two_cores
@pytest.mark.long
def test_processes_of_torchrun_on_two_machines_do_the_same_and_are_refused_together(alone, typed, tmp_path):
    def ended(**changes) -> list[tuple[int, str]]:
        command, port = typed(tmp_path / "two", devices=1, nodes=2, **changes), find_free_network_port()
        running = [
            subprocess.Popen(command, env=torchrun(rank, 2, port), stderr=subprocess.PIPE, text=True)
            for rank in range(2)
        ]
        said = [each.communicate(timeout=LONGEST)[1] for each in running]
        return [(each.returncode, text) for each, text in zip(running, said)]

    assert [code for code, _ in ended()] == [0, 0]
    # Measured: 1.4e-5. AdamW divides small gradients by their own size, rounding and all, at a rate of 1e-3.
    require_equal(alone(), tmp_path / "two", 1e-4)
    (first, said), (second, nothing) = ended(seed=1)
    assert (first, second) == (2, 2)
    assert said.startswith("tron-train: output_dir holds a run made with seed=")
    assert len(said.splitlines()) == 1
    assert nothing == ""


@two_cores
@pytest.mark.long
def test_a_folder_in_use_ends_all_processes_with_one_line(typed, tmp_path):
    with locked(tmp_path / "two"):
        done = subprocess.run(
            typed(tmp_path / "two"), capture_output=True, text=True, timeout=LONGEST, check=False
        )
    assert done.returncode == 2
    assert done.stderr.startswith("tron-train: folder is in use by another run")
    assert len(done.stderr.splitlines()) == 1
    assert done.stdout == ""


WORK = """
import os, signal, time
from pathlib import Path

import torch
from torch import distributed

from tron.errors import TronError
from tron.neural.networks.pixel_mlp import PixelMLP


def watched():
    # Writes down the weights it is asked with, in a file for each process.
    renderer = PixelMLP()

    def note(module, _inputs):
        weights = torch.cat([p.detach().flatten() for p in module.parameters()])
        with open(Path(os.environ["WATCHED"]) / os.environ["LOCAL_RANK"], "a") as file:
            file.write(f"{weights.double().sum().item()!r}\\n")

    renderer.register_forward_pre_hook(note)
    return renderer


def refuse():
    raise TronError("found in the second alone")


def second_fails(processes, settings):
    heard = processes.number_of_first(10.0 + processes.rank)
    assert heard == 10.0, heard
    assert processes.from_first(lambda: processes.rank) == 0
    assert processes.together(lambda: processes.rank) == processes.rank
    processes.together(refuse if processes.rank == 1 else lambda: None)
    raise AssertionError("both have ended by now")


def second_is_killed(processes, settings):
    (settings.output_dir / str(processes.rank)).write_text(str(os.getpid()))
    if processes.rank == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    distributed.barrier()
    time.sleep(1000)


def second_cannot_read(processes, settings):
    if processes.rank == 1:
        refuse()
    distributed.barrier()
    time.sleep(1000)
"""


@pytest.fixture
def work(tmp_path, monkeypatch):
    """A module that spawned processes can import too."""
    (tmp_path / "work_of_ranks.py").write_text(WORK)
    monkeypatch.syspath_prepend(tmp_path)
    name = "work_of_ranks"
    yield importlib.import_module(name)
    del sys.modules[name]


@two_cores
@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("second_fails", "found in the second alone"),
        ("second_cannot_read", "found in the second alone"),
        ("second_is_killed", "training process 1 terminated with signal SIGKILL"),
    ],
)
def test_whatever_ends_one_process_ends_all_and_is_said(
    work, monkeypatch, make_settings, dataset, tmp_path, name, message
):
    monkeypatch.setattr(training_processes, "GRACE_SECONDS", 3.0)
    settings = Settings.model_validate(make_settings(dataset, tmp_path, devices=2))
    with pytest.raises(TronError, match=message):
        launch(getattr(work, name), settings)
    for path in tmp_path.glob("[01]"):
        with pytest.raises(ProcessLookupError):
            os.kill(int(path.read_text()), 0)


@two_cores
@pytest.mark.long
def test_processes_that_train_for_a_time_keep_the_same_weights_and_stop_together(
    work, monkeypatch, make_settings, dataset, tmp_path
):
    monkeypatch.setenv("WATCHED", str(tmp_path))
    stages = [{"name": "one", "split": "train", "steps": 10**6, "batch_size": 1, "crop": 16}]
    changes = {"max_seconds": 2.0, "stages": stages, "validation": {"split": None}}
    settings = make_settings(dataset, tmp_path / "run", devices=2, checkpoint_every=10**6, **changes)
    main(Settings.model_validate(settings | {"renderer": {"_target_": "work_of_ranks.watched"}}))
    seen = [(tmp_path / str(rank)).read_text().splitlines() for rank in range(2)]
    assert len(seen[0]) > 5
    assert len(set(seen[0])) > 5
    assert seen[0] == seen[1]
    last = list(csv.DictReader((tmp_path / "run" / "metrics.csv").open()))[-1]
    assert float(last["learning_rate"]) < 0.05e-3  # the cosine came to its end


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"devices": 10_000}, r"devices=10000 of accelerator cpu: this machine has \d+ cores"),
        ({"nodes": 2}, "nodes=2 without a launcher: start it by torchrun"),
        ({"accelerator": "abacus"}, "invalid accelerator name"),
    ],
)
def test_devices_that_a_machine_has_not_are_one_line(make_settings, dataset, tmp_path, changes, message):
    with pytest.raises(TronError, match=message) as caught:
        main(Settings.model_validate(make_settings(dataset, tmp_path / "out", **changes)))
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
def test_a_gpu_that_is_not_there_is_one_line(make_settings, dataset, tmp_path):
    with pytest.raises(TronError, match="accelerator=gpu"):
        main(Settings.model_validate(make_settings(dataset, tmp_path, accelerator="gpu")))


@pytest.mark.parametrize("given", ["devices=1.5", "precision=fp16"])
def test_a_number_of_devices_or_a_precision_that_is_none_is_one_line(given):
    with pytest.raises(TronError, match=f"wrong value for '{given.partition('=')[0]}'"):
        check(compose_recipe("conf.train", Settings, ["dataset=d", "output_dir=o", given]), Settings)


@pytest.mark.parametrize("precision", get_args(Precision))
def test_every_precision_is_one_of_lightnings(precision):
    assert lightning.Fabric(accelerator="cpu", precision=precision)


def test_more_devices_than_torchrun_has_started_are_one_line(monkeypatch, make_settings, dataset, tmp_path):
    for name, value in torchrun(0, 1, 1).items():
        monkeypatch.setenv(name, value)
    settings = Settings.model_validate(make_settings(dataset, tmp_path, devices=2))
    with pytest.raises(TronError, match="1 processes were started, but devices=2 on nodes=1 are 2"):
        launch(lambda *_: None, settings)


def test_auto_is_one_process_on_the_cpu_and_as_many_as_torchrun_has_started(
    monkeypatch, make_settings, dataset, tmp_path
):
    settings = Settings.model_validate(make_settings(dataset, tmp_path))
    seen: list[Processes] = []
    launch(lambda processes, _: seen.append(processes), settings)
    assert (seen[0].rank, seen[0].count) == (0, 1)
    for name, value in torchrun(1, 4, 1).items():
        monkeypatch.setenv(name, value)
    outer = training_processes._outer_launcher()
    assert training_processes._devices(settings, outer) == 4
    assert training_processes._devices(settings.model_copy(update={"nodes": 2}), outer) == 2
