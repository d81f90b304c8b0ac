"""Weights files: what is saved loads again, the published formats load from tiny copies, nothing runs."""

import json
import pickle
from typing import Any

import pytest
import torch
from diffusers.models.autoencoders.autoencoder_kl_wan import AutoencoderKLWan
from safetensors.torch import load_file, save_file

from tron.errors import TronError
from tron.neural.codecs.wan import WanCodec, load_wan
from tron.neural.configs import BackboneConfig, PixelMLPConfig, RendererConfig
from tron.neural.networks.backbone import transformer
from tron.neural.networks.pixel_mlp import PixelMLP
from tron.neural.protocols import Renderer
from tron.neural.renderer import NeuralRenderer
from tron.neural.weights import load_cosmos, load_renderer, restore_renderer, save_renderer
from tron.shards.schema import GUIDANCE

SMALL = BackboneConfig(heads=2, head_dim=12, layers=2, adaln_lora_dim=8)
WAN: dict[str, Any] = {"base_dim": 8, "num_res_blocks": 1}
COSMOS = BackboneConfig(
    heads=2,
    head_dim=12,
    layers=2,
    text_embed_dim=16,
    adaln_lora_dim=8,
    patch=(1, 2, 2),
    max_size=(8, 32, 32),
    rope_scale=(1.0, 4.0, 4.0),
    padding_channel=True,
    cross_attention="frozen",
)
# diffusers' names -> the published checkpoint's, the inverse of the conversion under test
RAW_NAMES = [
    ("transformer_blocks.", "blocks."), ("time_embed.t_embedder.", "t_embedder.1."),
    ("time_embed.norm", "t_embedding_norm"), ("norm1.linear_1", "adaln_modulation_self_attn.1"),
    ("norm1.linear_2", "adaln_modulation_self_attn.2"), ("norm2.linear_1", "adaln_modulation_cross_attn.1"),
    ("norm2.linear_2", "adaln_modulation_cross_attn.2"), ("norm3.linear_1", "adaln_modulation_mlp.1"),
    ("norm3.linear_2", "adaln_modulation_mlp.2"), ("norm_out.linear_1", "final_layer.adaln_modulation.1"),
    ("norm_out.linear_2", "final_layer.adaln_modulation.2"), ("proj_out", "final_layer.linear"),
    ("attn1.", "self_attn."), ("attn2.", "cross_attn."), ("to_q", "q_proj"), ("to_k", "k_proj"),
    ("to_v", "v_proj"), ("to_out.0", "output_proj"), ("norm_q", "q_norm"), ("norm_k", "k_norm"),
    ("ff.net.0.proj", "mlp.layer1"), ("ff.net.2", "mlp.layer2"), ("patch_embed.proj", "x_embedder.proj.1"),
]  # fmt: skip


def inputs(frames: int = 1, size: int = 32):
    generator = torch.Generator().manual_seed(0)
    return {name: torch.rand(1, 3, frames, size, size, generator=generator) * 2 - 1 for name in GUIDANCE}


@pytest.mark.parametrize(
    "renderer",
    [
        NeuralRenderer(RendererConfig(backbone=SMALL, window=5)),
        NeuralRenderer(RendererConfig(fusion="average", skip="mean", sigma=0.25, backbone=SMALL)),
        PixelMLP(PixelMLPConfig(width=8, hidden_layers=2)),
    ],
)
def test_a_saved_renderer_loads_again_bit_by_bit(tmp_path, renderer):
    for parameter in renderer.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    if isinstance(renderer, NeuralRenderer):
        renderer.calibrate([torch.rand(1, 3, 5, 16, 16)])
    save_renderer(tmp_path / "a.safetensors", renderer)
    save_renderer(tmp_path / "b.safetensors", renderer)
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()
    again = load_renderer(tmp_path / "a.safetensors")
    assert type(again) is type(renderer)
    assert again.config == renderer.config
    assert not again.training
    with torch.no_grad():
        torch.testing.assert_close(again(inputs()), renderer.eval()(inputs()), atol=0, rtol=0)


