"""Weights in and out: our safetensors files, and the published Cosmos-Predict2 and WAN 2.1 from local paths.

Nothing is ever fetched from the network and nothing in a file is executed: safetensors holds numbers and
text, and `.pt`/`.pth` files are read with `weights_only=True`.
"""

from __future__ import annotations

import json
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from diffusers.loaders.single_file_utils import (
    convert_cosmos_transformer_checkpoint_to_diffusers,
    convert_wan_vae_to_diffusers,
)
from diffusers.models.autoencoders.autoencoder_kl_wan import AutoencoderKLWan
from pydantic import ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as serialize
from torch import Tensor, nn

from tron.errors import TronError
from tron.neural.backbone import COSMOS_0_6B, BackboneConfig, transformer
from tron.neural.codecs import WanCodec
from tron.neural.pixel_mlp import PixelMLP, PixelMLPConfig
from tron.neural.renderer import NeuralRenderer, RendererConfig
from tron.storage import write_atomic

FORMAT = "tron-renderer 1"
METADATA_KEY = "tron"
COSMOS_FILE = "model.pt of nvidia/Cosmos-Predict2-0.6B-Text2Image (or its diffusers folder `transformer`)"
WAN_FILE = "tokenizer/tokenizer.pth of the same repository (or a diffusers folder `vae` of WAN 2.1)"


def save_renderer(path: str | Path, renderer: nn.Module) -> None:
    """Write a NeuralRenderer or PixelMLP with its configuration into one .safetensors file, atomically."""
    kinds = {NeuralRenderer: "neural", PixelMLP: "pixel_mlp"}
    if type(renderer) not in kinds:
        raise TypeError(f"no file format for a {type(renderer).__name__}")
    config: Any = renderer.config
    header = {"format": FORMAT, "kind": kinds[type(renderer)], "config": config.model_dump(mode="json")}
    state = {name: tensor.detach().cpu().contiguous() for name, tensor in renderer.state_dict().items()}
    # One key, since safetensors writes several in the order of a hash that changes from run to run.
    write_atomic(path, serialize(state, {METADATA_KEY: json.dumps(header)}))


def load_renderer(path: str | Path, vae: str | Path | None = None) -> nn.Module:
    """Read a renderer that `save_renderer` wrote, in eval mode on the CPU.

    vae: the WAN VAE, needed where the renderer's codec is "wan" (it is frozen and never stored again). Raises
    TronError where the file is missing, damaged, or not a renderer.
    """
    path = Path(path)
    mend = "give the renderer.safetensors that tron-train wrote"
    if not path.is_file():
        raise TronError("renderer file not found", str(path), mend)
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            # Cloned, since memory at odd addresses makes the last bit of matrix products differ.
            state = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118 (no mapping)
    except (SafetensorError, OSError) as error:
        raise TronError(f"not a readable safetensors file: {error}", str(path), mend) from error
    try:
        header = json.loads(metadata.get(METADATA_KEY, "{}"))
        if header.get("format") != FORMAT:
            raise TronError("safetensors file holds no TRON renderer", str(path), mend)
        renderer = _build(header["kind"], header["config"], vae)
    except (ValidationError, ValueError, KeyError, AttributeError) as error:
        raise TronError("the renderer's configuration is damaged", str(path), mend) from error
    _load_strictly(renderer, state, path)
    return renderer.eval()


def _build(kind: str, config: dict[str, Any], vae: str | Path | None) -> nn.Module:
    # The file chooses among these two and nothing else: a name to import would be code in a data file.
    if kind == "pixel_mlp":
        return PixelMLP(PixelMLPConfig.model_validate(config))
    if kind == "neural":
        parsed = RendererConfig.model_validate(config)
        return NeuralRenderer(parsed, load_wan(vae) if parsed.codec == "wan" else None)
    raise ValueError(kind)


def load_cosmos(
    transformer_path: str | Path | None,
    vae_path: str | Path | None,
    config: RendererConfig | Mapping[str, Any] | None = None,
) -> NeuralRenderer:
    """Make the renderer of the paper from the published weights.

    Args:
        transformer_path: raw `model.pt` (keys `net.*`) or a diffusers folder with safetensors.
        vae_path: raw `tokenizer.pth` or a diffusers folder.
        config: default: fusion "average", skip "mean", sigma 0.25, codec "wan", the 0.6B backbone. With
        fusion
            "concat" the input layer gets zero columns for the second latent, so training starts from the PBR
            latent alone.

    Raises:
        TronError: a path is missing (it names the file to download), unreadable, or of another shape.
    """
    if config is None:
        config = {}
    if not isinstance(config, RendererConfig):
        defaults = {
            "codec": "wan",
            "fusion": "average",
            "skip": "mean",
            "sigma": 0.25,
            "backbone": COSMOS_0_6B,
        }
        config = RendererConfig.model_validate({**defaults, **config})
    found = _existing(transformer_path, "the Cosmos transformer", COSMOS_FILE)
    codec = load_wan(vae_path)
    with torch.device("meta"):  # 2.4 GB of random numbers need not be drawn to be thrown away
        renderer = NeuralRenderer(config, codec)
    state = load_cosmos_state(found, config.backbone, codec.latent_channels)
    if config.fusion == "concat":
        state["patch_embed.proj.weight"] = _widened(state["patch_embed.proj.weight"], config, codec)
    if config.backbone.cross_attention == "none":
        state = {k: v for k, v in state.items() if ".attn2." not in k and ".norm2." not in k}
    _load_strictly(renderer.backbone.transformer, state, found)
    return renderer


