"""The renderer: identity at birth, any size, no look ahead, windows that give every frame once."""

import numpy as np
import pytest
import torch

from tron import seeds
from tron.errors import TronError
from tron.neural.backbone import Backbone, BackboneConfig
from tron.neural.pixel_mlp import PixelMLP, PixelMLPConfig
from tron.neural.renderer import NeuralRenderer, RendererConfig, render_clip
from tron.neural.windows import windows

SMALL = BackboneConfig(heads=2, head_dim=12, layers=2, adaln_lora_dim=8)


def buffers(frames: int = 1, height: int = 16, width: int = 16, batch: int = 2, seed: int = 0):
    generator = torch.Generator().manual_seed(seed)
    return [torch.rand(batch, 3, frames, height, width, generator=generator) * 2 - 1 for _ in range(3)]


def guided(pbr, irradiance) -> dict:
    return {"pbr": pbr, "irradiance": irradiance}


def awake(renderer: NeuralRenderer) -> NeuralRenderer:
    """A renderer whose output layer is not zero."""
    torch.manual_seed(1)
    torch.nn.init.normal_(renderer.backbone.transformer.proj_out.weight, std=0.1)
    return renderer.eval()


@pytest.mark.parametrize("frames", [1, 5])
def test_a_new_renderer_returns_the_pbr_buffer(frames):
    pbr, irradiance, _ = buffers(frames)
    for renderer in (NeuralRenderer(RendererConfig(backbone=SMALL)), PixelMLP(PixelMLPConfig(width=8))):
        torch.testing.assert_close(renderer(guided(pbr, irradiance)), pbr, atol=2e-6, rtol=0)


def test_skip_mean_starts_from_the_mean_of_the_buffers():
    pbr, irradiance, _ = buffers()
    renderer = NeuralRenderer(RendererConfig(fusion="average", skip="mean", backbone=SMALL))
    torch.testing.assert_close(renderer(guided(pbr, irradiance)), 0.5 * (pbr + irradiance), atol=2e-6, rtol=0)


def test_averaging_keeps_the_pretrained_input_width_and_concatenation_doubles_it():
    padded = SMALL.model_copy(update={"padding_channel": True})
    for fusion, channels in (("average", 192 + 1), ("concat", 2 * 192 + 1)):
        renderer = NeuralRenderer(RendererConfig.model_validate({"fusion": fusion, "backbone": padded}))
        assert renderer.backbone.transformer.patch_embed.proj.in_features == channels


@pytest.mark.parametrize("size", [(16, 16), (17, 16), (13, 22), (4, 5)])
def test_any_size_goes_in_and_comes_out(size):
    pbr, irradiance, _ = buffers(1, *size)
    renderer = NeuralRenderer(RendererConfig(backbone=SMALL))
    torch.testing.assert_close(renderer(guided(pbr, irradiance)), pbr, atol=2e-6, rtol=0)
    assert awake(renderer)(guided(pbr, irradiance)).shape == pbr.shape


def test_padding_does_not_reach_what_a_multiple_of_the_block_shows():
    pbr, irradiance, _ = buffers(1, 16, 16)
    renderer = awake(NeuralRenderer(RendererConfig(backbone=SMALL)))
    padded = [
        torch.nn.functional.pad(b[..., :14, :13], (0, 3, 0, 2, 0, 0), mode="replicate")
        for b in (pbr, irradiance)
    ]
    cropped = renderer(guided(pbr[..., :14, :13], irradiance[..., :14, :13]))
    torch.testing.assert_close(cropped, renderer(guided(*padded))[..., :14, :13], atol=1e-6, rtol=0)


def test_the_irradiance_matters_once_the_output_layer_is_awake():
    pbr, irradiance, other = buffers()
    renderer = awake(NeuralRenderer(RendererConfig(backbone=SMALL)))
    assert (renderer(guided(pbr, irradiance)) - renderer(guided(pbr, other))).abs().max() > 1e-2


@pytest.mark.parametrize("frames", [2, 3, 4, 6])
def test_windows_that_are_not_1_plus_4n_are_refused(frames):
    pbr, irradiance, _ = buffers(frames)
    with pytest.raises(TronError, match=r"1 \+ 4n"):
        NeuralRenderer(RendererConfig(backbone=SMALL))(guided(pbr, irradiance))
    with pytest.raises(TronError, match=r"1 \+ 4n"):
        NeuralRenderer(RendererConfig(window=frames, backbone=SMALL))


def test_buffers_of_different_shape_are_refused():
    pbr, irradiance, _ = buffers()
    for renderer in (NeuralRenderer(RendererConfig(backbone=SMALL)), PixelMLP()):
        with pytest.raises(TronError):
            renderer(guided(pbr, irradiance[..., :8]))


def test_leaving_out_the_text_branch_changes_nothing():
    torch.manual_seed(0)
    whole = Backbone(SMALL.model_copy(update={"cross_attention": "frozen"}), 6, 6)
    lean = Backbone(SMALL, 6, 6)
    torch.nn.init.normal_(whole.transformer.proj_out.weight)
    kept = {k: v for k, v in whole.state_dict().items() if ".attn2." not in k and ".norm2." not in k}
    lean.load_state_dict(kept)
    x = torch.randn(2, 6, 2, 3, 4)
    torch.testing.assert_close(lean(x, 0.2), whole(x, 0.2), atol=0, rtol=0)


