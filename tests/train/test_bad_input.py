"""What a run cannot be made of: one line before the first step, nothing executed, no folder bound."""

import json
import shutil
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from pydantic import ValidationError

from train.cli import cli, main
from train.curriculum import Stage
from train.examples.data import TrainingData
from train.examples.requirements import require_renderer
from train.module import RendererModule
from train.processes import Processes
from train.settings import DataSettings, Settings, ValidationSettings
from tron.errors import TronError
from tron.neural.renderer import NeuralRenderer
from tron.shards.schema import SCHEMA_VERSION

STAGE = {"name": "one", "split": "train", "steps": 2, "batch_size": 1, "crop": 16}


@pytest.fixture
def refused(make_settings, dataset, tmp_path, monkeypatch) -> Callable[..., str]:
    """What a run says that ends before its first step; after it another may use the folder."""

    def step(*_: Any) -> None:
        raise AssertionError("a step was made")

    def said(place: Path = dataset, **changes: Any) -> str:
        output = tmp_path / "out"
        settings = Settings.model_validate(make_settings(place, output, **({"stages": [STAGE]} | changes)))
        with monkeypatch.context() as patch:
            patch.setattr(RendererModule, "training_step", step)
            with pytest.raises(TronError) as error:
                main(settings)
        assert "\n" not in str(error.value)
        assert not (output / "config.yaml").exists()
        assert not (output / "metrics.csv").exists()
        return str(error.value)

    return said


def test_a_buffer_that_the_data_do_not_hold_is_named(refused, make_settings, dataset, tmp_path):
    """Read from memory or as needed: there is no first sample that would be taken for a damaged one."""
    renderer = make_settings(dataset, "")["renderer"]
    renderer = renderer | {"config": renderer["config"] | {"guidance": ["pbr", "lit"]}}
    folder = without(dataset, "lit", tmp_path / "without")
    for cache_gb in (4.0, 0.0):
        said = refused(folder, renderer=renderer, data={"cache_gb": cache_gb})
        assert "gives no buffer 'lit'" in said


def without(dataset: Path, member: str, folder: Path) -> Path:
    """A copy of a dataset whose clips lack a member."""
    shutil.copytree(dataset, folder)
    for path in folder.glob("*.tar"):
        with tarfile.open(dataset / path.name) as whole, tarfile.open(path, "w") as left:
            for each in whole.getmembers():
                if f".{member}." not in each.name:
                    left.addfile(each, whole.extractfile(each))
    for path in folder.glob("*.idx"):
        path.unlink()
    return folder


def test_shards_of_another_schema_are_named(refused, dataset, tmp_path):
    folder = tmp_path / "older"
    shutil.copytree(dataset, folder)
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["schema_version"] = 2
    (folder / "manifest.json").write_text(json.dumps(manifest))
    assert f"dataset of schema 2, this program reads schema {SCHEMA_VERSION}" in refused(folder)


def test_sides_that_the_codecs_blocks_do_not_divide_are_refused(refused):
    said = "of 18 pixels, the renderer takes multiples of 4"
    assert f"crop {said}: give it 16" in refused(stages=[STAGE | {"crop": 18}])
    assert f"size {said}" in refused(stages=[STAGE | {"size": [20, 18], "crop": None}])


def test_frames_that_are_not_1_plus_4n_are_refused(make_settings, dataset):
    for frames in (2, 3, 4, 6):
        with pytest.raises(ValidationError, match=r"1 \+ 4n"):
            Settings.model_validate(make_settings(dataset, "out", stages=[STAGE | {"frames": frames}]))


def test_frames_are_those_that_the_renderer_takes():
    renderer = NeuralRenderer()
    renderer.temporal_factor = 8
    for frames, fits in ((1, True), (5, False), (9, True)):
        stage = Stage.model_validate(STAGE | {"frames": frames})
        if fits:
            require_renderer(stage, renderer)
        else:
            with pytest.raises(TronError, match=r"has 5 frames, the renderer takes 1 \+ 8n: give it 9"):
                require_renderer(stage, renderer)


def test_fewer_clips_than_processes_are_refused(dataset):
    data = TrainingData(dataset, DataSettings(), 0, ValidationSettings(), Processes(0, 6))
    with pytest.raises(TronError, match="split 'train' has 5 clips for 6 processes: train on fewer"):
        data.open([Stage.model_validate(STAGE)])
    few = TrainingData(dataset, DataSettings(), 0, ValidationSettings(), Processes(0, 5))
    few.open([Stage.model_validate(STAGE)])


class Malice:
    def __reduce__(self):
        return (Path.touch, (Path("executed"),))


def test_lpips_weights_that_are_none_are_refused(refused, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "vgg.pth"
    for content in (None, Malice(), torch.zeros(3)):
        if content is not None:
            torch.save({"features.0.weight": content}, path)
        assert "vgg.pth" in refused(loss={"vgg_weights": path})
    assert not Path("executed").exists()


def test_the_papers_recipe_asks_for_the_lpips_weights(capsys, dataset, tmp_path):
    words = [f"dataset={dataset}", f"output_dir={tmp_path / 'out'}", "experiment=paper", "accelerator=cpu"]
    with pytest.raises(SystemExit) as ended:
        cli([*words, "renderer.transformer_path=a.pt", "renderer.vae_path=b.pth"])
    said = capsys.readouterr().err.strip()
    assert ended.value.code == 2
    assert "loss.vgg_weights" in said
    assert "\n" not in said
    assert not (tmp_path / "out").exists()


def test_settings_out_of_range_are_refused(make_settings):
    plain = make_settings("a", "b")
    wrong = {"logger": ["mlflow"], "data": {"exposure": -1}, "optimizer": {"betas": 1}, "devices": 0}
    for key, value in wrong.items():
        with pytest.raises(ValidationError, match=key):
            Settings.model_validate(plain | {key: value})


def test_a_key_of_the_renderer_without_its_parents_is_suggested(capsys):
    with pytest.raises(SystemExit) as end:
        cli(["guidance=[pbr]", "dataset=data", "output_dir=out"])
    assert end.value.code == 2
    assert "did you mean 'renderer.config.guidance'" in capsys.readouterr().err
