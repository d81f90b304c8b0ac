"""Read weights files, our own and published ones, into state dicts; nothing in a file is executed.

safetensors holds numbers and text, and `.pt`/`.pth` files are read with `weights_only=True`.
"""

from __future__ import annotations

import io
import json
import pickle
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from tron.errors import TronError

PLAIN_FILE = "diffusion_pytorch_model.safetensors"
"""File name of diffusers weights in a folder; other precisions add their name to it."""


def existing(path: str | Path | None, what: str, file: str) -> Path:
    """Return the path if it exists; otherwise TronError names the file to download."""
    mend = f"download {file} and give its path"
    if path is None:
        raise TronError(f"no path to {what}", mend=mend)
    if not Path(path).exists():
        raise TronError(f"{what} is not there", str(path), mend)
    return Path(path)


def torch_state(path: Path) -> dict[str, Tensor]:
    """Return the tensors of a `.pt` or `.pth` file, by name."""
    try:
        # Transformer Engine's layers leave byte buffers (`_extra_state`) in published files: data, no code.
        with torch.serialization.safe_globals([io.BytesIO]):
            state = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, OSError, ValueError) as error:
        raise TronError("not a file of plain weights", str(path), "download it again") from error
    if not isinstance(state, dict):
        raise TronError("checkpoint holds no state dict", str(path))
    return {str(k): v for k, v in state.items() if isinstance(v, Tensor) and not k.endswith("_extra_state")}


def folder_state(folder: Path) -> dict[str, Tensor]:
    """Return the tensors of a diffusers folder by name, from the files in its index or from its only file."""
    state: dict[str, Tensor] = {}
    for path in _folder_files(folder):
        state.update(safetensors_state(path)[0])
    return state


def _folder_files(folder: Path) -> list[Path]:
    """The safetensors files of a diffusers folder; another precision's beside them is not mixed in."""
    plain, index = folder / PLAIN_FILE, folder / f"{PLAIN_FILE}.index.json"
    if not index.is_file():
        if plain.is_file():
            return [plain]
        files, indices = (sorted(folder.glob(f"*.safetensors{end}")) for end in ("", ".index.json"))
        if not files:
            raise TronError("folder holds no .safetensors file", str(folder))
        if len(files) == 1 and not indices:
            return files
        if len(indices) != 1:
            said = f"{len(files)} .safetensors files and {len(indices) or 'no'} index{'es' * bool(indices)}"
            mend = "leave the one that is to be loaded, or give its index.json"
            raise TronError(f"folder holds {said}", str(folder), mend)
        (index,) = indices
    try:
        names = sorted(set(json.loads(index.read_text())["weight_map"].values()))
        files = [folder / Path(name).name for name in names]  # an index names files of its own folder
    except (OSError, ValueError, KeyError, AttributeError, TypeError) as error:
        raise TronError("not an index of weights", str(index), "download it again") from error
    for path in files:
        if not path.is_file():
            raise TronError("a file of the index is not there", str(path), "download it")
    return files


def safetensors_state(path: Path, mend: str | None = None) -> tuple[dict[str, Tensor], dict[str, str]]:
    """The tensors of a safetensors file by name, and its metadata."""
    try:
        with safe_open(path, framework="pt") as file:
            # Cloned, since memory at odd addresses makes the last bit of matrix products differ.
            state = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118 (no mapping)
            return state, file.metadata() or {}
    except (SafetensorError, OSError) as error:
        raise TronError(f"not a readable safetensors file: {error}", str(path), mend) from error


def load_strictly(module: nn.Module, state: Mapping[str, Tensor], path: Path) -> None:
    """Load weights into a module; TronError names the first missing, unknown or mismatched tensor."""
    expected = module.state_dict()
    wrong = dict.fromkeys(expected.keys() - state.keys(), "missing")
    wrong |= dict.fromkeys(state.keys() - expected.keys(), "unknown")
    for name in expected.keys() & state.keys():
        if expected[name].shape != state[name].shape:
            wrong[name] = f"{_shape(state[name])}, not {_shape(expected[name])}"
    if wrong:
        first = min(wrong)
        more = f" and {len(wrong) - 1} more" if len(wrong) > 1 else ""
        raise TronError(f"weights do not fit the model at '{first}' ({wrong[first]}){more}", str(path))
    module.load_state_dict(dict(state), strict=True, assign=True)


def _shape(tensor: Tensor) -> str:
    return " x ".join(str(side) for side in tensor.shape) or "a number"