def test_every_parameter_that_is_not_frozen_gets_a_gradient():
    for choice in ("frozen", "none"):
        torch.manual_seed(0)
        backbone = Backbone(SMALL.model_copy(update={"cross_attention": choice}), 6, 6)
        torch.nn.init.normal_(backbone.transformer.proj_out.weight)
        backbone(torch.randn(2, 6, 2, 3, 4), 0.2).square().mean().backward()
        trained = {name for name, p in backbone.named_parameters() if p.requires_grad}
        assert trained == {name for name, p in backbone.named_parameters() if p.grad is not None}
        assert not any(".attn2." in name or ".norm2." in name for name in trained)


@pytest.mark.parametrize("fusion", ["concat", "average"])
def test_one_batch_can_be_learnt_by_heart(fusion):
    torch.manual_seed(0)
    pbr, irradiance, target = buffers(1, 8, 8, batch=1)
    renderer = NeuralRenderer(RendererConfig.model_validate({"fusion": fusion, "backbone": SMALL}))
    optimizer = torch.optim.AdamW(renderer.parameters(), lr=5e-3)
    first = last = (pbr - target).square().mean().item()
    for _ in range(150):
        loss = (renderer(guided(pbr, irradiance)) - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        last = loss.item()
    assert last < 0.03 * first


def test_a_pixel_mlp_sees_single_pixels():
    torch.manual_seed(0)
    mlp = PixelMLP(PixelMLPConfig(width=16))
    torch.nn.init.normal_(list(mlp.parameters())[-2])
    pbr, irradiance, _ = buffers(5, 8, 8)
    order = torch.randperm(8 * 8 * 5)
    shuffled = [b.flatten(2)[..., order].view_as(b) for b in (pbr, irradiance)]
    expected = mlp(guided(pbr, irradiance)).flatten(2)[..., order].view_as(pbr)
    torch.testing.assert_close(mlp(guided(*shuffled)), expected, atol=1e-6, rtol=0)
    assert (expected - shuffled[0]).abs().max() > 0.01


@pytest.mark.parametrize(("frames", "size"), [(1, 1), (7, 1), (5, 5), (12, 5), (3, 5), (6, 9), (9, 9)])
def test_windows_give_every_frame_once_and_the_newest_last(frames, size):
    passes = windows(frames, size)
    shown = [*passes[0], *(indices[-1] for indices in passes[1:])]
    assert shown == list(range(frames))
    assert all((len(p) - 1) % 4 == 0 and len(p) <= size for p in passes)


@pytest.mark.parametrize("size", [1, 5])
def test_render_clip_is_the_forward_pass_of_each_window(size):
    random = seeds.generator(0, "clip")
    pbr, irradiance = (random.random((7, 9, 10, 3), dtype=np.float32) for _ in range(2))
    renderer = awake(NeuralRenderer(RendererConfig(window=size, backbone=SMALL)))
    shown = render_clip(renderer, guided(pbr, irradiance))
    assert shown.shape == pbr.shape
    assert shown.dtype == np.float32
    assert shown.min() >= 0
    assert shown.max() <= 1
    last = [torch.from_numpy(b)[7 - size :].movedim(-1, 0)[None] * 2 - 1 for b in (pbr, irradiance)]
    expected = (renderer(guided(*last))[0, :, -1].clamp(-1, 1) + 1) / 2
    np.testing.assert_allclose(shown[-1], expected.detach().movedim(0, -1).numpy(), atol=1e-6)


def test_rendering_changes_neither_mode_nor_weights():
    renderer = NeuralRenderer(RendererConfig(backbone=SMALL)).train()
    before = {k: v.clone() for k, v in renderer.state_dict().items()}
    render_clip(renderer, guided(*np.ones((2, 1, 8, 8, 3), np.float32)))
    assert renderer.training
    assert all(torch.equal(v, before[k]) for k, v in renderer.state_dict().items())


def test_render_clip_refuses_what_is_no_clip():
    renderer = PixelMLP()
    for pbr, irradiance in [
        ((8, 8, 3), (8, 8, 3)),
        ((1, 8, 8, 3), (2, 8, 8, 3)),
        ((0, 8, 8, 3), (0, 8, 8, 3)),
    ]:
        with pytest.raises(TronError):
            render_clip(renderer, guided(np.ones(pbr, np.float32), np.ones(irradiance, np.float32)))


@pytest.mark.parametrize("fusion", ["concat", "average"])
def test_a_third_buffer_is_seen_and_a_missing_one_named(fusion):
    names = ("pbr", "irradiance", "shadowed")
    pbr, irradiance, shadowed = buffers()
    given = {"pbr": pbr, "irradiance": irradiance, "shadowed": shadowed}
    config = {"fusion": fusion, "guidance": names, "backbone": SMALL}
    mlp = PixelMLP(PixelMLPConfig(width=8, guidance=names))
    torch.nn.init.normal_(list(mlp.parameters())[-2])
    for renderer in (awake(NeuralRenderer(RendererConfig.model_validate(config))), mlp):
        changed = renderer(given | {"shadowed": -shadowed}) - renderer(given)
        assert changed.abs().max() > 1e-3
        with pytest.raises(TronError, match="needs the buffer 'shadowed'"):
            renderer(guided(pbr, irradiance))


@pytest.mark.parametrize(
    "names", [("irradiance",), ("pbr", "pbr"), ("pbr", "depth"), ("pbr", "rgb"), ("pbr", "x")]
)
def test_guidance_that_no_network_can_have_is_refused(names):
    for config in (RendererConfig, PixelMLPConfig):
        with pytest.raises(ValueError, match="guidance is pbr and others of pbr, irradiance"):
            config(guidance=names)
