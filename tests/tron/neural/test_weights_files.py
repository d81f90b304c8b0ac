"""Folders and files of published weights: an index is followed, misfits are one line, nothing runs."""

import io
import json
import pickle
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from tron.errors import TronError
from tron.neural.codecs.published_files import folder_state, torch_state
from tron.neural.codecs.wan import load_wan
from tron.neural.configs import BackboneConfig
from tron.neural.weights import load_cosmos_state

INDEX = "diffusion_pytorch_model.safetensors.index.json"


def sharded(folder: Path) -> Path:
    """A folder of two files and their index, with an older copy of one weight beside them."""
    folder.mkdir()
    save_file({"a": torch.ones(2)}, folder / "diffusion_pytorch_model-00001-of-00002.safetensors")
    save_file({"b": torch.zeros(3)}, folder / "diffusion_pytorch_model-00002-of-00002.safetensors")
    save_file({"a": torch.full((2,), 7.0)}, folder / "diffusion_pytorch_model.fp16.safetensors")
    names = {"a": "1", "b": "2"}
    weight_map = {
        name: f"diffusion_pytorch_model-0000{part}-of-00002.safetensors" for name, part in names.items()
    }
    (folder / INDEX).write_text(json.dumps({"metadata": {}, "weight_map": weight_map}))
    return folder


def test_a_folder_is_read_by_its_index(tmp_path):
    state = folder_state(sharded(tmp_path / "transformer"))
    assert set(state) == {"a", "b"}
    torch.testing.assert_close(state["a"], torch.ones(2))


def test_a_file_that_the_index_lists_must_be_there(tmp_path):
    folder = sharded(tmp_path / "transformer")
    (folder / "diffusion_pytorch_model-00002-of-00002.safetensors").unlink()
    with pytest.raises(TronError, match=r"a file of the index is not there .*00002-of-00002"):
        folder_state(folder)


@pytest.mark.parametrize("text", ["{", "[]", '{"weight_map": {"a": 1}}', '{"weight_map": [1]}'])
def test_a_damaged_index_is_one_line(tmp_path, text):
    folder = sharded(tmp_path / "transformer")
    (folder / INDEX).write_text(text)
    with pytest.raises(TronError, match="not an index of weights") as caught:
        folder_state(folder)
    assert "\n" not in str(caught.value)


def test_an_index_reads_no_file_outside_its_folder(tmp_path):
    save_file({"secret": torch.zeros(1)}, tmp_path / "outside.safetensors")
    folder = sharded(tmp_path / "transformer")
    (folder / INDEX).write_text(json.dumps({"weight_map": {"a": "../outside.safetensors"}}))
    with pytest.raises(TronError, match="not there"):
        folder_state(folder)


def test_of_two_precisions_the_plain_one_is_read_and_others_are_not_mixed(tmp_path):
    save_file({"a": torch.ones(1)}, tmp_path / "model.fp16.safetensors")
    save_file({"a": torch.zeros(1)}, tmp_path / "model.bf16.safetensors")
    with pytest.raises(TronError, match=r"2 \.safetensors files and no index"):
        folder_state(tmp_path)
    save_file({"a": torch.full((1,), 2.0)}, tmp_path / "diffusion_pytorch_model.safetensors")
    assert folder_state(tmp_path)["a"].item() == 2


def test_of_two_indices_the_plain_one_is_followed(tmp_path):
    """Hugging Face's folders hold another precision as NAME.fp16.safetensors, with an index of its own."""
    folder = sharded(tmp_path / "transformer")
    half = {"weight_map": {"a": "diffusion_pytorch_model.fp16.safetensors"}}
    (folder / "diffusion_pytorch_model.safetensors.index.fp16.json").write_text(json.dumps(half))
    (folder / "diffusion_pytorch_model.fp16.safetensors.index.json").write_text(json.dumps(half))
    assert folder_state(folder)["a"].tolist() == [1, 1]
    (folder / INDEX).unlink()
    assert folder_state(folder)["a"].tolist() == [7, 7]
    save_file({"a": torch.zeros(2)}, folder / "diffusion_pytorch_model.safetensors")
    assert folder_state(folder)["a"].tolist() == [0, 0]


def test_byte_buffers_of_transformer_engine_are_left_out(tmp_path):
    held = {"net.w": torch.ones(2), "net.q_norm._extra_state": io.BytesIO(b"bytes")}
    torch.save(held, tmp_path / "model.pt")
    assert set(torch_state(tmp_path / "model.pt")) == {"net.w"}


class _Explosive:
    def __reduce__(self):
        return (print, ("executed",))


@pytest.mark.parametrize("name", ["state", "extra_state", "plain", "text", "empty", "short", "list"])
def test_files_that_are_no_weights_are_one_line_and_nothing_runs(tmp_path, name, capsys):
    path = tmp_path / "model.pt"
    torch.save({"net.w": torch.ones(4096)}, path)
    whole = path.read_bytes()
    if name == "state":
        torch.save({"net.w": _Explosive()}, path)
    elif name == "extra_state":
        torch.save({"net.w": torch.ones(1), "net.q_norm._extra_state": _Explosive()}, path)
    elif name == "plain":
        path.write_bytes(pickle.dumps(_Explosive()))
    elif name == "list":
        torch.save([torch.ones(1)], path)
    else:
        path.write_bytes({"text": b"weights", "empty": b"", "short": whole[: len(whole) // 2]}[name])
    for load in (lambda p: load_cosmos_state(p, BackboneConfig(), 16), load_wan):
        with pytest.raises(TronError) as caught:
            load(path)
        assert "\n" not in str(caught.value)
        assert "model.pt" in str(caught.value)
    assert capsys.readouterr().out == ""


def test_the_wrong_one_of_two_files_is_named(tmp_path):
    torch.save({"conv1.weight": torch.ones(32, 32, 1, 1, 1)}, tmp_path / "tokenizer.pth")
    with pytest.raises(TronError, match="do not fit the model at"):
        load_cosmos_state(tmp_path / "tokenizer.pth", BackboneConfig(), 16)
    torch.save({"net.x_embedder.proj.1.weight": torch.ones(8, 8)}, tmp_path / "model.pt")
    with pytest.raises(TronError, match="do not fit the model at"):
        load_wan(tmp_path / "model.pt")
