"""Save and load weights: our safetensors files, and the published Cosmos-Predict2 from local paths.

Nothing is ever fetched from the network and nothing in a file is executed.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from pydantic import ValidationError
from safetensors.torch import save as serialize
from torch import Tensor

from tron.errors import TronError
from tron.neural.codecs.published_files import (
    existing,
    folder_state,
    load_strictly,
    safetensors_state,
    torch_state,
)
from tron.neural.codecs.registry import CODECS
from tron.neural.configs import (
    PAPER_GUIDANCE,
    BackboneConfig,
    CosmosConfig,
    RendererConfig,
    UNetConfig,
)
from tron.neural.kinds import OURS, config_class, kind_of, renderer_class
from tron.neural.protocols import Codec, Renderer
from tron.neural.renderer import NeuralRenderer, predicted
from tron.storage import write_atomic

log = logging.getLogger(__name__)

FORMAT = "tron-renderer 1"
METADATA_KEY = "tron"
MEND = "give the renderer.safetensors that tron-train wrote"
COSMOS_FILE = "model.pt of nvidia/Cosmos-Predict2-0.6B-Text2Image (or its diffusers folder `transformer`)"


def save_renderer(path: str | Path, renderer: Renderer) -> None:
    """Write a renderer, the name of its class and its configuration into one .safetensors file, atomically.

    Raises:
        TronError: the class could not be found again (`kind_of`).
    """
    header = {"format": FORMAT, "kind": kind_of(renderer), "config": renderer.config.model_dump(mode="json")}
    state = {name: tensor.detach().cpu().contiguous() for name, tensor in renderer.state_dict().items()}
    # One key, since safetensors writes several in the order of a hash that changes from run to run.
    write_atomic(path, serialize(state, {METADATA_KEY: json.dumps(header)}))


def require_saved(renderer: Renderer) -> None:
    """Raise TronError unless a file of `save_renderer` restores a renderer with the same weights.

    For a network of one's own, before it is trained: a mistake would otherwise show at the end.
    """
    kind = kind_of(renderer)
    if kind in OURS:
        return
    try:
        again = _build(kind, renderer.config.model_dump(mode="json"), None)
    except Exception as error:
        raise TronError(
            f"{kind} cannot be made from its settings alone: {error}",
            mend="its __init__ takes config and nothing else",
        ) from error
    shapes, those = ({name: t.shape for name, t in each.state_dict().items()} for each in (renderer, again))
    if shapes != those:
        name = next(n for n in [*shapes, *those] if shapes.get(n) != those.get(n))
        raise TronError(
            f"{kind} made again from its settings has another '{name}'", mend="let config decide every shape"
        )


def load_renderer(path: str | Path, vae: str | Path | None = None) -> Renderer:
    """Read a renderer that `save_renderer` wrote, in eval mode on the CPU.

    vae: the WAN VAE, needed where the renderer's codec is "wan" (it is frozen and never stored again). Raises
    TronError where the file is missing, damaged, or not a renderer, or its class is not known here
    (`tron.neural.kinds`).
    """
    path = Path(path)
    state, metadata = _read(path)
    try:
        header = json.loads(metadata.get(METADATA_KEY, "{}"))
        if header.get("format") != FORMAT:
            raise TronError("safetensors file holds no TRON renderer", str(path), MEND)
        renderer = _build(str(header["kind"]), header["config"], vae, path)
    except ValidationError as error:
        first = error.errors()[0]
        key, said = ".".join(map(str, first["loc"])), first["msg"].removeprefix("Value error, ")
        raise TronError(
            f"the renderer's configuration is not one of ours: {key}: {said}", path, MEND
        ) from error
    except (ValueError, KeyError, AttributeError, TypeError) as error:
        raise TronError("the renderer's configuration is damaged", str(path), MEND) from error
    load_strictly(renderer, state, path)
    return renderer.eval()


def restore_renderer(path: str | Path, renderer: Renderer) -> None:
    """Put the weights that `save_renderer` wrote into a renderer of the same configuration.

    A renderer with paths between frames also takes the weights of one without them, a U-Net those of one that
    is given fewer buffers: a warm start, from what that one draws. TronError names the first weight that is
    missing, unknown or of another shape.
    """
    path = Path(path)
    state, metadata = _read(path)
    if isinstance(renderer, NeuralRenderer) and (given := _config(metadata)) is not None:
        wider = widened(state, given, renderer)
        if wider is not state:
            log.info(
                "%s was without %s: their weights start from zero", path, ", ".join(_new(given, renderer))
            )
        elif given.skip_holes not in (0, renderer.config.skip_holes):
            holes = f"{given.skip_holes}, not {renderer.config.skip_holes}"
            raise TronError(f"weights of skip_holes={holes}", str(path), "give the network as many")
        state = wider
    temporal = renderer.temporal_weights()
    if temporal and not set(temporal) & set(state):
        log.info("%s was trained on single frames: the paths between frames start from zero", path)
        state |= {name: parameter.detach() for name, parameter in temporal.items()}
    load_strictly(renderer, state, path)


def _new(given: RendererConfig, renderer: NeuralRenderer) -> list[str]:
    """What a network has that the one of configuration ``given`` had not."""
    config = renderer.config
    parts = ("skip_detail", "skip_holes")
    new = [name for name in config.guidance if name not in given.guidance]
    return new + [name for name in parts if getattr(config, name) and not getattr(given, name)]


def _config(metadata: Mapping[str, str]) -> RendererConfig | None:
    """Configuration of a NeuralRenderer's file; None where it says none, or another's."""
    try:
        header = json.loads(metadata.get(METADATA_KEY, "{}"))
        return RendererConfig.model_validate(header["config"]) if header["kind"] == "neural" else None
    except (ValueError, KeyError, TypeError):
        return None


def _read(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    if not path.is_file():
        raise TronError("renderer file not found", str(path), MEND)
    return safetensors_state(path, MEND)


def _build(kind: str, config: dict[str, Any], vae: str | Path | None, where: Path | None = None) -> Renderer:
    cls = renderer_class(kind, where)
    # Files before schema 2 do not name their guidance.
    parsed = config_class(cls).model_validate({"guidance": PAPER_GUIDANCE, **config})
    if cls is NeuralRenderer:
        assert isinstance(parsed, RendererConfig)
        return NeuralRenderer(parsed, CODECS[parsed.codec](vae))
    return cls(parsed)


def load_cosmos(
    transformer_path: str | Path | None,
    vae_path: str | Path | None,
    config: RendererConfig | Mapping[str, Any] | None = None,
) -> NeuralRenderer:
    """Make the renderer of the paper from the published weights.

    Args:
        transformer_path: raw `model.pt` (keys `net.*`) or a diffusers folder with safetensors.
        vae_path: raw `tokenizer.pth` or a diffusers folder.
        config: what a mapping leaves out is as in CosmosConfig. With fusion "concat" the input layer gets
            zero columns for every latent but the first, so training starts from that one alone.

    Raises:
        TronError: a path is missing (it names the file to download), unreadable, or of another shape.
    """
    from tron.neural.networks.backbone import Backbone

    if not isinstance(config, RendererConfig):
        config = CosmosConfig.model_validate(config or {})
    shape = config.backbone
    if not isinstance(shape, BackboneConfig):
        raise TronError("published weights do not fit a U-Net", mend="leave backbone.kind=unet out")
    found = existing(transformer_path, "the Cosmos transformer", COSMOS_FILE)
    codec = CODECS[config.codec](vae_path)
    with torch.device("meta"):  # 2.4 GB of random numbers need not be drawn to be thrown away
        renderer = NeuralRenderer(config, codec)
    state = load_cosmos_state(found, shape, codec.latent_channels)
    if config.fusion == "concat":
        state["patch_embed.proj.weight"] = _widened(
            state["patch_embed.proj.weight"], len(config.guidance), shape, codec
        )
    if shape.cross_attention == "none":
        state = {k: v for k, v in state.items() if ".attn2." not in k and ".norm2." not in k}
    assert isinstance(renderer.backbone, Backbone)
    load_strictly(renderer.backbone.transformer, state, found)
    return renderer


def load_cosmos_state(path: Path, config: BackboneConfig, channels: int) -> dict[str, Tensor]:
    """Return the transformer's weights under diffusers' names, float32, checked against the config."""
    from diffusers.loaders.single_file_utils import convert_cosmos_transformer_checkpoint_to_diffusers

    from tron.neural.networks.backbone import transformer

    if path.is_dir():
        state = folder_state(path)
    else:
        raw = torch_state(path)
        raw = {key: value for key, value in raw.items() if not key.startswith("net_ema.")}
        try:
            state = convert_cosmos_transformer_checkpoint_to_diffusers(raw)
        except (KeyError, RuntimeError, ValueError) as error:
            raise TronError(f"not a Cosmos checkpoint: {error}", str(path), f"give {COSMOS_FILE}") from error
    with torch.device("meta"):
        expected = transformer(config, channels, channels)
    load_strictly(expected, state, path)
    return {name: tensor.float() for name, tensor in state.items()}


def _widened(weight: Tensor, latents: int, config: BackboneConfig, codec: Codec) -> Tensor:
    """Zero columns for the latents after the first, in front of the padding channel.

    The patch embedding's columns are ordered channel first, then the pixels of the patch.
    """
    per_channel = weight.shape[1] // (codec.latent_channels + int(config.padding_channel))
    split = codec.latent_channels * per_channel
    zeros = [torch.zeros_like(weight[:, :split])] * (latents - 1)
    return torch.cat([weight[:, :split], *zeros, weight[:, split:]], 1)


# What is added begins at zero: columns of the first layer for the new buffers, and rows of the last for
# shares of detail and kernels with holes. So the wider network draws what the other did (with kernels with
# holes nearly so), and learns from there what the new is worth.

FIRST, LAST = "backbone.embed.weight", ("backbone.out.weight", "backbone.out.bias")


def widened(state: dict[str, Tensor], narrow: RendererConfig, wide: NeuralRenderer) -> dict[str, Tensor]:
    """Convert the state of a U-Net of configuration ``narrow`` to configuration ``wide``.

    The same state where nothing is added, or where they differ in more than guidance, scales, and a
    ``skip_detail`` or ``skip_holes`` that is new.
    """
    config, shape = wide.config, wide.config.backbone
    may_differ = ("guidance", "skip_detail", "skip_holes", "scales", "window")
    added = {name: getattr(narrow, name) for name in may_differ}
    if (
        not isinstance(shape, UNetConfig)
        or config.fusion != "concat"
        or config.model_copy(update=added).model_dump() != narrow.model_dump()
        or not set(narrow.guidance) <= set(config.guidance)
        or narrow.skip_detail not in (None, config.skip_detail)
        or narrow.skip_holes not in (0, config.skip_holes)
        or (narrow.guidance, predicted(narrow, 1)) == (config.guidance, predicted(config, 1))
    ):
        return state
    channels, area = wide.codec.latent_channels, shape.patch**2
    columns, rows = area * len(narrow.guidance) * channels, wide.state_dict()
    parts = predicted(narrow, channels)
    whole = {FIRST, *LAST} <= state.keys() and state[FIRST].shape == (rows[FIRST].shape[0], columns)
    if not whole or any(state[name].shape[0] != area * sum(parts) for name in LAST):
        return state  # damaged: whoever loads it says where
    # Columns and rows of each pixel of a patch lie together: of a column block for each buffer, in order.
    old = state[FIRST].unflatten(1, (area, len(narrow.guidance), channels))
    new = old.new_zeros(*old.shape[:2], len(config.guidance), channels)
    for place, name in enumerate(narrow.guidance):
        new[:, :, config.guidance.index(name)] = old[:, :, place]
    grown = {FIRST: new.flatten(1)}
    for name in LAST:
        old = state[name].unflatten(0, (area, -1))
        # What the old one predicts, each in its place; a part that is new is 0.
        blocks = [
            before if before.shape[1] == size else old.new_zeros(area, size, *old.shape[2:])
            for before, size in zip(old.split(parts, 1), predicted(config, channels), strict=True)
        ]
        grown[name] = torch.cat(blocks, 1).flatten(0, 1)
    return state | grown
