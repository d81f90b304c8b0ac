"""Weights of the buffers' latents: what they mean, that equal ones change no bit, and mistakes."""

import math

import numpy as np
import pytest
import torch

from tron.errors import TronError
from tron.neural.configs import BackboneConfig, RendererConfig, UNetConfig
from tron.neural.networks.pixel_mlp import PixelMLP
from tron.neural.renderer import NeuralRenderer, render_clip, to_display_array
from tron.neural.sweep import SWEEP, weight_sweep
from tron.neural.weights import load_renderer, save_renderer

PAIR = ("pbr", "irradiance")
SHAPES = {
    "cosmos": BackboneConfig(heads=2, head_dim=12, layers=1, adaln_lora_dim=8),
    "unet": UNetConfig(widths=(6, 8), blocks=(1, 1), blocks_up=(1,)),
}


def buffers(names=PAIR, frames: int = 1):
    generator = torch.Generator().manual_seed(0)
    return {name: torch.rand(1, 3, frames, 8, 12, generator=generator) * 2 - 1 for name in names}


def displayed(names=PAIR) -> dict[str, np.ndarray]:
    return {name: to_display_array(buffer) for name, buffer in buffers(names).items()}


def renderer(names=PAIR, kind: str = "unet", **config) -> NeuralRenderer:
    """A renderer none of whose weights is where it began; the same numbers at each call."""
    made = NeuralRenderer(RendererConfig(guidance=names, backbone=SHAPES[kind], **config))
    torch.manual_seed(1)
    for parameter in made.parameters():
        torch.nn.init.normal_(parameter, std=0.3 if parameter.ndim > 1 else 0.1)
    return made.eval()


@pytest.mark.parametrize("kind", SHAPES)
@pytest.mark.parametrize("fusion", ["average", "concat"])
@pytest.mark.parametrize(("skip", "names"), [("pbr", PAIR), ("mean", PAIR), ("mean", (*PAIR, "lit"))])
def test_equal_weights_are_none_bit_by_bit(kind, fusion, skip, names):
    given, equal = buffers(names, 5), dict.fromkeys(names, 1 / len(names))
    plain = renderer(names, kind, fusion=fusion, skip=skip)
    told = renderer(names, kind, fusion=fusion, skip=skip, weights=equal)
    assert torch.equal(plain(given), told(given))
    assert torch.equal(plain(given), plain(given, weights=equal))
    assert torch.equal(told(given), told(given, weights=None))


def backbone_input(made: NeuralRenderer, monkeypatch, **kwargs) -> tuple[torch.Tensor, torch.Tensor]:
    """What the backbone is given, and the start: what is drawn where the backbone adds nothing."""
    seen = []
    monkeypatch.setattr(made.backbone, "forward", lambda x, _t: seen.append(x) or torch.zeros_like(x[:, :3]))
    drawn = made(buffers(), **kwargs)
    return seen[0], drawn


def test_an_average_is_the_weighted_sum_of_the_latents(monkeypatch):
    """Seen by the backbone, and by the start where that is the mean."""
    made, given = renderer(codec="pixels", fusion="average", skip="mean"), buffers()
    expected = 0.3 * given["pbr"] + 0.9 * given["irradiance"]
    for each in backbone_input(made, monkeypatch, weights={"pbr": 0.3, "irradiance": 0.9}):
        torch.testing.assert_close(each, expected, atol=1e-6, rtol=1e-6)


def test_of_a_concatenation_each_latent_is_scaled_and_the_start_is_not(monkeypatch):
    made, given = renderer(codec="pixels"), buffers()
    fused, start = backbone_input(made, monkeypatch, weights={"pbr": 0.25, "irradiance": 1.0})
    torch.testing.assert_close(fused, torch.cat([0.5 * given["pbr"], 2.0 * given["irradiance"]], 1))
    assert torch.equal(start, given["pbr"])


@pytest.mark.parametrize("skip", ["pbr", "irradiance", "mean"])
def test_a_buffer_of_weight_zero_is_not_seen(skip):
    given = buffers()
    changed = given | {"irradiance": -given["irradiance"]}
    for fusion in ("average", "concat"):
        made = renderer(fusion=fusion, skip=skip)
        alone = {"pbr": 1.0, "irradiance": 0.0}
        same = torch.equal(made(given, weights=alone), made(changed, weights=alone))
        assert same == (skip != "irradiance")  # the start is what it is
        assert not torch.equal(made(given), made(changed))