def load_cosmos_state(path: Path, config: BackboneConfig, channels: int) -> dict[str, Tensor]:
    """The transformer's weights in diffusers' names, float32, checked key by key against the config."""
    if path.is_dir():
        state = _folder_state(path)
    else:
        raw = _torch_state(path)
        raw = {key: value for key, value in raw.items() if not key.startswith("net_ema.")}
        try:
            state = convert_cosmos_transformer_checkpoint_to_diffusers(raw)
        except (KeyError, RuntimeError, ValueError) as error:
            raise TronError(f"not a Cosmos checkpoint: {error}", str(path), f"give {COSMOS_FILE}") from error
    with torch.device("meta"):
        expected = transformer(config, channels, channels)
    _load_strictly(expected, state, path)
    return {name: tensor.float() for name, tensor in state.items()}


def load_wan(path: str | Path | None, **structure: Any) -> WanCodec:
    """The WAN 2.1 VAE from raw `tokenizer.pth` or a diffusers folder; `structure`: diffusers' arguments."""
    found = _existing(path, "the WAN 2.1 VAE", WAN_FILE)
    if found.is_dir():
        config = found / "config.json"
        if config.is_file() and not structure:
            names = json.loads(config.read_text())
            structure = {key: value for key, value in names.items() if not key.startswith("_")}
        state = _folder_state(found)
    else:
        raw = _torch_state(found)
        try:
            state = convert_wan_vae_to_diffusers(raw)
        except (KeyError, RuntimeError, ValueError) as error:
            raise TronError(f"not a WAN 2.1 VAE: {error}", str(found), f"give {WAN_FILE}") from error
    with torch.device("meta"):
        vae = AutoencoderKLWan(**structure)
    _load_strictly(vae, {name: tensor.float() for name, tensor in state.items()}, found)
    return WanCodec(vae)


def _widened(weight: Tensor, config: RendererConfig, codec: WanCodec) -> Tensor:
    """Zero columns for the irradiance latent, between the PBR latent and the padding channel.

    The patch embedding's columns are ordered channel first, then the pixels of the patch.
    """
    per_channel = weight.shape[1] // (codec.latent_channels + int(config.backbone.padding_channel))
    split = codec.latent_channels * per_channel
    zeros = torch.zeros_like(weight[:, :split])
    return torch.cat([weight[:, :split], zeros, weight[:, split:]], 1)


def _existing(path: str | Path | None, what: str, file: str) -> Path:
    mend = f"download {file} and give its path"
    if path is None:
        raise TronError(f"no path to {what}", mend=mend)
    if not Path(path).exists():
        raise TronError(f"{what} is not there", str(path), mend)
    return Path(path)


def _torch_state(path: Path) -> dict[str, Tensor]:
    try:
        state = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, OSError, ValueError) as error:
        raise TronError("not a file of plain weights", str(path), "download it again") from error
    if not isinstance(state, dict):
        raise TronError("checkpoint holds no state dict", str(path))
    return {str(k): v for k, v in state.items() if isinstance(v, Tensor) and not k.endswith("_extra_state")}


def _folder_state(folder: Path) -> dict[str, Tensor]:
    files = sorted(folder.glob("*.safetensors"))
    if not files:
        raise TronError("folder holds no .safetensors file", str(folder))
    state: dict[str, Tensor] = {}
    for path in files:
        try:
            with safe_open(path, framework="pt") as file:
                state.update({name: file.get_tensor(name) for name in file.keys()})  # noqa: SIM118
        except (SafetensorError, OSError) as error:
            raise TronError(f"not a readable safetensors file: {error}", str(path)) from error
    return state


def _load_strictly(module: nn.Module, state: Mapping[str, Tensor], path: Path) -> None:
    expected = module.state_dict()
    wrong = sorted(set(expected) ^ set(state))
    wrong += [name for name in expected if name in state and expected[name].shape != state[name].shape]
    if wrong:
        more = f" and {len(wrong) - 1} more" if len(wrong) > 1 else ""
        raise TronError(f"weights do not fit the model at '{wrong[0]}'{more}", str(path))
    module.load_state_dict(dict(state), strict=True, assign=True)
