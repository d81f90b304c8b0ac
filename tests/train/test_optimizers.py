"""The optimiser: which weights follow which rule, and that two of them act as one."""

import copy

import pytest
import torch

from train.optimizers import CombinedOptimizer, make_optimizer
from train.settings import OptimizerSettings
from tron.neural.configs import BackboneConfig, PixelMLPConfig, RendererConfig
from tron.neural.networks.pixel_mlp import PixelMLP
from tron.neural.renderer import NeuralRenderer

RENDERERS = [
    PixelMLP(PixelMLPConfig(width=8)),
    NeuralRenderer(RendererConfig(backbone=BackboneConfig(heads=1, head_dim=12, layers=1, adaln_lora_dim=4))),
    NeuralRenderer(
        RendererConfig(
            backbone=BackboneConfig(
                heads=1, head_dim=12, layers=1, adaln_lora_dim=4, cross_attention="frozen"
            )
        )
    ),
]
MUON = OptimizerSettings(learning_rate=1e-3, muon_learning_rate=0.02)


def run(optimizer: torch.optim.Optimizer, model: torch.nn.Module, steps: int, first: int = 0) -> None:
    for step in range(first, first + steps):
        generator = torch.Generator().manual_seed(step)
        loss = (model(torch.randn(4, 6, generator=generator)) - 1).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


@pytest.mark.parametrize("renderer", RENDERERS)
@pytest.mark.parametrize("settings", [MUON, OptimizerSettings()])
def test_every_trained_weight_is_optimised_once(renderer, settings):
    optimizer = make_optimizer(renderer, settings)
    optimised = [id(p) for group in optimizer.param_groups for p in group["params"]]
    assert sorted(optimised) == sorted(id(p) for p in renderer.parameters() if p.requires_grad)


@pytest.mark.parametrize("renderer", RENDERERS)
def test_muon_takes_the_hidden_matrices_at_its_own_rate(renderer):
    optimizer = make_optimizer(renderer, MUON)
    assert [group["lr"] for group in optimizer.param_groups] == [0.02, 0.001]
    hidden = optimizer.param_groups[0]["params"]
    assert hidden
    assert all(p.ndim == 2 and p.requires_grad for p in hidden)


def model() -> torch.nn.Sequential:
    torch.manual_seed(0)
    return torch.nn.Sequential(torch.nn.Linear(6, 8), torch.nn.Tanh(), torch.nn.Linear(8, 1))


def parts(net: torch.nn.Sequential) -> list[torch.optim.Optimizer]:
    return [
        torch.optim.SGD(net[0].parameters(), lr=0.1, momentum=0.9),
        torch.optim.AdamW(net[2].parameters(), lr=0.01),
    ]


def test_two_together_do_what_each_does_alone():
    joined, apart = model(), model()
    run(CombinedOptimizer(parts(joined)), joined, 5)
    separate = parts(apart)
    for step in range(5):
        generator = torch.Generator().manual_seed(step)
        for optimizer in separate:
            optimizer.zero_grad()
        (apart(torch.randn(4, 6, generator=generator)) - 1).square().mean().backward()
        for optimizer in separate:
            optimizer.step()
    assert all(torch.equal(a, b) for a, b in zip(joined.parameters(), apart.parameters()))


def test_a_schedule_reaches_every_part():
    net = model()
    optimizer = CombinedOptimizer(parts(net))
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: 0.5**step)
    run(optimizer, net, 1)
    schedule.step()
    assert [part.param_groups[0]["lr"] for part in optimizer.parts] == [0.05, 0.005]


def test_state_goes_through_a_checkpoint():
    whole, resumed = model(), model()
    run(CombinedOptimizer(parts(whole)), whole, 6)
    first = CombinedOptimizer(parts(resumed))
    run(first, resumed, 3)
    state = copy.deepcopy(first.state_dict())
    second = CombinedOptimizer(parts(resumed))
    second.load_state_dict(state)
    schedule = torch.optim.lr_scheduler.LambdaLR(second, lambda _: 1.0)  # still reaches the restored groups
    run(second, resumed, 3, first=3)
    schedule.step()
    assert all(torch.equal(a, b) for a, b in zip(whole.parameters(), resumed.parameters()))
