"""A picture's coarse part from the picture drawn at half its size, by closed forms."""

import pytest
import torch
from pydantic import ValidationError

from tron.estimation import MOST_RAYS, OCTAVES
from tron.neural.configs import RendererConfig, UNetConfig
from tron.neural.renderer import NeuralRenderer
from tron.neural.scales import halved, with_coarse

SHAPE = UNetConfig(widths=(6, 8), blocks=(1, 1), blocks_up=(1,))


def video(height: int, width: int, frames: int = 2) -> torch.Tensor:
    return torch.rand(1, 3, frames, height, width, generator=torch.Generator().manual_seed(0)) * 2 - 1


def test_half_the_size_is_means_of_four_pixels_and_odd_sides_keep_their_last():
    given = video(5, 6)
    (half,) = halved({"lit": given})
    assert half.shape == (1, 3, 2, 3, 3)
    torch.testing.assert_close(half[..., 0, 1], given[..., :2, 2:4].mean((-2, -1)))
    torch.testing.assert_close(half[..., 2, 0], given[..., 4, :2].mean(-1))


def test_sampling_of_half_the_size_is_that_of_pixels_twice_as_wide():
    """Eight rays and a footprint of a spacing become 32 and two; white stays white."""
    low, high = OCTAVES

    def seen(rays: float, footprint: float) -> torch.Tensor:
        display = torch.tensor([1 / 3, rays / MOST_RAYS, (footprint - low) / (high - low)])
        return display * 2 - 1

    given = torch.ones(1, 3, 1, 4, 4)
    given[..., 2:] = seen(3, 0)[None, :, None, None, None]
    (half,) = halved({"sampling": given})
    torch.testing.assert_close(half[0, :, 0, 0, 1], seen(5, 1))
    assert bool((half[..., 0] == 1).all())


@pytest.mark.parametrize("size", [(8, 10), (7, 9)])
def test_means_become_the_coarse_pictures_and_a_fine_one_that_agrees_stays(size: tuple[int, int]):
    fine = video(*size)
    (own,) = halved({"lit": fine})
    torch.testing.assert_close(with_coarse(fine, own), fine)
    torch.testing.assert_close(with_coarse(fine, own + 0.25), fine + 0.25)


def test_what_is_coarse_is_enlarged_bilinearly():
    """Of a slope each fine pixel has its own height, but for the outermost."""
    fine = video(8, 12)
    (own,) = halved({"lit": fine})
    slope = 0.1 * torch.arange(6.0) + 0.05 * torch.arange(4.0)[:, None]  # at the middles of 2 x 2 pixels
    height = 0.1 * (torch.arange(12.0) - 0.5) / 2 + 0.05 * (torch.arange(8.0)[:, None] - 0.5) / 2
    drawn = with_coarse(fine, own + slope) - fine
    inner = (slice(None), slice(None), slice(None), slice(1, -1), slice(1, -1))
    torch.testing.assert_close(drawn[inner], height.expand_as(drawn)[inner])


def test_a_network_of_two_scales_corrects_what_is_wider_than_its_reach():
    """One that adds what it was taught of flat pictures does so at both sizes, and not twice."""
    config = RendererConfig(guidance=("lit",), codec="pixels", backbone=SHAPE, scales=2)
    made = NeuralRenderer(config).eval()
    made.backbone.get_parameter("out.bias").data.fill_(0.25)
    flat = torch.full((1, 3, 1, 9, 12), -0.5)
    torch.testing.assert_close(made({"lit": flat}), flat + 0.25)
    torch.nn.init.normal_(made.backbone.get_parameter("out.weight"), std=0.3)
    given = {"lit": video(9, 12, 1)}
    one = NeuralRenderer(config.model_copy(update={"scales": 1})).eval()
    one.load_state_dict(made.state_dict())
    torch.testing.assert_close(made(given), with_coarse(one(given), one({"lit": halved(given)[0]})))


def test_latents_have_one_scale():
    with pytest.raises(ValidationError, match="scales=2 goes with codec=pixels"):
        RendererConfig(codec="block_dct", scales=2)
