"""The renderer: identity at birth, any size, no look ahead, windows that give every frame once."""

import numpy as np
import pytest
import torch

from tron import seeds
from tron.errors import TronError
from tron.neural.configs import BackboneConfig, CosmosConfig, PixelMLPConfig, RendererConfig
from tron.neural.networks.backbone import Backbone
from tron.neural.networks.pixel_mlp import PixelMLP
from tron.neural.renderer import NeuralRenderer, render_clip
from tron.shards.schema import GUIDANCE, TARGET

SMALL = BackboneConfig(heads=2, head_dim=12, layers=2, adaln_lora_dim=8)


def buffers(frames: int = 1, height: int = 16, width: int = 16, batch: int = 2, seed: int = 0):
    """A video of each member of GUIDANCE, by name, and one more under "rgb"."""
    generator = torch.Generator().manual_seed(seed)
    return {
        name: torch.rand(batch, 3, frames, height, width, generator=generator) * 2 - 1
        for name in (*GUIDANCE, TARGET)
    }


def awake(renderer: NeuralRenderer) -> NeuralRenderer:
    """A renderer whose output layer is not zero."""
    torch.manual_seed(1)
    assert isinstance(renderer.backbone, Backbone)
    torch.nn.init.normal_(renderer.backbone.transformer.proj_out.weight, std=0.1)
    return renderer.eval()


@pytest.mark.parametrize("frames", [1, 5])
@pytest.mark.parametrize(
    ("guidance", "skip", "start"),
    [
        (GUIDANCE, "auto", "lit"),
        (("pbr", "irradiance"), "auto", "pbr"),
        (("irradiance", "shadowed"), "auto", "irradiance"),
        (("lit",), "auto", "lit"),
        (GUIDANCE, "irradiance", "irradiance"),
    ],
)
def test_a_new_renderer_returns_the_buffer_it_starts_from(frames, guidance, skip, start):
    given = buffers(frames) | {"shadowed": torch.zeros(2, 3, frames, 16, 16)}
    for renderer in (
        NeuralRenderer(RendererConfig(guidance=guidance, skip=skip, backbone=SMALL)),
        PixelMLP(PixelMLPConfig(guidance=guidance, skip=skip, width=8)),
    ):
        assert renderer.config.skip == start
        torch.testing.assert_close(renderer(given), given[start], atol=2e-6, rtol=0)


def test_skip_mean_starts_from_the_mean_of_the_buffers():
    given = buffers()
    renderer = NeuralRenderer(RendererConfig(fusion="average", skip="mean", backbone=SMALL))
    mean = torch.stack([given[name] for name in GUIDANCE]).mean(0)
    torch.testing.assert_close(renderer(given), mean, atol=2e-6, rtol=0)


@pytest.mark.parametrize(
    ("config", "names"),
    [
        (RendererConfig, "auto, pbr, irradiance, mean"),
        (PixelMLPConfig, "auto, pbr, irradiance"),  # it has no latents
    ],
)
@pytest.mark.parametrize("skip", ["lit", "nothing"])
def test_a_start_that_is_not_among_the_guidance_is_refused(config, names, skip):
    with pytest.raises(ValueError, match=f"skip is one of {names}"):
        config(guidance=("pbr", "irradiance"), skip=skip)
    with pytest.raises(ValueError, match="skip is one of"):
        PixelMLPConfig(skip="mean")


def test_the_papers_renderer_has_its_two_buffers_and_starts_from_their_mean():
    assert (CosmosConfig().guidance, CosmosConfig().skip) == (("pbr", "irradiance"), "mean")


def test_averaging_keeps_the_pretrained_input_width_and_concatenation_multiplies_it():
    padded = SMALL.model_copy(update={"padding_channel": True})
    for fusion, channels in (("average", 192 + 1), ("concat", len(GUIDANCE) * 192 + 1)):
        renderer = NeuralRenderer(RendererConfig.model_validate({"fusion": fusion, "backbone": padded}))
        assert isinstance(renderer.backbone, Backbone)
        assert renderer.backbone.transformer.patch_embed.proj.in_features == channels


@pytest.mark.parametrize("size", [(16, 16), (17, 16), (13, 22), (4, 5)])
def test_any_size_goes_in_and_comes_out(size):
    given = buffers(1, *size)
    renderer = NeuralRenderer(RendererConfig(backbone=SMALL))
    torch.testing.assert_close(renderer(given), given["lit"], atol=2e-6, rtol=0)
    assert awake(renderer)(given).shape == given["lit"].shape


def test_padding_does_not_reach_what_a_multiple_of_the_block_shows():
    renderer = awake(NeuralRenderer(RendererConfig(backbone=SMALL)))
    cropped = {name: video[..., :14, :13] for name, video in buffers(1, 16, 16).items()}
    padded = {
        name: torch.nn.functional.pad(video, (0, 3, 0, 2, 0, 0), mode="replicate")
        for name, video in cropped.items()
    }
    torch.testing.assert_close(renderer(cropped), renderer(padded)[..., :14, :13], atol=1e-6, rtol=0)


@pytest.mark.parametrize("name", GUIDANCE)
def test_every_buffer_matters_once_the_output_layer_is_awake(name):
    given = buffers()
    renderer = awake(NeuralRenderer(RendererConfig(backbone=SMALL)))
    assert (renderer(given) - renderer(given | {name: given[TARGET]})).abs().max() > 1e-2


@pytest.mark.parametrize("frames", [2, 3, 4, 6])
def test_windows_that_are_not_1_plus_4n_are_refused(frames):
    with pytest.raises(TronError, match=r"1 \+ 4n"):
        NeuralRenderer(RendererConfig(backbone=SMALL))(buffers(frames))
    with pytest.raises(TronError, match=r"1 \+ 4n"):
        NeuralRenderer(RendererConfig(window=frames, backbone=SMALL))


