"""Warm starts: of a run with another's renderer, of a stage with averaged weights, with frozen ones."""

import pickle
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from train.callbacks import AveragedWeights
from train.cli import main
from train.module import RendererModule
from train.settings import Settings
from tron.errors import TronError
from tron.neural import shipped

PIXELS = {"_target_": "tron.neural.networks.pixel_mlp.PixelMLP"}
STAGES = [
    {"name": "one", "split": "train", "steps": 3, "batch_size": 2, "crop": 16},
    {"name": "two", "split": "train_b", "frames": 5, "steps": 3, "batch_size": 1, "crop": 16},
]


@pytest.fixture(scope="module")
def train(make_settings, dataset):
    def run(output: Path, place: Path = dataset, **changes) -> dict[str, torch.Tensor]:
        changes = {"stages": STAGES, "validation": {"split": None}} | changes
        settings = make_settings(place, output, **changes)
        main(Settings.model_validate(settings))
        return load_file(output / "renderer.safetensors")

    return run


@pytest.fixture(scope="module")
def first(train, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("first")
    train(folder, stages=STAGES[:1])
    return folder / "renderer.safetensors"


def test_a_run_begins_with_the_weights_and_constants_of_another(train, first, make_dataset, tmp_path):
    """At a rate of almost nothing it also ends with them: the codec is not fitted again, to other data."""
    other = make_dataset(tmp_path / "other", {"train": 1, "train_b": 1}, frames=5)
    found = train(
        tmp_path / "out",
        other,
        stages=STAGES[1:],
        start_from=first,
        seed=3,
        optimizer={"learning_rate": 1e-12, "weight_decay": 0.0},
    )
    for name, value in load_file(first).items():
        torch.testing.assert_close(found[name], value, rtol=0, atol=1e-9)


def test_what_a_run_began_with_is_part_of_it(train, first, tmp_path):
    train(tmp_path / "out", stages=STAGES[1:], start_from=first)
    moved = tmp_path / "moved.safetensors"
    moved.write_bytes(first.read_bytes())
    train(tmp_path / "out", stages=STAGES[1:], start_from=moved)
    train(tmp_path / "other", stages=STAGES[1:], seed=1)
    with pytest.raises(TronError, match="a run made with another start_from "):
        train(tmp_path / "out", stages=STAGES[1:], start_from=tmp_path / "other" / "renderer.safetensors")
    with pytest.raises(TronError, match="a run made with another start_from "):
        train(tmp_path / "out", stages=STAGES[1:])


def test_a_checkpoint_of_the_package_is_begun_with_by_its_name(train, first, tmp_path, monkeypatch):
    (tmp_path / "surfaces.safetensors").write_bytes(first.read_bytes())
    monkeypatch.setattr(shipped, "FOLDER", tmp_path)
    by_path = train(tmp_path / "path", stages=STAGES[1:], start_from=first)
    by_name = train(tmp_path / "name", stages=STAGES[1:], start_from=Path("surfaces"))
    assert all(torch.equal(by_name[name], value) for name, value in by_path.items())
    (tmp_path / "surfaces.safetensors").unlink()
    with pytest.raises(TronError, match="this installation has no checkpoint 'surfaces'"):
        train(tmp_path / "absent", stages=STAGES[1:], start_from=Path("surfaces"))


class Malice:
    def __reduce__(self):
        return (Path.touch, (Path("executed"),))


def test_a_wrong_file_to_start_from_is_one_line_before_the_first_step(train, first, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path, output = tmp_path / "start.safetensors", tmp_path / "out"
    with pytest.raises(TronError, match="cannot read: No such file"):
        train(output, start_from=path)
    with pytest.raises(TronError, match="weights do not fit the model"):
        train(output, start_from=first, renderer=PIXELS)
    torch.save({"a": Malice()}, tmp_path / "torch")
    for content in (pickle.dumps(Malice()), (tmp_path / "torch").read_bytes(), first.read_bytes()[:-100]):
        path.write_bytes(content)
        with pytest.raises(TronError, match="not a readable safetensors file") as said:
            train(output, start_from=path)
        assert "\n" not in str(said.value)
    assert not Path("executed").exists()
    assert not (output / "config.yaml").exists(), "the mended command may use the folder"
    train(output, stages=STAGES[:1])


def test_a_stage_ends_with_averaged_weights_and_the_next_begins_with_them(train, monkeypatch, tmp_path):
    begun = {}

    def note(self):
        state = self.renderer.state_dict()
        begun[self.stage.name] = {name: value.clone() for name, value in state.items()}
        self.clock.start()

    monkeypatch.setattr(RendererModule, "on_train_start", note)
    plain = train(tmp_path / "plain", stages=STAGES[:1])
    train(tmp_path / "averaged", optimizer={"ema_decay": 0.9})
    ended = load_file(tmp_path / "averaged" / "checkpoints" / "1-one.safetensors")
    assert all(torch.equal(begun["two"][name], ended[name]) for name in ended)
    moved = {name for name in ended if not torch.equal(ended[name], plain[name])}
    assert moved, "averages are not the last weights"
    for name in moved:  # they lag behind them
        assert (ended[name] - begun["one"][name]).norm() < (plain[name] - begun["one"][name]).norm()


def test_constants_stay_under_the_average_to_the_last_bit():
    """Which Lightning's own formula would not grant."""
    layer = torch.nn.Linear(64, 64)
    for decay in (0.1, 0.9, 0.999):
        averaged = AveragedWeights(decay)
        averaged._average_model = torch.optim.swa_utils.AveragedModel(layer, **averaged._kwargs)
        for _ in range(5):
            averaged._average_model.update_parameters(layer)
        (weight, _) = averaged._average_model.module.parameters()
        assert torch.equal(weight, layer.weight)
