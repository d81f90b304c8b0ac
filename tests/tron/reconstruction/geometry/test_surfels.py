"""Laws of the surfels under Adam: moments stay with their surfels, and every step is Kingma and Ba's."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tron.errors import TronError
from tron.gaussians import GaussianScene
from tron.gaussians.fields import MATERIALS
from tron.reconstruction.geometry.surfels import ADAM_EPSILON, ROWS, LearntSurfels
from tron.runtime import torch_device
from tron.seeds import generator

RATES = {name: 0.01 * (i + 1) for i, name in enumerate(ROWS)}


def rows(count: int, seed: int = 0) -> dict[str, torch.Tensor]:
    """Random tensors by name, materials in [0, 1]."""
    rng = generator(seed, "surfels")
    made = {name: rng.standard_normal((count, *shape)) for name, shape in ROWS.items()}
    made |= {name: 0.3 + 0.4 * rng.random((count, *ROWS[name])) for name in MATERIALS}
    return {name: torch.tensor(values, dtype=torch.float32) for name, values in made.items()}


def learn(surfels: LearntSurfels, seed: int, only: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
    """One step under random gradients, which are given back; ``only`` those surfels have any."""
    rng = generator(seed, "gradients")
    surfels.clear_gradients()
    gradients = {}
    for name in surfels.rates:
        gradient = torch.tensor(rng.standard_normal(surfels[name].shape), dtype=torch.float32)
        if only is not None:
            gradient[~only] = 0
        gradients[name] = gradient
        surfels[name].grad = gradient.to(surfels.device)
    surfels.step()
    return gradients


def moments(surfels: LearntSurfels) -> dict[str, np.ndarray]:
    state = surfels.state()
    return {name: state[name].numpy().copy() for name in state if name.endswith(("exp_avg", "exp_avg_sq"))}


def values(surfels: LearntSurfels) -> dict[str, np.ndarray]:
    return {name: surfels[name].detach().cpu().numpy().copy() for name in ROWS}


def test_two_steps_are_adams() -> None:
    start = rows(7)
    surfels = LearntSurfels(start, RATES)
    wanted = {name: start[name].numpy().astype(np.float64) for name in ROWS}
    first = {name: np.zeros_like(v) for name, v in wanted.items()}
    second = {name: np.zeros_like(v) for name, v in wanted.items()}
    for step in (1, 2):
        gradients = learn(surfels, step)
        for name in ROWS:
            g = gradients[name].numpy().astype(np.float64)
            first[name] = 0.9 * first[name] + 0.1 * g
            second[name] = 0.999 * second[name] + 0.001 * g * g
            root = np.sqrt(second[name] / (1 - 0.999**step)) + ADAM_EPSILON
            wanted[name] -= RATES[name] * first[name] / (1 - 0.9**step) / root
            if name in MATERIALS:
                wanted[name] = wanted[name].clip(0, 1)
    for name in ROWS:
        np.testing.assert_allclose(
            surfels[name].detach().cpu().numpy(), wanted[name], atol=2e-6, err_msg=name
        )


def test_moments_go_with_their_surfels() -> None:
    surfels = LearntSurfels(rows(6), RATES)
    learn(surfels, 1)
    before, held = moments(surfels), values(surfels)
    order = torch.tensor([4, 0, 5])
    surfels.select(order)
    for name, moment in moments(surfels).items():
        np.testing.assert_array_equal(moment, before[name][[4, 0, 5]])
    mask = torch.tensor([True, False, True])
    surfels.select(mask)
    surfels.append(rows(2, seed=3))
    assert len(surfels) == 4
    for name, moment in moments(surfels).items():
        np.testing.assert_array_equal(moment[:2], before[name][[4, 5]])
        assert not moment[2:].any()
        assert before[name].any()
    for name, now in values(surfels).items():
        np.testing.assert_array_equal(now[:2], held[name][[4, 5]])
        np.testing.assert_array_equal(now[2:], rows(2, seed=3)[name].numpy())


def test_surgery_does_not_disturb_the_steps_of_those_that_stay() -> None:
    """Surfel 2 of five learns the same whether or not others go and come around it."""
    alone, among = LearntSurfels(rows(5), RATES), LearntSurfels(rows(5), RATES)
    learn(alone, 1)
    learn(among, 1)
    among.select(torch.tensor([False, False, True, True, False]))
    among.append(rows(3, seed=9))
    for surfels, place in ((alone, 2), (among, 0)):
        surfels.clear_gradients()
        for name in ROWS:
            gradient = torch.zeros_like(surfels[name])
            gradient[place] = 0.7
            surfels[name].grad = gradient
        surfels.step()
    for name in ROWS:
        np.testing.assert_array_equal(alone[name].detach()[2].numpy(), among[name].detach()[0].numpy())


def test_replacing_a_tensor_clears_its_moments_and_no_others() -> None:
    surfels = LearntSurfels(rows(4), RATES)
    learn(surfels, 1)
    before = moments(surfels)
    surfels.replace("opacity_logits", torch.full((4,), -2.0))
    assert (surfels["opacity_logits"] == -2).all()
    for name, moment in moments(surfels).items():
        if name.startswith("adam.opacity_logits"):
            assert not moment.any()
        else:
            np.testing.assert_array_equal(moment, before[name])


def test_materials_stay_between_zero_and_one_and_nothing_else_is_clamped() -> None:
    surfels = LearntSurfels(rows(4), dict.fromkeys(ROWS, 5.0))
    for name in ROWS:
        surfels[name].grad = torch.ones_like(surfels[name])
    surfels.step()
    for name in ROWS:
        low = float(surfels[name].detach().min())
        assert low == 0 if name in MATERIALS else low < -3


def test_what_has_no_rate_stands_still_through_steps_and_surgery() -> None:
    start = rows(4)
    surfels = LearntSurfels(start, {"base_color": 0.1})
    assert [name for name in ROWS if surfels[name].requires_grad] == ["base_color"]
    learn(surfels, 1)
    surfels.select(torch.tensor([3, 1]))
    learn(surfels, 2)
    for name in ROWS:
        same = np.array_equal(surfels[name].detach().cpu().numpy(), start[name][[3, 1]].numpy())
        assert same == (name != "base_color")


def test_a_state_given_back_goes_on_bit_by_bit() -> None:
    surfels = LearntSurfels({name: values.to(torch_device()) for name, values in rows(5).items()}, RATES)
    learn(surfels, 1)
    stored = {name: tensor.clone() for name, tensor in surfels.state().items()}
    again = LearntSurfels.of_state(stored, RATES)
    for one in (surfels, again):
        learn(one, 2)
        one.select(torch.tensor([2, 0, 1]))
        learn(one, 3)
    for name in ROWS:
        np.testing.assert_array_equal(
            surfels[name].detach().cpu().numpy(), again[name].detach().cpu().numpy()
        )
    assert surfels.state().keys() == again.state().keys()


def test_a_state_is_not_changed_by_those_made_from_it() -> None:
    surfels = LearntSurfels(rows(5), RATES)
    learn(surfels, 1)
    stored = {name: tensor.clone() for name, tensor in surfels.state().items()}
    kept = {name: tensor.clone() for name, tensor in stored.items()}
    learn(LearntSurfels.of_state(stored, RATES), 2)
    for name in stored:
        torch.testing.assert_close(stored[name], kept[name], atol=0, rtol=0)


def test_a_rate_that_is_set_is_the_rate_of_the_next_step() -> None:
    surfels = LearntSurfels(rows(3), RATES)
    before = surfels["means"].detach().clone()
    surfels.set_rate("means", 0.5)
    learn(surfels, 1)
    # Adam's first step is the rate in the direction of the gradient's sign.
    np.testing.assert_allclose((surfels["means"].detach() - before).abs().numpy(), 0.5, rtol=1e-5)


def test_scenes_come_and_go_and_their_quaternions_are_units() -> None:
    made = rows(6)
    made["quats"] *= 7
    made["quats"][3] = 0
    surfels = LearntSurfels(made, RATES)
    up = np.array([0.0, 1.0, 0.0])
    scene = surfels.scene(4, up).validate()
    lengths = np.linalg.norm(made["quats"].numpy(), axis=1, keepdims=True)
    expected = made["quats"].numpy() / np.where(lengths > 0, lengths, 1)
    expected[3] = (1, 0, 0, 0)
    np.testing.assert_allclose(scene.quats, expected, atol=1e-6)
    assert scene.kernel_degree == 4
    np.testing.assert_array_equal(scene.up, up)
    for name in ROWS:
        if not name.startswith("sh_") and name != "quats":
            np.testing.assert_array_equal(getattr(scene, name), made[name].numpy())
    np.testing.assert_array_equal(scene.sh, torch.cat([made["sh_dc"], made["sh_rest"]], 1).numpy())


def test_a_scene_learnt_from_again_is_the_same_scene_bit_by_bit() -> None:
    """Else a run that goes on from a checkpoint would see other surfels than one that was never cut off."""
    scene = LearntSurfels(rows(5000), {"means": 0.1}).scene(2, np.array([0.0, 0, 1]))
    again = LearntSurfels.of_scene(scene, {"base_color": 0.1}).scene(2, scene.up)
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh", "base_color", "roughness"):
        np.testing.assert_array_equal(getattr(scene, name), getattr(again, name), err_msg=name)
    assert scene.spacing == again.spacing


def test_learning_does_not_write_into_the_scene(painted: GaussianScene) -> None:
    before = painted.means.copy()
    surfels = LearntSurfels.of_scene(painted, RATES)
    learn(surfels, 1)
    np.testing.assert_array_equal(painted.means, before)
    assert not np.array_equal(surfels["means"].detach().cpu().numpy(), before)


@pytest.mark.parametrize("kept", [torch.zeros(4, dtype=torch.bool), torch.zeros(0, dtype=torch.long)])
def test_nothing_left_is_an_error(kept: torch.Tensor) -> None:
    surfels = LearntSurfels(rows(4), RATES)
    with pytest.raises(TronError, match="no surfel would be left"):
        surfels.select(kept)
    assert len(surfels) == 4


def test_nothing_to_begin_with_is_an_error() -> None:
    with pytest.raises(TronError, match="no surfels"):
        LearntSurfels(rows(0), RATES)
