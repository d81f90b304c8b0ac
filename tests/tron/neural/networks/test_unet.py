"""The U-Net: zero at birth, any size, frames that begin alone, older checkpoints taken on."""

import logging
from typing import TypeVar

import pytest
import torch

from tron.errors import TronError
from tron.neural.configs import RendererConfig, UNetConfig, UNetRendererConfig
from tron.neural.networks.unet import UNet, _gathered, _spread
from tron.neural.renderer import NeuralRenderer
from tron.neural.weights import FIRST, LAST, load_renderer, restore_renderer, save_renderer
from tron.shards.schema import GUIDANCE, TARGET

SMALL = UNetConfig(widths=(8, 12, 16), blocks=(1, 1, 1), blocks_up=(1, 1))
SHAPES = [
    SMALL,
    UNetConfig(patch=1, widths=(8,), blocks=(2,), blocks_up=()),
    UNetConfig(patch=4, widths=(8, 12), blocks=(1, 0), blocks_up=(1,), spatial="dense", attention=True),
]

Network = TypeVar("Network", bound=torch.nn.Module)


def buffers(frames: int = 1, height: int = 16, width: int = 16, seed: int = 0):
    generator = torch.Generator().manual_seed(seed)
    return {
        name: torch.rand(2, 3, frames, height, width, generator=generator) * 2 - 1
        for name in (*GUIDANCE, TARGET)
    }


def shaken(module: Network, but: tuple[str, ...] = ()) -> Network:
    """The module with every weight moved from where it began, except those whose names end as said."""
    torch.manual_seed(1)
    for name, parameter in module.named_parameters():
        if not name.endswith(but or "-"):
            fan_in = parameter[0].numel() if parameter.ndim > 1 else 4
            torch.nn.init.normal_(parameter, std=fan_in**-0.5)
    return module.eval()


ZERO_ENDS = ("between_frames.project.weight", "between_frames.project.bias")


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(
    ("codec", "size"),
    [("pixels", (16, 16)), ("block_dct", (13, 22)), ("pixels", (3, 5)), ("block_dct", (3, 5))],
)
def test_a_new_one_returns_its_start_at_any_size_and_a_trained_one_keeps_the_size(codec, shape, size):
    given = buffers(5, *size)
    renderer = NeuralRenderer(RendererConfig(codec=codec, backbone=shape))
    torch.testing.assert_close(renderer(given), given["lit"], atol=2e-6, rtol=0)
    drawn = shaken(renderer)(given)
    assert drawn.shape == given["lit"].shape
    assert drawn.isfinite().all()
    assert (drawn - given["lit"]).abs().max() > 1e-2


