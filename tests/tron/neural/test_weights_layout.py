"""Names and shapes of the published files, written down here from their public layout, against our models.

Everything is on the meta device: no weight is allocated.
"""

from collections.abc import Iterator

import pytest
import torch
from diffusers.loaders.single_file_utils import (
    convert_cosmos_transformer_checkpoint_to_diffusers,
    convert_wan_vae_to_diffusers,
)
from diffusers.models.autoencoders.autoencoder_kl_wan import AutoencoderKLWan

from tron.errors import TronError
from tron.neural.codecs.published_files import load_strictly
from tron.neural.configs import COSMOS_0_6B
from tron.neural.networks.backbone import Backbone, transformer

Shapes = dict[str, tuple[int, ...]]

WIDTH, TEXT, LORA, HEAD, LAYERS = 1280, 1024, 256, 64, 20


def raw_cosmos() -> Shapes:
    """Tensors of Cosmos-Predict2-0.6B's model.pt, without the averaged copy, counters and positions."""
    shapes: Shapes = {
        "x_embedder.proj.1.weight": (WIDTH, (16 + 1) * 2 * 2),
        "t_embedder.1.linear_1.weight": (WIDTH, WIDTH),
        "t_embedder.1.linear_2.weight": (3 * WIDTH, WIDTH),
        "t_embedding_norm.weight": (WIDTH,),
        "final_layer.linear.weight": (16 * 2 * 2, WIDTH),
        "final_layer.adaln_modulation.1.weight": (LORA, WIDTH),
        "final_layer.adaln_modulation.2.weight": (2 * WIDTH, LORA),
    }
    for block in range(LAYERS):
        for attention, seen in (("self_attn", WIDTH), ("cross_attn", TEXT)):
            of = f"blocks.{block}.{attention}"
            shapes |= {f"{of}.{name}.weight": (WIDTH, WIDTH) for name in ("q_proj", "output_proj")}
            shapes |= {f"{of}.{name}.weight": (WIDTH, seen) for name in ("k_proj", "v_proj")}
            shapes |= {f"{of}.{name}.weight": (HEAD,) for name in ("q_norm", "k_norm")}
        for part in ("self_attn", "cross_attn", "mlp"):
            shapes[f"blocks.{block}.adaln_modulation_{part}.1.weight"] = (LORA, WIDTH)
            shapes[f"blocks.{block}.adaln_modulation_{part}.2.weight"] = (3 * WIDTH, LORA)
        shapes[f"blocks.{block}.mlp.layer1.weight"] = (4 * WIDTH, WIDTH)
        shapes[f"blocks.{block}.mlp.layer2.weight"] = (WIDTH, 4 * WIDTH)
    return {f"net.{name}": shape for name, shape in shapes.items()}


def diffusers_cosmos() -> Shapes:
    """The same in diffusers' names, as the index of a folder `transformer` lists them."""
    shapes: Shapes = {
        "patch_embed.proj.weight": (WIDTH, 68),
        "time_embed.t_embedder.linear_1.weight": (WIDTH, WIDTH),
        "time_embed.t_embedder.linear_2.weight": (3 * WIDTH, WIDTH),
        "time_embed.norm.weight": (WIDTH,),
        "norm_out.linear_1.weight": (LORA, WIDTH),
        "norm_out.linear_2.weight": (2 * WIDTH, LORA),
        "proj_out.weight": (64, WIDTH),
    }
    for block in range(LAYERS):
        of = f"transformer_blocks.{block}"
        for attention, seen in (("attn1", WIDTH), ("attn2", TEXT)):
            shapes |= {f"{of}.{attention}.{name}.weight": (WIDTH, WIDTH) for name in ("to_q", "to_out.0")}
            shapes |= {f"{of}.{attention}.{name}.weight": (WIDTH, seen) for name in ("to_k", "to_v")}
            shapes |= {f"{of}.{attention}.{name}.weight": (HEAD,) for name in ("norm_q", "norm_k")}
        for norm in ("norm1", "norm2", "norm3"):
            shapes[f"{of}.{norm}.linear_1.weight"] = (LORA, WIDTH)
            shapes[f"{of}.{norm}.linear_2.weight"] = (3 * WIDTH, LORA)
        shapes[f"{of}.ff.net.0.proj.weight"] = (4 * WIDTH, WIDTH)
        shapes[f"{of}.ff.net.2.weight"] = (WIDTH, 4 * WIDTH)
    return shapes