def test_buffers_of_different_shape_are_refused():
    given = buffers()
    for renderer in (NeuralRenderer(RendererConfig(backbone=SMALL)), PixelMLP()):
        with pytest.raises(TronError):
            renderer(given | {"irradiance": given["irradiance"][..., :8]})


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
    given = buffers(1, 8, 8, batch=1)
    target = given[TARGET]
    renderer = NeuralRenderer(RendererConfig.model_validate({"fusion": fusion, "backbone": SMALL}))
    optimizer = torch.optim.AdamW(renderer.parameters(), lr=5e-3)
    first = last = (given["lit"] - target).square().mean().item()
    for _ in range(150):
        loss = (renderer(given) - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        last = loss.item()
    assert last < 0.03 * first


def test_a_pixel_mlp_sees_single_pixels():
    torch.manual_seed(0)
    mlp = PixelMLP(PixelMLPConfig(width=16))
    torch.nn.init.normal_(list(mlp.parameters())[-2])
    given = buffers(5, 8, 8)
    order = torch.randperm(8 * 8 * 5)
    shuffled = {name: b.flatten(2)[..., order].view_as(b) for name, b in given.items()}
    expected = mlp(given).flatten(2)[..., order].view_as(given["lit"])
    torch.testing.assert_close(mlp(shuffled), expected, atol=1e-6, rtol=0)
    assert (expected - shuffled["lit"]).abs().max() > 0.01


@pytest.mark.parametrize("size", [1, 5])
def test_render_clip_is_the_forward_pass_of_each_window(size):
    random = seeds.generator(0, "clip")
    given = {name: random.random((7, 9, 10, 3), dtype=np.float32) for name in GUIDANCE}
    renderer = awake(NeuralRenderer(RendererConfig(window=size, backbone=SMALL)))
    shown = render_clip(renderer, given)
    assert shown.shape == (7, 9, 10, 3)
    assert shown.dtype == np.float32
    assert shown.min() >= 0
    assert shown.max() <= 1
    last = {n: torch.from_numpy(b)[7 - size :].movedim(-1, 0)[None] * 2 - 1 for n, b in given.items()}
    expected = (renderer(last)[0, :, -1].clamp(-1, 1) + 1) / 2
    np.testing.assert_allclose(shown[-1], expected.detach().movedim(0, -1).numpy(), atol=1e-6)


def test_rendering_changes_neither_mode_nor_weights():
    renderer = NeuralRenderer(RendererConfig(backbone=SMALL)).train()
    before = {k: v.clone() for k, v in renderer.state_dict().items()}
    render_clip(renderer, dict.fromkeys(GUIDANCE, np.ones((1, 8, 8, 3), np.float32)))
    assert renderer.training
    assert all(torch.equal(v, before[k]) for k, v in renderer.state_dict().items())


@pytest.mark.parametrize("value, instead", [(np.nan, 0.0), (np.inf, 1.0), (-np.inf, 0.0)])
def test_one_pixel_that_is_not_finite_blackens_nothing(value: float, instead: float, caplog):
    renderer = awake(NeuralRenderer(RendererConfig(window=1, backbone=SMALL)))
    clip = {name: seeds.generator(0, name).random((2, 16, 16, 3), np.float32) for name in GUIDANCE}
    clip["pbr"][1, 3, 4] = value
    drawn = render_clip(renderer, clip)
    assert np.isfinite(drawn).all()
    (line,) = (record.getMessage() for record in caplog.records)
    assert line.startswith("3 values of pbr are NaN or infinite")
    clip["pbr"][1, 3, 4] = instead
    np.testing.assert_array_equal(drawn, render_clip(renderer, clip))


def test_render_clip_refuses_what_is_no_clip():
    renderer = PixelMLP()
    for first, other in [
        ((8, 8, 3), (8, 8, 3)),
        ((1, 8, 8, 3), (2, 8, 8, 3)),
        ((0, 8, 8, 3), (0, 8, 8, 3)),
    ]:
        given = dict.fromkeys(GUIDANCE, np.ones(other, np.float32))
        with pytest.raises(TronError):
            render_clip(renderer, given | {GUIDANCE[0]: np.ones(first, np.float32)})


@pytest.mark.parametrize("fusion", ["concat", "average"])
def test_any_members_are_guidance_and_a_missing_one_is_named(fusion):
    names = ("irradiance", "shadowed", "unshadowed", "pbr")
    given = dict(zip(names, buffers().values())) | {"pbr": buffers(seed=1)["pbr"]}
    config = {"fusion": fusion, "guidance": names, "backbone": SMALL}
    mlp = PixelMLP(PixelMLPConfig(width=8, guidance=names))
    torch.nn.init.normal_(list(mlp.parameters())[-2])
    for renderer in (awake(NeuralRenderer(RendererConfig.model_validate(config))), mlp):
        changed = renderer(given | {"shadowed": -given["shadowed"]}) - renderer(given)
        assert changed.abs().max() > 1e-3
        with pytest.raises(TronError, match="needs the buffer 'shadowed'"):
            renderer({name: given[name] for name in names if name != "shadowed"})


@pytest.mark.parametrize("names", [(), ("pbr", "pbr"), ("pbr", "depth"), ("pbr", "rgb"), ("pbr", "x")])
def test_guidance_that_no_network_can_have_is_refused(names):
    for config in (RendererConfig, PixelMLPConfig):
        with pytest.raises(ValueError, match="guidance is one or more of pbr, irradiance"):
            config(guidance=names)