@pytest.mark.parametrize("side", [1, 2, 4])
def test_patches_come_apart_and_together_again(side):
    x = torch.randn(2, 8, 4, 3)
    patches = _gathered(x, side)
    assert patches.shape == (2, 8 // side, 4 // side, side * side * 3)
    assert torch.equal(_spread(patches, side), x)
    torch.testing.assert_close(patches[1, 0, 0], x[1, :side, :side].flatten())


def test_padding_does_not_reach_what_a_multiple_of_the_stride_shows():
    renderer = shaken(NeuralRenderer(RendererConfig(codec="pixels", backbone=SMALL)))
    given = buffers(1, 26, 29)
    padded = {
        name: torch.nn.functional.pad(video, (0, 3, 0, 6, 0, 0), mode="replicate")
        for name, video in given.items()
    }
    torch.testing.assert_close(renderer(given), renderer(padded)[..., :26, :29], atol=1e-5, rtol=0)


def test_moving_the_picture_by_the_stride_moves_the_result():
    """Only the mean over the picture that channel attention takes would see where the picture is."""
    net = shaken(UNet(SMALL, 3, 3))
    x = torch.zeros(1, 3, 1, 128, 128)
    x[..., 40:80, 40:80] = torch.randn(1, 3, 1, 40, 40)
    moved = torch.roll(x, (net.stride, net.stride), (3, 4))
    inner = (..., slice(40, 96), slice(40, 96))
    back = torch.roll(net(moved), (-net.stride, -net.stride), (3, 4))
    torch.testing.assert_close(net(x)[inner], back[inner], atol=1e-5, rtol=0)


def test_a_trained_single_frame_network_draws_each_frame_of_a_window_as_before():
    """The paths between frames start from zero, whatever else is in them."""
    renderer = shaken(NeuralRenderer(RendererConfig(codec="pixels", backbone=SMALL)), but=ZERO_ENDS)
    given = buffers(5)
    together = renderer(given)
    for index in range(5):
        alone = renderer({name: video[:, :, index : index + 1] for name, video in given.items()})
        torch.testing.assert_close(together[:, :, index : index + 1], alone, atol=1e-6, rtol=0)


def test_awake_paths_see_other_frames_and_single_frames_do_not_see_the_paths():
    renderer = shaken(NeuralRenderer(RendererConfig(codec="pixels", backbone=SMALL)))
    given = buffers(5)
    changed = given | {"pbr": torch.cat([given["pbr"][:, :, :4], -given["pbr"][:, :, 4:]], 2)}
    reached = (renderer(changed) - renderer(given)).abs().amax((0, 1, 3, 4))
    assert (reached > 1e-3).all()
    without = SMALL.model_copy(update={"temporal": False})
    lone = NeuralRenderer(RendererConfig(codec="pixels", backbone=without)).eval()
    kept = {name: p for name, p in renderer.state_dict().items() if ".between_frames." not in name}
    lone.load_state_dict(kept)
    single = {name: video[:, :, :1] for name, video in given.items()}
    assert torch.equal(lone(single), renderer(single))


@pytest.mark.parametrize("frames", [1, 5])
@pytest.mark.parametrize("shape", SHAPES)
def test_every_weight_gets_a_gradient_whatever_the_frames(shape, frames):
    """Distributed training waits for each; that of an idle path is zero, so that it stays where it begins."""
    net = shaken(UNet(shape, 6, 6))
    net(torch.randn(2, 6, frames, 8, 8), 0.2).square().mean().backward()
    assert all(p.grad is not None for p in net.parameters())
    idle = [float(p.grad.abs().max()) for p in net.temporal_weights().values() if p.grad is not None]
    assert idle
    assert (max(idle) == 0) == (frames == 1)


def test_single_frames_never_move_the_ends_of_the_paths():
    torch.manual_seed(0)
    renderer = NeuralRenderer(RendererConfig(codec="pixels", backbone=SMALL))
    given = buffers()
    optimizer = torch.optim.AdamW(renderer.parameters(), lr=5e-3)
    for _ in range(5):
        optimizer.zero_grad()
        (renderer(given) - given[TARGET]).square().mean().backward()
        optimizer.step()
    ends = [p for name, p in renderer.named_parameters() if name.endswith(ZERO_ENDS)]
    assert ends
    assert all(not p.any() for p in ends)


@pytest.mark.long
def test_one_batch_can_be_learnt_by_heart():
    torch.manual_seed(0)
    shape = SMALL.model_copy(update={"widths": (32, 32, 32)})
    given = {name: video[:1] for name, video in buffers(1, 8, 8).items()}
    target = given[TARGET]
    renderer = NeuralRenderer(RendererConfig(codec="pixels", backbone=shape))
    optimizer = torch.optim.AdamW(renderer.parameters(), lr=5e-3)
    first = last = (given["lit"] - target).square().mean().item()
    for _ in range(200):
        loss = (renderer(given) - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        last = loss.item()
    assert last < 0.1 * first


def test_muon_may_have_the_matrices_and_nothing_else():
    net = UNet(SMALL, 6, 6)
    hidden = net.hidden_matrices()
    assert hidden
    assert all(p.ndim == 2 for p in hidden)
    assert not any(p is net.embed.weight for p in hidden)
    torch.optim.Muon(hidden)


def test_a_window_starts_from_the_weights_of_single_frames(tmp_path, caplog):
    lean = RendererConfig(codec="pixels", backbone=SMALL.model_copy(update={"temporal": False}))
    saved = shaken(NeuralRenderer(lean))
    save_renderer(tmp_path / "single.safetensors", saved)
    renderer = NeuralRenderer(RendererConfig(codec="pixels", window=5, backbone=SMALL)).eval()
    with caplog.at_level(logging.INFO):
        restore_renderer(tmp_path / "single.safetensors", renderer)
    assert "start from zero" in caplog.text
    given = buffers(5)
    torch.testing.assert_close(renderer(given), saved(given), atol=1e-6, rtol=0)


def test_more_buffers_start_from_the_weights_of_fewer(tmp_path, caplog):
    """The picture is that of the network that was given fewer, until it learns what new ones are worth."""
    filtering = {"codec": "pixels", "backbone": SMALL, "skip_blur": 0.6, "skip_kernel": 3}
    saved = shaken(NeuralRenderer(RendererConfig(guidance=("irradiance", "lit"), **filtering)))
    save_renderer(tmp_path / "fewer.safetensors", saved)
    names = ("lit", "albedo", "irradiance", "surface")
    config = UNetRendererConfig(guidance=names, skip_detail="albedo", **filtering)
    renderer = shaken(NeuralRenderer(config))
    with caplog.at_level(logging.INFO):
        restore_renderer(tmp_path / "fewer.safetensors", renderer)
    assert "was without albedo, surface, skip_detail" in caplog.text
    random = torch.Generator().manual_seed(3)
    given = {name: torch.rand(2, 3, 1, 16, 16, generator=random) * 2 - 1 for name in names}
    torch.testing.assert_close(renderer(given), saved(given), atol=1e-5, rtol=0)
    saved.backbone.get_parameter(FIRST.removeprefix("backbone.")).data = torch.zeros(8, 7)
    save_renderer(tmp_path / "damaged.safetensors", saved)
    with pytest.raises(TronError, match="do not fit the model at"):
        restore_renderer(tmp_path / "damaged.safetensors", renderer)
    renderer(given).square().mean().backward()
    assert all((renderer.get_parameter(name).grad != 0).any() for name in (FIRST, *LAST))


PARTS = {"skip_detail": "albedo", "skip_holes": 1}


@pytest.mark.parametrize("had", [[], ["skip_detail"], ["skip_holes"]])
@pytest.mark.parametrize("has", [["skip_detail"], ["skip_holes"], ["skip_detail", "skip_holes"]])
def test_whatever_is_added_the_picture_stays(tmp_path, caplog, had: list[str], has: list[str]):
    """In any order; a new kernel with holes takes a fiftieth from its neighbours at first."""
    filtering = {"codec": "pixels", "backbone": SMALL, "skip_blur": 0.6, "skip_kernel": 3}
    names = ("lit", "albedo")
    before = RendererConfig(guidance=names, **filtering, **{name: PARTS[name] for name in had})
    saved = shaken(NeuralRenderer(before))
    save_renderer(tmp_path / "less.safetensors", saved)
    after = before.model_copy(update={name: PARTS[name] for name in {*had, *has}})
    renderer = shaken(NeuralRenderer(after))
    with caplog.at_level(logging.INFO):
        restore_renderer(tmp_path / "less.safetensors", renderer)
    added = [name for name in PARTS if name in has and name not in had]
    assert ("was without" in caplog.text) == bool(added)
    assert all(name in caplog.text for name in added)
    random = torch.Generator().manual_seed(3)
    given = {name: torch.rand(2, 3, 1, 16, 16, generator=random) * 2 - 1 for name in names}
    atol = 0.05 if "skip_holes" in added else 1e-5
    torch.testing.assert_close(renderer(given), saved(given), atol=atol, rtol=0)


def test_other_holes_are_refused(tmp_path):
    filtering = {"codec": "pixels", "backbone": SMALL, "skip_blur": 0.6, "skip_kernel": 3}
    save_renderer(tmp_path / "r.safetensors", NeuralRenderer(RendererConfig(skip_holes=1, **filtering)))
    other = NeuralRenderer(RendererConfig(skip_holes=2, **filtering))
    with pytest.raises(TronError, match="weights of skip_holes=1, not 2"):
        restore_renderer(tmp_path / "r.safetensors", other)


def test_the_rest_of_a_warm_start_is_strict(tmp_path):
    renderer = NeuralRenderer(RendererConfig(codec="pixels", backbone=SMALL))
    save_renderer(tmp_path / "whole.safetensors", renderer)
    lean = RendererConfig(codec="pixels", backbone=SMALL.model_copy(update={"temporal": False}))
    with pytest.raises(
        TronError, match="do not fit the model at"
    ):  # a path that the network has no place for
        restore_renderer(tmp_path / "whole.safetensors", NeuralRenderer(lean))
    other = SMALL.model_copy(update={"widths": (8, 12, 20), "temporal": False})
    save_renderer(
        tmp_path / "other.safetensors", NeuralRenderer(RendererConfig(codec="pixels", backbone=other))
    )
    with pytest.raises(TronError, match="do not fit the model at"):
        restore_renderer(tmp_path / "other.safetensors", renderer)


@pytest.mark.parametrize("codec", ["pixels", "block_dct"])
@pytest.mark.parametrize("shape", SHAPES)
def test_a_file_brings_its_own_shape(tmp_path, codec, shape):
    renderer = shaken(NeuralRenderer(RendererConfig(codec=codec, backbone=shape)))
    save_renderer(tmp_path / "r.safetensors", renderer)
    again = load_renderer(tmp_path / "r.safetensors")
    assert again.config == renderer.config
    assert torch.equal(again(buffers()), renderer(buffers()))


def test_the_recipes_renderer_is_a_unet_of_pixels():
    config = UNetRendererConfig()
    assert (config.codec, config.backbone.kind) == ("pixels", "unet")
    count = sum(p.numel() for p in NeuralRenderer(config).parameters())
    assert 2e5 < count < 2e6


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"widths": (8, 8)}, "2 widths go with 2 numbers in blocks and 1 in blocks_up, not 4 and 3"),
        ({"widths": ()}, "widths"),
        ({"widths": (10**9,), "blocks": (1,), "blocks_up": ()}, "less than or equal to 4096"),
        ({"patch": 3}, "1, 2 or 4"),
        ({"heads": 3}, "heads"),
    ],
)
def test_shapes_that_are_none_are_refused(wrong, words):
    with pytest.raises(ValueError, match=words):
        RendererConfig.model_validate({"backbone": {"kind": "unet", **wrong}})
    with pytest.raises(ValueError, match="cosmos"):
        RendererConfig.model_validate({"backbone": {"kind": "transformer"}})