LEFT_OUT: Shapes = {
    "net.pos_embedder.seq": (128,),
    "net.pos_embedder.dim_spatial_range": (11,),
    "net.pos_embedder.dim_temporal_range": (10,),
    "net.accum_video_sample_counter": (),
    "net.accum_image_sample_counter": (),
    "net.accum_iteration": (),
    "net.accum_train_in_hours": (),
}
"""What the raw file holds besides weights."""


def residual(prefix: str, before: int, after: int) -> Iterator[tuple[str, tuple[int, ...]]]:
    """A residual block of the raw VAE: norm, activation, convolution, twice, and a shortcut."""
    for number, channels in ((0, before), (3, after)):
        yield f"{prefix}.residual.{number}.gamma", (channels, 1, 1, 1)
    for number, channels in ((2, before), (6, after)):
        yield f"{prefix}.residual.{number}.weight", (after, channels, 3, 3, 3)
        yield f"{prefix}.residual.{number}.bias", (after,)
    if before != after:
        yield f"{prefix}.shortcut.weight", (after, before, 1, 1, 1)
        yield f"{prefix}.shortcut.bias", (after,)


def raw_wan() -> Shapes:
    """Tensors of tokenizer.pth, the WAN 2.1 VAE: base width 96, two residual blocks a level, 16 channels."""
    table: list[tuple[str, tuple[int, ...]]] = []
    for part, ends in (("encoder", (3, 96, 384, 32)), ("decoder", (16, 384, 96, 3))):
        into, first, last, out = ends
        for name, before, after in (("conv1", into, first), ("head.2", last, out)):
            table += [(f"{part}.{name}.weight", (after, before, 3, 3, 3)), (f"{part}.{name}.bias", (after,))]
        table += [(f"{part}.head.0.gamma", (last, 1, 1, 1)), (f"{part}.middle.1.norm.gamma", (384, 1, 1))]
        for number in (0, 2):
            table += residual(f"{part}.middle.{number}", 384, 384)
        for name, count in (("to_qkv", 3 * 384), ("proj", 384)):
            table += [(f"{part}.middle.1.{name}.weight", (count, 384, 1, 1))]
            table += [(f"{part}.middle.1.{name}.bias", (count,))]
    down = [(96, 96), (96, 96), None, (96, 192), (192, 192), None, (192, 384), (384, 384), None]
    down += [(384, 384), (384, 384)]
    for number, widths in enumerate(down):
        if widths is not None:
            table += residual(f"encoder.downsamples.{number}", *widths)
    for number, width in ((2, 96), (5, 192), (8, 384)):
        table += [(f"encoder.downsamples.{number}.resample.1.weight", (width, width, 3, 3))]
        table += [(f"encoder.downsamples.{number}.resample.1.bias", (width,))]
    for number, width in ((5, 192), (8, 384)):
        table += [(f"encoder.downsamples.{number}.time_conv.weight", (width, width, 3, 1, 1))]
        table += [(f"encoder.downsamples.{number}.time_conv.bias", (width,))]
    up = [(384, 384)] * 3 + [None] + [(192, 384), (384, 384), (384, 384), None]
    up += [(192, 192)] * 3 + [None] + [(96, 96)] * 3
    for number, widths in enumerate(up):
        if widths is not None:
            table += residual(f"decoder.upsamples.{number}", *widths)
    for number, width in ((3, 384), (7, 384), (11, 192)):
        table += [(f"decoder.upsamples.{number}.resample.1.weight", (width // 2, width, 3, 3))]
        table += [(f"decoder.upsamples.{number}.resample.1.bias", (width // 2,))]
    for number, width in ((3, 384), (7, 384)):
        table += [(f"decoder.upsamples.{number}.time_conv.weight", (2 * width, width, 3, 1, 1))]
        table += [(f"decoder.upsamples.{number}.time_conv.bias", (2 * width,))]
    for name, channels in (("conv1", 32), ("conv2", 16)):
        table += [(f"{name}.weight", (channels, channels, 1, 1, 1)), (f"{name}.bias", (channels,))]
    assert len(dict(table)) == len(table)
    return dict(table)


def on_meta(shapes: Shapes) -> dict[str, torch.Tensor]:
    return {name: torch.empty(shape, device="meta") for name, shape in shapes.items()}


def first_difference(given: Shapes, expected: Shapes) -> str:
    """The first name that only one side has, or whose shape differs; empty where there is none."""
    for name in sorted(set(given) | set(expected)):
        if given.get(name) != expected.get(name):
            return f"{name}: {given.get(name)}, expected {expected.get(name)}"
    return ""


def shapes_of(state: dict[str, torch.Tensor]) -> Shapes:
    return {name: tuple(tensor.shape) for name, tensor in state.items()}


@pytest.fixture(scope="module")
def cosmos():
    with torch.device("meta"):
        return transformer(COSMOS_0_6B, 16, 16)


@pytest.fixture(scope="module")
def vae():
    with torch.device("meta"):
        return AutoencoderKLWan()


def test_the_raw_checkpoint_of_0_6b_is_our_transformer_by_name_and_shape(cosmos):
    converted = convert_cosmos_transformer_checkpoint_to_diffusers(on_meta(raw_cosmos() | LEFT_OUT))
    assert first_difference(shapes_of(converted), shapes_of(cosmos.state_dict())) == ""
    assert len(raw_cosmos()) == 7 + 20 * LAYERS
    assert sum(p.numel() for p in cosmos.parameters()) == pytest.approx(597.5e6, rel=1e-4)


def test_diffusers_folder_of_0_6b_is_our_transformer_by_name_and_shape(cosmos):
    assert first_difference(diffusers_cosmos(), shapes_of(cosmos.state_dict())) == ""


def test_the_raw_vae_is_our_vae_by_name_and_shape(vae):
    converted = convert_wan_vae_to_diffusers(on_meta(raw_wan()))
    assert first_difference(shapes_of(converted), shapes_of(vae.state_dict())) == ""
    assert len(raw_wan()) == 194
    assert sum(p.numel() for p in vae.parameters()) == pytest.approx(126.9e6, rel=1e-3)


def test_the_frozen_text_branch_is_a_quarter_of_the_weights():
    with torch.device("meta"):
        backbone = Backbone(COSMOS_0_6B, 16, 16)
    frozen = {name for name, p in backbone.named_parameters() if not p.requires_grad}
    assert frozen == {
        name for name, _ in backbone.named_parameters() if ".attn2." in name or ".norm2." in name
    }
    sizes = {name: p.numel() for name, p in backbone.named_parameters()}
    assert sum(sizes[name] for name in frozen) / sum(sizes.values()) == pytest.approx(0.24, abs=0.01)


def test_the_first_weight_that_differs_is_named_with_how(cosmos, tmp_path):
    name = "transformer_blocks.7.ff.net.2.weight"
    shapes = diffusers_cosmos()
    with pytest.raises(TronError, match=rf"'{name}' \(missing\)"):
        load_strictly(cosmos, on_meta({n: s for n, s in shapes.items() if n != name}), tmp_path)
    with pytest.raises(TronError, match=r"'transformer_blocks\.20\.x' \(unknown\)"):
        load_strictly(cosmos, on_meta(shapes | {"transformer_blocks.20.x": (1,)}), tmp_path)
    with pytest.raises(TronError, match=rf"'{name}' \(1280 x 5121, not 1280 x 5120\)"):
        load_strictly(cosmos, on_meta(shapes | {name: (1280, 5121)}), tmp_path)
    few = {n: s for n, s in shapes.items() if ".19." not in n}
    with pytest.raises(TronError, match=r"'transformer_blocks\.19\.attn1\..*' \(missing\) and 19 more"):
        load_strictly(cosmos, on_meta(few), tmp_path)
