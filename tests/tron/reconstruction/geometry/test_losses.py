"""Laws of the photometric loss: torchmetrics' SSIM in value and gradient, and masks that hide."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torchmetrics.functional.image import structural_similarity_index_measure

from tron.reconstruction.geometry.losses import SSIM_WEIGHT, photometric_loss, structural_similarity
from tron.seeds import generator


def pair(height: int, width: int, channels: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
    """Two different images of smooth and rough parts, in [0, 1]."""
    rng = generator(0, "losses", height, width)
    ramp = np.linspace(0, 1, width)[None, :, None] * np.linspace(0.2, 1, height)[:, None, None]
    noise = rng.random((2, height, width, channels))
    first, second = 0.7 * ramp + 0.3 * noise[0], 0.6 * ramp + 0.4 * noise[1]
    return torch.tensor(first, dtype=torch.float32), torch.tensor(second, dtype=torch.float32)


def witness(predicted: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """torchmetrics' SSIM of each pixel and channel, (H, W, C), in float64."""
    first, second = (image.double().movedim(-1, 0)[None] for image in (predicted, target))
    found = structural_similarity_index_measure(first, second, data_range=1.0, return_full_image=True)
    return found[1][0].movedim(0, -1)


@pytest.mark.parametrize("size", [(32, 32), (19, 40), (11, 7), (6, 6), (150, 301)])
def test_ssim_and_its_gradient_are_those_of_torchmetrics(size: tuple[int, int]) -> None:
    predicted, target = pair(*size)
    weights = torch.tensor(generator(1, "weights").random((*size, 3)), dtype=torch.float32)
    ours, theirs = (predicted.clone().requires_grad_(True) for _ in range(2))
    here, there = structural_similarity(ours, target), witness(theirs, target)
    assert float(here.detach().mean()) == pytest.approx(float(there.detach().mean()), abs=1e-5)
    # A variance is a difference of squares: float32 loses it to 1e-7, against C2 = 9e-4.
    torch.testing.assert_close(here.double(), there, atol=1e-4, rtol=0)
    (here * weights).sum().backward()
    (there * weights).sum().backward()
    assert ours.grad is not None
    assert theirs.grad is not None
    assert theirs.grad.abs().max() > 0.1
    scale = float(theirs.grad.abs().max())
    torch.testing.assert_close(ours.grad, theirs.grad, atol=2e-4 * scale, rtol=0)


def test_the_loss_is_the_weighted_sum_that_it_says() -> None:
    predicted, target = pair(24, 16)
    l1, similarity = (predicted - target).abs().mean(), witness(predicted, target).mean()
    for weight in (0.0, SSIM_WEIGHT, 1.0):
        expected = (1 - weight) * l1 + weight * (1 - similarity)
        assert float(photometric_loss(predicted, target, ssim_weight=weight)) == pytest.approx(
            float(expected), abs=1e-5
        )
    assert float(photometric_loss(target, target)) == pytest.approx(0, abs=1e-6)


def test_what_lies_outside_the_mask_changes_neither_loss_nor_gradient() -> None:
    predicted, target = pair(24, 24)
    mask = torch.zeros(24, 24, dtype=torch.bool)
    mask[5:15, 8:20] = True
    other = torch.where(mask[..., None], predicted, 1 - predicted)
    found = []
    for image in (predicted, other):
        leaf = image.clone().requires_grad_(True)
        loss = photometric_loss(leaf, target, mask)
        loss.backward()
        assert leaf.grad is not None
        assert not leaf.grad[~mask].any()
        assert leaf.grad[mask].any(-1).all()
        found.append((float(loss.detach()), leaf.grad))
    assert found[0][0] == found[1][0]
    torch.testing.assert_close(found[0][1], found[1][1], atol=0, rtol=0)
    l1 = float((predicted - target).abs()[mask].mean())
    assert float(photometric_loss(predicted, target, mask, 0.0)) == pytest.approx(l1, rel=1e-5)


def test_a_mask_of_everything_is_no_mask_and_one_of_nothing_costs_nothing() -> None:
    predicted, target = pair(16, 16)
    everything = torch.ones(16, 16, dtype=torch.bool)
    assert float(photometric_loss(predicted, target, everything)) == pytest.approx(
        float(photometric_loss(predicted, target)), rel=1e-5
    )
    leaf = predicted.clone().requires_grad_(True)
    loss = photometric_loss(leaf, target, ~everything)
    loss.backward()
    assert float(loss.detach()) == 0
    assert leaf.grad is not None
    assert not leaf.grad.any()


def test_grey_images_count_as_the_same_grey_in_three_channels() -> None:
    predicted, target = (image[..., 0].contiguous() for image in pair(16, 20))
    three = [image[..., None].repeat(1, 1, 3) for image in (predicted, target)]
    assert float(photometric_loss(predicted, target)) == pytest.approx(
        float(photometric_loss(three[0], three[1])), rel=1e-5
    )


@pytest.mark.parametrize("size", [(5, 30), (1, 1), (5, 5)])
def test_tiny_images_are_compared_by_l1_alone(size: tuple[int, int]) -> None:
    predicted, target = pair(*size)
    expected = float((predicted - target).abs().mean())
    assert float(photometric_loss(predicted, target)) == pytest.approx(expected, rel=1e-5)


def test_the_gradient_is_that_of_finite_differences() -> None:
    """Independent of any autograd. Of SSIM alone: L1 has kinks, which differences step over."""
    predicted, target = pair(12, 12)
    leaf = predicted.clone().requires_grad_(True)
    photometric_loss(leaf, target, ssim_weight=1.0).backward()
    assert leaf.grad is not None
    direction = torch.tensor(generator(2, "direction").standard_normal((12, 12, 3)), dtype=torch.float32)
    step = 1e-3
    moved = [predicted + sign * step * direction for sign in (1, -1)]
    ends = [float(photometric_loss(image, target, ssim_weight=1.0)) for image in moved]
    assert float((leaf.grad * direction).sum()) == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=0.02)
