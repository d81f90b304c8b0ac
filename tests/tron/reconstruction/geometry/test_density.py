"""Laws of density control: whose gradient counts, what is cloned, split, removed and reset, and when."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from tron.gaussians.scene import rotation_matrices
from tron.reconstruction.geometry.surfels import ROWS, LearntSurfels
from tron.reconstruction.geometry.training import DensityControl
from tron.reconstruction.settings import DensitySettings
from tron.seeds import generator

EXTENT = 2.0
CAMERA = torch.tensor([0.0, 0.0, 10.0])
# Every event at every step, unless a test says otherwise.
ALWAYS: dict[str, Any] = {"start": 0, "end": 1000, "every": 1, "threshold": 0.5, "prune_every": 1}


def surfels_of(count: int, scale: float = 0.01, opacity: float = 0.5) -> LearntSurfels:
    rng = generator(count, "density test")
    made = {name: rng.standard_normal((count, *shape)) for name, shape in ROWS.items()}
    made["log_scales"] = np.log(scale) + np.array([0.0, -0.5]) + np.zeros((count, 2))
    made["opacity_logits"] = np.full(count, np.log(opacity / (1 - opacity)))
    tensors = {name: torch.tensor(values, dtype=torch.float32) for name, values in made.items()}
    return LearntSurfels(tensors, {"means": 0.1, "opacity_logits": 0.1})


def control(seed: int = 0, **changes: Any) -> DensityControl:
    return DensityControl(DensitySettings(**{**ALWAYS, "reset_every": 0, **changes}), EXTENT, seed)


def pulled(surfels: LearntSurfels, pull: list[float]) -> torch.Tensor:
    """Gradients of the positions along a random direction, whose criterion from CAMERA is ``pull``."""
    distance = (surfels["means"].detach() - CAMERA).norm(dim=1)
    direction = torch.nn.functional.normalize(torch.randn(len(surfels), 3), dim=1)
    return direction * (2 * torch.tensor(pull) / distance)[:, None]


def observe(density: DensityControl, surfels: LearntSurfels, pull: list[float]) -> None:
    surfels["means"].grad = pulled(surfels, pull)
    density.observe(surfels, CAMERA)


def array(surfels: LearntSurfels, name: str) -> np.ndarray:
    return surfels[name].detach().cpu().numpy().copy()


def test_the_mean_counts_only_the_steps_that_saw_the_surfel() -> None:
    surfels, density = surfels_of(3), control(most=100)
    observe(density, surfels, [0.9, 0.2, 0.6])
    observe(density, surfels, [0.0, 0.2, 0.0])
    observe(density, surfels, [0.0, 0.2, 0.3])
    before = array(surfels, "means")
    density.after(surfels, 1)
    # Means: 0.9 of one step, 0.2 of three, 0.45 of two; the threshold is 0.5.
    np.testing.assert_array_equal(array(surfels, "means"), np.concatenate([before, before[:1]]))


def test_the_criterion_is_the_gradient_times_half_the_distance() -> None:
    surfels, density = surfels_of(2), control()
    gradient = torch.zeros(2, 3)
    gradient[:, 1] = 0.03
    surfels["means"].grad = gradient
    density.observe(surfels, CAMERA)
    expected = 0.03 * np.linalg.norm(array(surfels, "means") - CAMERA.numpy(), axis=1) / 2
    np.testing.assert_allclose(density.state()["density.total"].numpy(), expected, rtol=1e-5)


def test_small_ones_are_cloned_and_large_ones_split() -> None:
    surfels, density = surfels_of(4, scale=0.01 * EXTENT), control()
    with torch.no_grad():  # surfels 1 and 2 are just too large; 3 is not pulled
        surfels["log_scales"][1:3] += 0.01
    before = {name: array(surfels, name) for name in ROWS}
    observe(density, surfels, [1.0, 1.0, 1.0, 0.1])
    density.after(surfels, 1)
    assert len(surfels) == 2 + 1 + 4
    for name in ROWS:
        now = array(surfels, name)
        np.testing.assert_array_equal(now[:3], before[name][[0, 3, 0]])  # kept, kept, clone
        if name not in ("means", "log_scales"):
            np.testing.assert_array_equal(now[3:], before[name][[1, 1, 2, 2]])
    np.testing.assert_allclose(
        np.exp(array(surfels, "log_scales")[3:]),
        np.exp(before["log_scales"])[[1, 1, 2, 2]] / 1.6,
        rtol=1e-6,
    )


def test_the_two_halves_lie_in_the_plane_spread_as_the_surfel_was() -> None:
    count = 800
    surfels, density = surfels_of(count, scale=0.3), control(most=10_000)
    parents = array(surfels, "means")
    rotations = rotation_matrices(array(surfels, "quats")).astype(np.float64)
    scales = np.exp(array(surfels, "log_scales"))
    observe(density, surfels, [1.0] * count)
    density.after(surfels, 1)
    assert len(surfels) == 2 * count
    away = array(surfels, "means").astype(np.float64) - parents.repeat(2, axis=0)
    local = np.einsum("nij,ni->nj", rotations.repeat(2, axis=0), away)
    assert np.abs(local[:, 2]).max() < 1e-5
    standard = local[:, :2] / scales.repeat(2, axis=0)
    # 1600 draws: the standard deviation is known to 2%, the mean to 0.025.
    np.testing.assert_allclose(standard.std(axis=0), 1, atol=0.08)
    np.testing.assert_allclose(standard.mean(axis=0), 0, atol=0.1)


def test_splits_are_a_function_of_seed_and_step() -> None:
    def split(seed: int, step: int) -> np.ndarray:
        surfels, density = surfels_of(5, scale=0.3), control(seed)
        observe(density, surfels, [1.0] * 5)
        density.after(surfels, step)
        return array(surfels, "means")

    np.testing.assert_array_equal(split(0, 7), split(0, 7))
    assert not np.array_equal(split(0, 7), split(1, 7))
    assert not np.array_equal(split(0, 7), split(0, 8))


@pytest.mark.parametrize("scale", [0.001, 0.5])
def test_the_cap_keeps_the_strongest_and_is_never_exceeded(scale: float) -> None:
    surfels, density = surfels_of(6, scale=scale), control(most=8)
    before = array(surfels, "sh_dc")
    observe(density, surfels, [0.6, 3.0, 0.7, 0.1, 2.0, 0.9])
    density.after(surfels, 1)
    assert len(surfels) == 8
    copies = [int((array(surfels, "sh_dc") == row).all((1, 2)).sum()) for row in before]
    assert copies == [1, 2, 1, 1, 2, 1]
    observe(density, surfels, [9.0] * 8)
    density.after(surfels, 2)
    assert len(surfels) == 8


def test_the_mean_begins_anew_after_an_addition() -> None:
    surfels, density = surfels_of(3), control()
    observe(density, surfels, [1.0, 0.1, 0.1])
    density.after(surfels, 1)
    assert len(surfels) == 4
    observe(density, surfels, [0.1] * 4)
    density.after(surfels, 2)
    assert len(surfels) == 4


def test_the_transparent_go_and_the_means_of_the_others_stay() -> None:
    surfels, density = surfels_of(4), control(every=1000)
    logit = float(torch.logit(torch.tensor(0.005)))
    with torch.no_grad():
        surfels["opacity_logits"][1] = logit - 0.01
        surfels["opacity_logits"][2] = logit + 0.01
    observe(density, surfels, [0.1, 0.2, 0.3, 0.4])
    before = array(surfels, "means")
    density.after(surfels, 1)
    np.testing.assert_array_equal(array(surfels, "means"), before[[0, 2, 3]])
    np.testing.assert_allclose(density.state()["density.total"].numpy(), [0.1, 0.3, 0.4], rtol=1e-5)


def test_a_reset_lowers_the_opaque_alone_and_forgets_their_momentum() -> None:
    surfels, density = surfels_of(3), control(every=1000, prune_every=1000, reset_every=5)
    with torch.no_grad():
        surfels["opacity_logits"][0] = -5.0  # 0.0067: below the reset already
    surfels["means"].grad = torch.ones(3, 3)
    surfels["opacity_logits"].grad = torch.zeros(3)
    surfels["opacity_logits"].grad[1] = 1.0
    surfels.step()
    density.after(surfels, 4)
    assert float(surfels["opacity_logits"][2].detach()) == 0
    density.after(surfels, 5)
    opacity = torch.sigmoid(surfels["opacity_logits"].detach()).numpy()
    np.testing.assert_allclose(opacity, [1 / (1 + np.exp(5.0)), 0.01, 0.01], rtol=1e-4)
    state = surfels.state()
    assert not state["adam.opacity_logits.exp_avg"].any()
    assert not state["adam.opacity_logits.exp_avg_sq"].any()
    assert state["adam.means.exp_avg"].all()


def test_the_papers_schedule_to_the_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """3DGRT's: densify in 500 < step < 15000 every 300, prune every 100, reset each 3000."""
    paper = DensitySettings(end=15_000, every=300, reset_every=3000)
    surfels, density = surfels_of(2), DensityControl(paper, EXTENT, 0)
    added, pruned, reset = [], [], []
    monkeypatch.setattr(density, "_add", lambda _, step, most: added.append(step))
    step = 0
    monkeypatch.setattr(density, "_prune", lambda _: pruned.append(step))
    monkeypatch.setattr(surfels, "replace", lambda *_: reset.append(step))
    for step in range(1, 16_001):
        density.after(surfels, step)
    assert added == list(range(600, 15_000, 300))
    assert pruned == list(range(100, 15_000, 100))
    assert reset == [3000, 6000, 9000, 12_000]


