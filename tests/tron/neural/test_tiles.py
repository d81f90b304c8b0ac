"""Pictures drawn in tiles are those of one pass."""

from typing import Literal

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from tron import seeds
from tron.neural.configs import PixelMLPConfig, RendererConfig, UNetConfig
from tron.neural.networks.pixel_mlp import PixelMLP
from tron.neural.protocols import Renderer
from tron.neural.renderer import TILE, NeuralRenderer, drawn_in_tiles, render_clip
from tron.neural.shipped import shipped
from tron.neural.weights import load_renderer


def picture(names: tuple[str, ...], height: int, width: int) -> dict[str, torch.Tensor]:
    """Smooth shapes with hard edges, and the noise of a few rays, (1, 3, 1, H, W) in [-1, 1]."""
    draw = seeds.generator(0, "tiles")
    found = {}
    for name in names:
        shapes = np.sign(gaussian_filter(draw.standard_normal((3, height, width)), (0, 12, 12)))
        shade = 20 * gaussian_filter(draw.standard_normal((3, height, width)), (0, 25, 25))
        noise = 0.1 * draw.standard_normal((3, height, width))
        image = np.clip(0.4 * shapes + shade + noise, -1, 1).astype(np.float32)
        found[name] = torch.from_numpy(image)[None, :, None]
    return found


def worst(renderer: Renderer, height: int, width: int, side: int) -> float:
    """Largest difference of display values."""
    given = picture(renderer.config.guidance, height, width)
    with torch.no_grad():
        difference = drawn_in_tiles(renderer, given, side=side) - renderer(given)
    return float(difference.abs().max()) / 2


@pytest.mark.parametrize("name", ["surfaces", "paper"])
def test_tiles_of_a_shipped_network_are_its_picture_within_a_255th(name: str):
    renderer = load_renderer(shipped(name)).eval()
    assert worst(renderer, 250, 421, side=100) < 1 / 255


def test_without_the_margin_they_are_not(monkeypatch):
    renderer = load_renderer(shipped("surfaces")).eval()
    monkeypatch.setattr(NeuralRenderer, "reach", 0)
    assert worst(renderer, 250, 421, side=100) > 1 / 255


@pytest.mark.parametrize("scales", [1, 2])
def test_tiles_begin_where_the_strides_of_the_whole_do(scales: Literal[1, 2]):
    """Of a network whose reach is within the margin, exactly."""
    shape = UNetConfig(widths=(6, 8), blocks=(1, 1), blocks_up=(1,), temporal=False)
    config = RendererConfig(
        codec="pixels", backbone=shape, scales=scales, skip_blur=0.6, skip_kernel=3, skip_holes=2
    )
    renderer = NeuralRenderer(config).eval()
    torch.manual_seed(0)
    for parameter in renderer.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    assert worst(renderer, 131, 467, side=150) < 1e-5


def test_pixels_alone_need_no_margin():
    renderer = PixelMLP(PixelMLPConfig()).eval()
    torch.nn.init.normal_(list(renderer.parameters())[-2], std=0.3)  # the last matrix
    assert worst(renderer, 21, 50, side=16) < 1e-6


def test_clips_larger_than_a_tile_are_drawn_in_tiles(monkeypatch):
    renderer = load_renderer(shipped("paper")).eval()
    widest = 0
    forward = NeuralRenderer.forward

    def watched(self, buffers, weights=None):
        nonlocal widest
        widest = max(widest, next(iter(buffers.values())).shape[-1])
        return forward(self, buffers, weights)

    monkeypatch.setattr(NeuralRenderer, "forward", watched)
    names = renderer.config.guidance
    given = picture(names, 24, 2 * TILE)
    shown = {name: (image[0].permute(1, 2, 3, 0).numpy() + 1) / 2 for name, image in given.items()}
    assert render_clip(renderer, shown).shape == (1, 24, 2 * TILE, 3)
    assert widest <= TILE + 2 * 128
