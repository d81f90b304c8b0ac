"""Laws of checkpoints: what was written comes back, what is none is one line, and none is ever half."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from tron.errors import TronError
from tron.reconstruction.geometry.losses import Weights
from tron.reconstruction.geometry.surfels import ROWS, LearntSurfels
from tron.reconstruction.geometry.training import DensityControl, Plan, Stage
from tron.reconstruction.pipeline import Checkpoint, save_checkpoint
from tron.reconstruction.settings import DensitySettings

RATES = {"means": 0.1, "sh_dc": 0.2}


@pytest.fixture
def stage(painted, painted_capture) -> Stage:
    """A stage whose surfels have moments, without having traced a ray."""
    density = DensityControl(DensitySettings(), 1.0, 0)
    plan = Plan("radiance", 100, Weights(rgb=1.0), RATES, density=density)
    surfels = LearntSurfels.of_scene(painted, RATES)
    for name in RATES:
        pull = torch.rand(surfels[name].shape, generator=torch.Generator().manual_seed(0))
        surfels[name].grad = pull.to(surfels.device)
    density.observe(surfels, torch.zeros(3, device=surfels.device))
    surfels.step()
    made = Stage(plan, painted_capture.train_views, surfels, 2, 0)
    made.step, made.psnr = 42, 21.5
    return made


def test_everything_comes_back(stage: Stage, tmp_path: Path) -> None:
    path = tmp_path / "deep" / "checkpoint.safetensors"
    save_checkpoint(path, stage, {"seed": 3, "radiance": {"steps": 100}}, seconds=12.5)
    found = Checkpoint(path)
    assert (found.stage, found.step, found.psnr, found.seconds) == ("radiance", 42, 21.5, 12.5)
    assert found.made_with == {"seed": 3, "radiance": {"steps": 100}}
    surfels = found.surfels(RATES)
    before, after = stage.surfels.state(), surfels.state()
    assert before.keys() == after.keys()
    for name in before:
        np.testing.assert_array_equal(before[name].cpu().numpy(), after[name].cpu().numpy(), err_msg=name)
    density = DensityControl(DensitySettings(), 1.0, 0)
    again = Stage(Plan("radiance", 100, Weights(rgb=1.0), RATES, density=density), stage.views, surfels, 2, 0)
    found.resume(again)
    assert (again.step, again.psnr) == (42, 21.5)
    assert stage.plan.density is not None
    np.testing.assert_array_equal(density.total.cpu().numpy(), stage.plan.density.total.cpu().numpy())
    np.testing.assert_array_equal(density.seen.cpu().numpy(), stage.plan.density.seen.cpu().numpy())


def test_a_psnr_that_is_not_known_yet_survives(stage: Stage, tmp_path: Path) -> None:
    stage.psnr = float("nan")
    save_checkpoint(tmp_path / "c", stage, {}, 0.0)
    assert np.isnan(Checkpoint(tmp_path / "c").psnr)


def test_the_surfels_of_an_earlier_stage_can_be_asked_for(stage: Stage, tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "c", stage, {}, 0.0)
    other = Checkpoint(tmp_path / "c").surfels({"base_color": 0.1})
    for name in ROWS:
        np.testing.assert_array_equal(
            other[name].detach().cpu().numpy(), stage.surfels[name].detach().cpu().numpy()
        )


@pytest.mark.parametrize("share", [0.0, 0.001, 0.5, 0.999])
def test_a_truncated_checkpoint_is_one_line(stage: Stage, tmp_path: Path, share: float) -> None:
    path = tmp_path / "checkpoint.safetensors"
    save_checkpoint(path, stage, {}, 0.0)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    refused(path)


def test_a_foreign_file_is_one_line(tmp_path: Path) -> None:
    for name, content in {"text": b"hello", "json": b"{}", "binary": bytes(range(256)) * 64}.items():
        (tmp_path / name).write_bytes(content)
        refused(tmp_path / name)
    save_file({"weight": torch.zeros(3)}, tmp_path / "weights")
    assert "not a checkpoint of a reconstruction" in refused(tmp_path / "weights")
    save_file({"weight": torch.zeros(3)}, tmp_path / "half", {"format": "tron-reconstruction 2"})
    refused(tmp_path / "half")
    (tmp_path / "folder").mkdir()
    refused(tmp_path / "folder")


def test_a_checkpoint_that_lacks_a_tensor_names_it(stage: Stage, tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "c", stage, {}, 0.0)
    found = Checkpoint(tmp_path / "c")
    del found.tensors["surfels.quats"]
    with pytest.raises(TronError, match=r"lacks .*surfels\.quats"):
        found.surfels(RATES)


def refused(path: Path) -> str:
    with pytest.raises(TronError) as caught:
        Checkpoint(path)
    line = str(caught.value)
    assert "\n" not in line
    assert str(path) in line
    return line


@pytest.mark.parametrize("moment", ["write", "fsync", "replace"])
def test_a_kill_in_the_middle_leaves_the_old_one(stage, tmp_path, monkeypatch, moment: str) -> None:
    path = tmp_path / "checkpoint.safetensors"
    save_checkpoint(path, stage, {}, 0.0)
    before = path.read_bytes()
    stage.step = 43

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    if moment == "write":
        monkeypatch.setattr(Path, "write_bytes", killed)
    else:
        monkeypatch.setattr(os, moment, killed)
    with pytest.raises(KeyboardInterrupt):
        save_checkpoint(path, stage, {}, 0.0)
    monkeypatch.undo()
    assert path.read_bytes() == before
    assert Checkpoint(path).step == 42
    save_checkpoint(path, stage, {}, 0.0)
    assert Checkpoint(path).step == 43
    assert [each.name for each in tmp_path.iterdir()] == [path.name]