def test_pictures_are_linear_in_the_weights_where_the_network_adds_nothing():
    given = buffers()
    made = NeuralRenderer(
        RendererConfig(guidance=PAIR, skip="mean", fusion="average", backbone=SHAPES["unet"])
    )
    one, other = made(given, {"pbr": 1, "irradiance": 0}), made(given, {"pbr": 0, "irradiance": 1})
    torch.testing.assert_close(made(given, {"pbr": 0.3, "irradiance": 0.9}), 0.3 * one + 0.9 * other)


def test_weights_travel_with_the_file_and_are_overridden_at_rendering(tmp_path):
    weights = {"pbr": 0.75, "irradiance": 0.25}
    save_renderer(tmp_path / "r.safetensors", renderer(weights=weights))
    again = load_renderer(tmp_path / "r.safetensors")
    shown = displayed()
    own, told = render_clip(again, shown), render_clip(renderer(), shown, weights=weights)
    np.testing.assert_array_equal(own, told)
    assert np.abs(own - render_clip(again, shown, weights=dict.fromkeys(PAIR, 0.5))).max() > 1e-3


@pytest.mark.parametrize(
    ("weights", "words"),
    [
        (
            {"pbr": 0.5, "irradiance": 0.5, "lit": 1},
            "weights name 'lit': the network is given pbr, irradiance",
        ),
        ({"pbr": 0.5}, "weights lack 'irradiance'"),
        ({}, "weights lack 'pbr'"),
        ({"pbr": -0.5, "irradiance": 1}, "the weight of 'pbr' is -0.5"),
        ({"pbr": math.nan, "irradiance": 1}, "the weight of 'pbr' is nan"),
        ({"pbr": 0, "irradiance": math.inf}, "the weight of 'irradiance' is inf"),
        ({"pbr": 0, "irradiance": 0}, "all weights are 0"),
    ],
)
def test_weights_that_mean_nothing_are_one_line(weights, words):
    with pytest.raises(ValueError, match=words):
        RendererConfig(guidance=PAIR, weights=weights)
    shown = displayed()
    with pytest.raises(TronError, match=words) as caught:
        render_clip(renderer(), shown, weights=weights)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("weights", [{}, {"pbr": 0.0}, {"pbr": 0.0, "irradiance": 0.0, "lit": 0.0}])
def test_weights_of_zero_have_the_right_names_too(weights):
    """A pass takes weights that are all 0, which a sweep's corner is made of."""
    with pytest.raises(TronError, match=r"weights (lack|name)"):
        renderer()(buffers(), weights=weights)


def test_a_network_without_latents_takes_no_weights():
    names = PixelMLP().config.guidance
    shown = dict.fromkeys(names, np.zeros((1, 8, 8, 3), np.float32))
    with pytest.raises(TronError, match="no latents to weigh"):
        render_clip(PixelMLP(), shown, weights=dict.fromkeys(names, 1.0))


def test_the_sweep_is_a_picture_for_each_pair_of_weights():
    shown = displayed()
    made = renderer(fusion="average", skip="mean")
    sweep = weight_sweep(made, shown)
    assert sweep.shape == (5, 5, 8, 12, 3)
    for row, column in ((0, 3), (4, 1), (2, 2)):
        weights = {"pbr": SWEEP[row], "irradiance": SWEEP[column]}
        np.testing.assert_array_equal(sweep[row, column], render_clip(made, shown, weights=weights)[-1])
    np.testing.assert_array_equal(sweep[2, 2], render_clip(made, shown)[-1])
    # The corner of zeros is what the network makes of nothing: the same whatever the buffers are.
    inverted = {name: 1 - buffer for name, buffer in shown.items()}
    np.testing.assert_array_equal(sweep[0, 0], weight_sweep(made, inverted)[0, 0])


def test_a_sweep_leaves_the_other_buffers_their_weights():
    names = (*PAIR, "lit")
    given = displayed(names)
    made = renderer(names, weights={"pbr": 0.5, "irradiance": 0.5, "lit": 0.2})
    np.testing.assert_array_equal(weight_sweep(made, given)[2, 2], render_clip(made, given)[-1])
    with pytest.raises(TronError, match="needs the buffers pbr and irradiance"):
        weight_sweep(renderer(("lit",)), given)
