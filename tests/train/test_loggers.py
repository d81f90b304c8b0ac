"""Loggers: the numbers of metrics.csv over the steps of the run, and pictures; offline, nothing twice."""

import csv
import sys
from importlib import import_module
from pathlib import Path

import pytest

from train.cli import main
from train.module import RendererModule
from train.settings import Settings
from tron.errors import TronError


def run(make_settings, dataset, output: Path, *names: str) -> bytes:
    main(Settings.model_validate(make_settings(dataset, output, logger=["csv", *names])))
    return (output / "renderer.safetensors").read_bytes()


@pytest.mark.parametrize("name", ["tensorboard", "wandb"])
def test_a_logger_that_is_not_installed_is_one_line_naming_the_extra(
    make_settings, dataset, tmp_path, monkeypatch, name
):
    monkeypatch.setitem(sys.modules, name, None)  # what Python takes for a module that is not there
    with pytest.raises(TronError, match=rf"logger={name} needs a package.*tron-relight\[loggers\]") as said:
        run(make_settings, dataset, tmp_path, name)
    assert "\n" not in str(said.value)
    assert not (tmp_path / "config.yaml").exists()
    run(make_settings, dataset, tmp_path)


def test_tensorboard_shows_what_metrics_csv_says_once_for_each_step(
    make_settings, dataset, tmp_path, monkeypatch
):
    """Killed in its second stage and started again, with the weights of a run without loggers."""
    pytest.importorskip("tensorboard")
    reader = import_module("tensorboard.backend.event_processing.event_accumulator")
    train_a_step = RendererModule.training_step

    def killed(self, batch, index):
        if (self.stage.name, self.global_step) == ("two", 3):
            raise InterruptedError
        return train_a_step(self, batch, index)

    with monkeypatch.context() as patch:
        patch.setattr(RendererModule, "training_step", killed)
        with pytest.raises(InterruptedError):
            run(make_settings, dataset, tmp_path / "seen", "tensorboard")
    seen = run(make_settings, dataset, tmp_path / "seen", "tensorboard")
    assert seen == run(make_settings, dataset, tmp_path / "plain")
    events = reader.EventAccumulator(str(tmp_path / "seen" / "tensorboard"))
    events.Reload()
    with (tmp_path / "seen" / "metrics.csv").open() as file:
        rows = [row | {"at": int(row["step"]) + 6 * (row["stage"] == "two")} for row in csv.DictReader(file)]
    for name in ("loss", "learning_rate", "damaged", "val_psnr", "val_psnr_full"):
        found = {event.step: event.value for event in events.Scalars(name)}
        expected = {row["at"]: float(row[name]) for row in rows if row[name]}
        assert found == pytest.approx(expected, rel=1e-5), name
    assert [image.step for image in events.Images("validation")] == [5, 10]


def test_wandb_writes_offline_into_the_runs_folder(make_settings, dataset, tmp_path):
    pytest.importorskip("wandb")
    assert run(make_settings, dataset, tmp_path / "seen", "wandb") == run(
        make_settings, dataset, tmp_path / "plain"
    )
    (session,) = (tmp_path / "seen" / "wandb").glob("offline-run-*")
    (log,) = session.glob("*.wandb")
    assert log.stat().st_size > 1000
    assert list(session.glob("files/media/images/validation*.png"))


def test_a_logger_may_change_between_sessions(make_settings, dataset, tmp_path):
    pytest.importorskip("tensorboard")
    run(make_settings, dataset, tmp_path)
    run(make_settings, dataset, tmp_path, "tensorboard")
