"""Files of weights, ours and published ones, into state dicts; nothing in a file is executed.

safetensors holds numbers and text, and `.pt`/`.pth` files are read with `weights_only=True`.
"""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from tron.errors import TronError


def existing(path: str | Path | None, what: str, file: str) -> Path:
    """The path, if it is there; TronError names the file to download."""
    mend = f"download {file} and give its path"
    if path is None:
        raise TronError(f"no path to {what}", mend=mend)
    if not Path(path).exists():
        raise TronError(f"{what} is not there", str(path), mend)
    return Path(path)


def torch_state(path: Path) -> dict[str, Tensor]:
    """The tensors of a `.pt` or `.pth` file, by name."""
    try:
        state = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, OSError, ValueError) as error:
        raise TronError("not a file of plain weights", str(path), "download it again") from error
    if not isinstance(state, dict):
        raise TronError("checkpoint holds no state dict", str(path))
    return {str(k): v for k, v in state.items() if isinstance(v, Tensor) and not k.endswith("_extra_state")}


def folder_state(folder: Path) -> dict[str, Tensor]:
    """The tensors of all safetensors files of a diffusers folder, by name."""
    files = sorted(folder.glob("*.safetensors"))
    if not files:
        raise TronError("folder holds no .safetensors file", str(folder))
    state: dict[str, Tensor] = {}
    for path in files:
        state.update(safetensors_state(path)[0])
    return state


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
    """Put weights into a module; TronError names the first that is missing, unknown or of another shape."""
    expected = module.state_dict()
    wrong = sorted(set(expected) ^ set(state))
    wrong += [name for name in expected if name in state and expected[name].shape != state[name].shape]
    if wrong:
        more = f" and {len(wrong) - 1} more" if len(wrong) > 1 else ""
        raise TronError(f"weights do not fit the model at '{wrong[0]}'{more}", str(path))
    module.load_state_dict(dict(state), strict=True, assign=True)