@pytest.mark.parametrize("named", [False, True], ids=["before schema 2", "before schema 3"])
@pytest.mark.parametrize("kind", ["pixel_mlp", "neural"])
def test_files_from_before_lit_render_as_they_did(tmp_path, kind, named):
    """They start from pbr: a transformer's file says so, a pixel network's says nothing of it."""
    guidance = ("pbr", "irradiance")
    renderer: Renderer
    if kind == "pixel_mlp":
        renderer, unsaid = PixelMLP(PixelMLPConfig(width=8, guidance=guidance)), {"skip"}
    else:
        renderer, unsaid = NeuralRenderer(RendererConfig(backbone=SMALL, guidance=guidance)), set()
    for parameter in renderer.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    config = renderer.config.model_dump(mode="json", exclude=unsaid | (set() if named else {"guidance"}))
    assert config.get("skip", "pbr") == "pbr"
    config.pop("weights", None)
    config.get("backbone", {}).pop("kind", None)  # there was one kind alone
    header = {"format": "tron-renderer 1", "kind": kind, "config": config}
    save_file(renderer.state_dict(), tmp_path / "old.safetensors", {"tron": json.dumps(header)})
    again = load_renderer(tmp_path / "old.safetensors")
    assert (again.config.guidance, again.config.skip) == (guidance, "pbr")
    torch.testing.assert_close(again(inputs()), renderer(inputs()), atol=0, rtol=0)


def test_weights_go_back_into_a_renderer_that_is_there(tmp_path):
    saved, other = (PixelMLP(PixelMLPConfig(width=8)) for _ in range(2))
    torch.nn.init.normal_(list(saved.parameters())[-2])
    save_renderer(tmp_path / "a.safetensors", saved)
    restore_renderer(tmp_path / "a.safetensors", other)
    torch.testing.assert_close(other(inputs()), saved(inputs()), atol=0, rtol=0)
    with pytest.raises(TronError, match="do not fit the model at"):
        restore_renderer(tmp_path / "a.safetensors", PixelMLP(PixelMLPConfig(width=4)))


