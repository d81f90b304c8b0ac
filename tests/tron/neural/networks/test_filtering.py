"""Gaussians and predicted kernels, against scipy and by their laws."""

import numpy as np
import pytest
import scipy.ndimage
import torch
from pydantic import ValidationError

from tron.neural.configs import RendererConfig, UNetConfig
from tron.neural.kernels import filtered, gaussian_logits
from tron.neural.renderer import NeuralRenderer
from tron.neural.weights import load_renderer, save_renderer

UNET = UNetConfig(widths=(6, 8), blocks=(1, 1), blocks_up=(1,))


def video(frames: int = 1, channels: int = 3) -> torch.Tensor:
    return torch.rand(1, channels, frames, 9, 13, generator=torch.Generator().manual_seed(0)) * 2 - 1


def buffers(frames: int = 1) -> dict[str, torch.Tensor]:
    names = RendererConfig().guidance
    return dict(zip(names, video(frames, 3 * len(names)).split(3, 1)))


def renderer(**config) -> NeuralRenderer:
    return NeuralRenderer(RendererConfig(backbone=UNET, codec="pixels", **config)).eval()


@pytest.mark.parametrize("deviation", [0.3, 0.6, 1.0])
def test_a_gaussian_is_scipys(deviation: float):
    given, side = video(2), 9
    expected = scipy.ndimage.gaussian_filter(
        given.double().numpy(), (0, 0, 0, deviation, deviation), mode="nearest", radius=(0, 0, 0, 4, 4)
    )
    found = filtered(given.double(), gaussian_logits(deviation, side).double().softmax(0))
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-6)


def test_each_pixel_has_its_own_kernel():
    """One that is all on a neighbour brings that neighbour, of its own frame."""
    given = video(2)
    weights = torch.zeros(1, 9, 2, 9, 13)
    weights[:, 4] = 1
    weights[0, :, 1, 5, 7] = torch.eye(9)[2]  # above, to the right
    expected = given.clone()
    expected[0, :, 1, 5, 7] = given[0, :, 1, 4, 8]
    assert torch.equal(filtered(given, weights), expected)


def test_the_edge_goes_on_beyond_the_border():
    flat = torch.full((1, 3, 1, 4, 5), 0.7)
    torch.testing.assert_close(filtered(flat, gaussian_logits(1.0, 5).softmax(0)), flat)


@pytest.mark.parametrize("step", [1, 2])
def test_gradients_are_those_of_finite_differences(step: int):
    def wanted(*shape: int) -> torch.Tensor:
        return torch.rand(shape, dtype=torch.float64, requires_grad=True)

    video = wanted(2, 3, 2, 5, 6)
    for weights in (wanted(9), wanted(2, 9, 2, 5, 6)):
        assert torch.autograd.gradcheck(lambda v, w: filtered(v, w, step), (video, weights))


@pytest.mark.parametrize("kernel", [0, 5])
def test_a_new_renderer_returns_the_filtered_start(kernel: int):
    given = buffers()
    expected = filtered(given["lit"], gaussian_logits(0.6, 5).softmax(0))
    torch.testing.assert_close(renderer(skip_blur=0.6, skip_kernel=kernel)(given), expected)


def test_kernels_are_learnt_and_travel_with_the_weights(tmp_path):
    """A truth that is the start moved by a pixel: no sum of colours, a kernel is told at once."""
    made, given = renderer(skip_blur=0.6, skip_kernel=3), buffers()
    truth = filtered(given["lit"], torch.eye(9)[3])
    optimizer = torch.optim.Adam([made.backbone.get_parameter("out.bias")], 0.2)
    for _ in range(120):
        optimizer.zero_grad()
        (made(given) - truth).square().mean().backward()
        optimizer.step()
    error = (made(given) - truth).square().mean()
    assert error < 0.01 * (given["lit"] - truth).square().mean()
    save_renderer(tmp_path / "r.safetensors", made)
    loaded = load_renderer(tmp_path / "r.safetensors")
    assert torch.equal(loaded(given), made(given))


def test_detail_of_a_buffer_is_given_back_in_the_share_that_the_network_predicts():
    """Shares of one everywhere: the filtered start, and all that the filter took from the buffer."""
    made, given = renderer(skip_blur=0.6, skip_kernel=5, skip_detail="pbr"), buffers()
    blur = gaussian_logits(0.6, 5).softmax(0)
    torch.testing.assert_close(made(given), filtered(given["lit"], blur), msg="none at first")
    made.backbone.get_parameter("out.bias").data.view(4, 31)[:, 28:] = 1.0  # four sub-pixels of a patch
    detail = given["pbr"] - filtered(given["pbr"], blur)
    torch.testing.assert_close(made(given), filtered(given["lit"], blur) + detail)


def test_a_kernel_with_holes_brings_what_lies_beyond_the_first():
    """All of it on the neighbour above: two holes between make that three pixels."""
    made, given = renderer(skip_blur=0.6, skip_kernel=3, skip_holes=2), buffers()
    start = filtered(given["lit"], gaussian_logits(0.6, 3).softmax(0))
    torch.testing.assert_close(made(given), start, atol=0.05, rtol=0, msg="next to nothing at first")
    bias = made.backbone.get_parameter("out.bias").data.view(4, 3 + 9 + 9)
    bias[:, 12 + 1] = 30.0
    above = torch.cat([start[..., :1, :]] * 3 + [start[..., :-3, :]], -2)
    torch.testing.assert_close(made(given), above, atol=1e-4, rtol=0)


def test_kernels_do_not_see_other_frames():
    made, given = renderer(skip_blur=0.6, skip_kernel=3), buffers(2)
    torch.nn.init.normal_(made.backbone.get_parameter("out.weight"), std=0.1)
    alone = {name: each[:, :, 1:] for name, each in given.items()}
    torch.testing.assert_close(made(given)[:, :, 1:], made(alone), atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize(
    ("config", "said"),
    [
        ({"skip_blur": 0.6, "skip": "mean"}, "skip=mean"),
        ({"skip_kernel": 3}, "skip_blur"),
        ({"skip_kernel": 3, "skip_blur": 0.6, "codec": "block_dct"}, "codec=pixels"),
        ({"skip_kernel": 4, "skip_blur": 0.6, "codec": "pixels"}, "skip_kernel"),
        ({"skip_blur": -1.0}, "skip_blur"),
        ({"skip_detail": "pbr"}, "skip_kernel"),
        ({"skip_kernel": 3, "skip_blur": 0.6, "codec": "pixels", "skip_detail": "albedo"}, "one of guidance"),
    ],
)
def test_filters_that_make_no_sense_are_refused(config: dict, said: str):
    with pytest.raises(ValidationError, match=said):
        RendererConfig(**config)
