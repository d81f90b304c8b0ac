"""Muon in float32, against torch's."""

import pytest
import torch

from train.optimizers import Muon, orthogonalised

SHAPES = ((24, 24), (24, 48), (48, 24), (24, 48), (8, 3))


def weights() -> list[torch.nn.Parameter]:
    generator = torch.Generator().manual_seed(0)
    return [torch.nn.Parameter(torch.randn(shape, generator=generator)) for shape in SHAPES]


def trained(kind: type[Muon] | type[torch.optim.Muon], steps: int, **options) -> list[torch.nn.Parameter]:
    made, generator = weights(), torch.Generator().manual_seed(1)
    optimizer = kind(made, lr=0.02, weight_decay=0.1, adjust_lr_fn="original", **options)
    for _ in range(steps):
        for weight in made:
            weight.grad = torch.randn(weight.shape, generator=generator)
        optimizer.step()
    return made


@pytest.mark.parametrize("options", [{}, {"nesterov": False}, {"momentum": 0.5, "ns_steps": 3}])
def test_it_steps_as_torchs_does_but_for_its_bf16(options: dict):
    for ours, torchs, start in zip(
        trained(Muon, 4, **options), trained(torch.optim.Muon, 4, **options), weights()
    ):
        moved = (torchs - start).norm()
        assert (ours - torchs).norm() < 0.05 * moved
        assert (ours - start).norm() > 0.5 * moved


def test_singular_values_come_near_one_and_vectors_stay():
    matrices = torch.randn(3, 20, 30, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    u, s, v = torch.linalg.svd(matrices, full_matrices=False)
    turned = orthogonalised(matrices)
    values = torch.einsum("nij,nik,nkj->nj", u, turned, v.mT)
    assert values.min() > 0.6
    assert values.max() < 1.3
    torch.testing.assert_close(u @ torch.diag_embed(values) @ v, turned)
    torch.testing.assert_close(orthogonalised(matrices.mT), turned.mT)
    assert s.max() / s.min() > 3


def test_its_state_goes_on_where_it_was_saved():
    whole = trained(Muon, 6)
    made, generator = weights(), torch.Generator().manual_seed(1)
    optimizer = Muon(made, lr=0.02, weight_decay=0.1, adjust_lr_fn="original")
    for step in range(6):
        if step == 3:
            state = optimizer.state_dict()
            optimizer = Muon(made, lr=0.02, weight_decay=0.1, adjust_lr_fn="original")
            optimizer.load_state_dict(state)
        for weight in made:
            weight.grad = torch.randn(weight.shape, generator=generator)
        optimizer.step()
    for one, other in zip(whole, made):
        assert torch.equal(one, other)


def test_a_matrix_without_a_gradient_stays():
    made = weights()
    before = made[0].detach().clone()
    made[1].grad = torch.ones_like(made[1])
    Muon(made, lr=0.1).step()
    assert torch.equal(made[0], before)
    assert not torch.equal(made[1], weights()[1])


def test_the_closure_is_evaluated_with_gradients():
    (weight, *_) = weights()

    def closure() -> torch.Tensor:
        loss = weight.square().sum()
        loss.backward()
        return loss

    optimizer = Muon([weight], lr=0.1)
    assert optimizer.step(closure) > optimizer.step(closure)