def test_files_that_are_no_renderer_are_refused_in_one_line(tmp_path):
    save_renderer(tmp_path / "good.safetensors", PixelMLP())
    data = (tmp_path / "good.safetensors").read_bytes()
    header = {"format": "tron-renderer 1", "kind": "pixel_mlp", "config": {}}
    headers = {
        "foreign": None,
        "list": "[]",
        "text": "{",
        "keys": json.dumps(header),
        "kind": json.dumps(header | {"kind": "os.system"}),
        "config": json.dumps(header | {"config": {"width": "wide"}}),
    }
    for name, text in headers.items():
        save_file({"x": torch.zeros(1)}, tmp_path / f"{name}.safetensors", {"tron": text} if text else None)
    (tmp_path / "short.safetensors").write_bytes(data[: len(data) // 2])
    (tmp_path / "empty.safetensors").write_bytes(b"")
    (tmp_path / "pickle.safetensors").write_bytes(pickle.dumps({"x": 1}))
    for name in (*headers, "short", "empty", "pickle", "missing"):
        with pytest.raises(TronError) as caught:
            load_renderer(tmp_path / f"{name}.safetensors")
        assert "\n" not in str(caught.value)
        assert f"{name}.safetensors" in str(caught.value)


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    """Tiny random copies of the published files: raw transformer and VAE folders, and what they hold."""
    folder = tmp_path_factory.mktemp("published")
    torch.manual_seed(0)
    model = transformer(COSMOS, 16, 16)
    raw = {}
    for name, tensor in model.state_dict().items():
        for ours, theirs in RAW_NAMES:
            name = name.replace(ours, theirs)
        raw[f"net.{name}"] = tensor
        raw[f"net_ema.{name}"] = torch.zeros_like(tensor)
    raw["net.pos_embedder.seq"] = torch.arange(4)
    raw["net.pos_embedder.dim_spatial_range"] = torch.zeros(2)
    raw["net.pos_embedder.dim_temporal_range"] = torch.zeros(2)
    raw["net.blocks.0.self_attn._extra_state"] = torch.zeros(1)
    torch.save(raw, folder / "model.pt")
    model.save_pretrained(folder / "transformer")
    vae = AutoencoderKLWan(**WAN).eval()
    vae.save_pretrained(folder / "vae")
    return folder, model, vae


@pytest.mark.parametrize("source", ["model.pt", "transformer"])
def test_the_published_formats_load_into_the_paper_s_step(published, source):
    folder, model, vae = published
    renderer = load_cosmos(folder / source, folder / "vae", {"backbone": COSMOS.model_dump()})
    assert renderer.config.fusion == "average"
    given = inputs(5)
    codec = WanCodec(vae)
    with torch.no_grad():
        z = 0.5 * (codec.encode(given["pbr"]) + codec.encode(given["irradiance"]))
        # Cosmos-Predict2's preconditioning at sigma 0.25: t = 0.2, x0 = 0.8 z - 0.2 net(0.8 z)
        fed = torch.cat([0.8 * z, torch.zeros_like(z[:, :1])], 1)
        net = model(
            fed, timestep=torch.tensor([0.2]), encoder_hidden_states=torch.zeros(1, 1, 16), return_dict=False
        )
        expected = codec.decode(0.8 * z - 0.2 * net[0])
        torch.testing.assert_close(renderer(given), expected, atol=1e-5, rtol=0)


def test_concatenation_of_published_weights_starts_from_the_pbr_latent(published):
    folder, model, vae = published
    config = {"backbone": COSMOS.model_dump(), "fusion": "concat", "skip": "pbr"}
    renderer = load_cosmos(folder / "model.pt", folder / "vae", config)
    given = inputs()
    codec = WanCodec(vae)
    with torch.no_grad():
        z = codec.encode(given["pbr"])
        fed = torch.cat([0.8 * z, torch.zeros_like(z[:, :1])], 1)
        net = model(
            fed, timestep=torch.tensor([0.2]), encoder_hidden_states=torch.zeros(1, 1, 16), return_dict=False
        )
        expected = codec.decode(0.8 * z - 0.2 * net[0])
        torch.testing.assert_close(renderer(given), expected, atol=1e-5, rtol=0)


def test_gradients_reach_the_transformer_and_stop_at_the_text_branch(published):
    folder, _, _ = published
    renderer = load_cosmos(folder / "transformer", folder / "vae", {"backbone": COSMOS.model_dump()})
    renderer(inputs()).square().mean().backward()
    with_gradient = {name for name, p in renderer.named_parameters() if p.grad is not None}
    assert with_gradient == {name for name, p in renderer.named_parameters() if p.requires_grad}
    assert not any(".attn2." in name or ".norm2." in name or "vae" in name for name in with_gradient)


def test_a_trained_cosmos_renderer_is_saved_without_the_frozen_vae(published, tmp_path):
    folder, _, _ = published
    renderer = load_cosmos(folder / "transformer", folder / "vae", {"backbone": COSMOS.model_dump()})
    save_renderer(tmp_path / "r.safetensors", renderer)
    assert all(name.startswith("backbone.") for name in load_file(tmp_path / "r.safetensors"))
    again = load_renderer(tmp_path / "r.safetensors", vae=folder / "vae")
    with torch.no_grad():
        torch.testing.assert_close(again(inputs()), renderer(inputs()), atol=1e-5, rtol=0)
    with pytest.raises(TronError, match=r"tokenizer\.pth"):
        load_renderer(tmp_path / "r.safetensors")


def test_missing_files_are_named_with_what_to_download(published, tmp_path):
    folder, _, _ = published
    with pytest.raises(TronError, match=r"model\.pt of nvidia/Cosmos-Predict2"):
        load_cosmos(None, folder / "vae")
    with pytest.raises(TronError, match=r"nowhere.*download model\.pt"):
        load_cosmos(tmp_path / "nowhere", folder / "vae")
    with pytest.raises(TronError, match=r"tokenizer/tokenizer\.pth"):
        load_cosmos(folder / "model.pt", None)


def test_weights_of_another_shape_are_refused_by_name(published, tmp_path):
    folder, _, _ = published
    with pytest.raises(TronError, match="do not fit the model at"):
        load_cosmos(folder / "model.pt", folder / "vae")  # the real 0.6B configuration
    with pytest.raises(TronError, match="do not fit the model at"):
        load_wan(folder / "vae", base_dim=16, num_res_blocks=1)
    with pytest.raises(TronError):
        load_cosmos(tmp_path, folder / "vae", {"backbone": COSMOS.model_dump()})