def test_nothing_happens_from_the_end_on() -> None:
    surfels, density = surfels_of(3, opacity=0.001), control(end=5, reset_every=1)
    observe(density, surfels, [1.0] * 3)
    before = {name: array(surfels, name) for name in ROWS}
    for step in (5, 6, 100):
        density.after(surfels, step)
    for name in ROWS:
        np.testing.assert_array_equal(array(surfels, name), before[name])


def test_a_step_that_taught_positions_nothing_is_not_counted() -> None:
    surfels, density = surfels_of(3), control()
    density.observe(surfels, CAMERA)
    assert not density.state()["density.seen"].any()


def test_the_state_round_trip_decides_alike() -> None:
    one, density = surfels_of(4), control()
    observe(density, one, [0.4, 0.6, 0.1, 0.9])
    other, again = surfels_of(4), control()
    again.restore({name: tensor.clone() for name, tensor in density.state().items()}, torch.device("cpu"))
    for surfels, each in ((one, density), (other, again)):
        observe(each, surfels, [0.7, 0.0, 0.2, 0.0])
        each.after(surfels, 1)
    assert len(one) == 4 + 3
    np.testing.assert_array_equal(array(one, "means"), array(other, "means"))


@pytest.mark.parametrize(("smaller", "count"), [(1, 10), (2, 10), (4, 8), (8, 6)])
def test_smaller_pictures_have_room_for_fewer_surfels(smaller: int, count: int) -> None:
    """Six surfels that all want to be two: 32 may be at most, divided by how much smaller pictures are."""
    surfels, density = surfels_of(6), control(most=32)
    observe(density, surfels, [0.9, 0.8, 0.7, 0.6, 0.2, 0.1])
    density.after(surfels, 1, smaller)
    assert len(surfels) == count
