"""Losses: the formulas written out, and PSNR as tron.metrics has it."""

import logging

import numpy as np
import pytest
import torch

from tron import metrics
from tron.errors import TronError
from tron.neural.losses import RendererLoss, lost_sharpness, psnr_per_frame


def pair(frames: int = 2, size: int = 16):
    generator = torch.Generator().manual_seed(0)
    return [torch.rand(2, 3, frames, size, size, generator=generator) * 2 - 1 for _ in range(2)]


def test_without_vgg_the_loss_is_the_squared_error_and_the_log_says_so(caplog):
    a, b = pair()
    with caplog.at_level(logging.INFO):
        loss = RendererLoss(l2=2.0, lpips=1.0)
    assert "LPIPS is absent" in caplog.text
    np.testing.assert_allclose(loss(a, b).item(), 2 * np.mean((a.numpy() - b.numpy()) ** 2), rtol=1e-6)


def test_psnr_is_the_mean_over_frames_and_the_better_frame_counts_as_much(caplog):
    a, b = pair()
    b = torch.stack([b[0], a[1] + 0.02 * (b[1] - a[1])])  # the second sample is nearly right
    with caplog.at_level(logging.INFO):
        loss = RendererLoss(l2=0.0, psnr=0.5)
    assert "0.5 PSNR" in caplog.text
    a.requires_grad_()
    value = loss(a, b)
    unclamped = [
        -10 * np.log10(np.mean(((x - y) / 2) ** 2) + 1e-5)
        for x, y in zip(a.detach().movedim(2, 1).flatten(0, 1).numpy(), b.movedim(2, 1).flatten(0, 1).numpy())
    ]
    np.testing.assert_allclose(value.item(), -0.5 * np.mean(unclamped), rtol=1e-5)
    value.backward()
    assert a.grad is not None
    far, near = a.grad.flatten(1).norm(dim=1)
    assert near > 5 * far


def test_lpips_is_the_mean_over_frames_of_the_metric(tmp_path):
    torch.manual_seed(0)
    widths = [64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512]
    places = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)
    state = {}
    for place, inputs, outputs in zip(places, [3, *widths], widths):
        state[f"features.{place}.weight"] = torch.randn(outputs, inputs, 3, 3) * (2 / (9 * inputs)) ** 0.5
        state[f"features.{place}.bias"] = torch.zeros(outputs)
    torch.save(state, tmp_path / "vgg16.pth")
    a, b = pair()
    together = RendererLoss(1.0, 0.5, tmp_path / "vgg16.pth")(a, b)
    lpips = metrics.LPIPS.load(tmp_path / "vgg16.pth")
    each = torch.stack([lpips(a[:, :, k], b[:, :, k]) for k in range(2)])
    torch.testing.assert_close(together, (a - b).square().mean() + 0.5 * each.mean(), atol=1e-5, rtol=1e-4)


def test_a_vgg_path_that_is_wrong_is_an_error_not_a_silent_absence(tmp_path):
    with pytest.raises(TronError, match="missing"):
        RendererLoss(vgg_weights=tmp_path / "vgg16.pth")


def test_psnr_of_a_video_is_that_of_its_frames():
    a, b = pair()
    mask = torch.rand(2, 1, 2, 16, 16) > 0.3
    shown = psnr_per_frame(a * 1.2, b, mask.float())
    for i in range(2):
        for k in range(2):
            images = [(v[i, :, k].clamp(-1, 1).movedim(0, -1).numpy() + 1) / 2 for v in (a * 1.2, b)]
            expected = metrics.psnr(images[0], images[1], mask[i, 0, k].numpy())
            np.testing.assert_allclose(shown[i, k].item(), expected, rtol=1e-4)


def test_a_frame_without_foreground_has_no_psnr():
    a, b = pair()
    mask = torch.zeros(2, 1, 2, 16, 16)
    assert torch.isnan(psnr_per_frame(a, b, mask)).all()


def test_beyond_its_ceiling_a_frame_gains_nothing_and_has_no_more_say(caplog):
    """Of two frames of 30 and 60 dB: at a ceiling of 40 the better one has a hundredth of its say."""
    target = torch.zeros(2, 3, 1, 8, 8)
    off = 2 * torch.tensor([10 ** (-30 / 20), 10 ** (-60 / 20)]).view(2, 1, 1, 1, 1)
    gradients = {}
    for ceiling in (40.0, 100.0):
        a = (target + off).requires_grad_()
        value = RendererLoss(l2=0, psnr=1.0, psnr_ceiling=ceiling)(a, target)
        expected = [-10 * np.log10(10 ** (-dB / 10) + 10 ** (-ceiling / 10)) for dB in (30, 60)]
        np.testing.assert_allclose(value.item(), -np.mean(expected), rtol=1e-5)
        value.backward()
        assert a.grad is not None
        gradients[ceiling] = a.grad.flatten(1).norm(dim=1)
    assert gradients[40.0][0] == pytest.approx(gradients[100.0][0].item() / 1.1, rel=1e-3)
    assert gradients[40.0][1] == pytest.approx(gradients[100.0][1].item() / 101, rel=1e-2)


def test_sharpness_that_is_lost_is_the_gradients_strength_in_windows(caplog):
    a, b = pair(frames=2, size=20)  # windows of 16 and of what is left
    a = b + 0.5 * (a - b)

    def strengths(video):
        squares = np.diff(video, axis=-1)[..., 1:, :] ** 2 + np.diff(video, axis=-2)[..., 1:] ** 2
        parts = [(slice(0, 16), slice(0, 16)), (slice(0, 16), slice(16, 19)), (slice(16, 19), slice(0, 16))]
        parts.append((slice(16, 19), slice(16, 19)))
        return np.array([np.sqrt(squares[..., y, x].mean((1, 3, 4))) for y, x in parts])

    lost = np.maximum(0.9 * strengths(b.numpy()) - strengths(a.numpy()), 0).mean()
    with caplog.at_level(logging.INFO):
        loss = RendererLoss(l2=0.0, sharpness=3.0)
    assert "3 sharpness" in caplog.text
    assert lost > 0
    np.testing.assert_allclose(loss(a, b).item(), 3 * lost, rtol=1e-3)


def test_what_is_blurred_loses_and_what_is_displaced_or_too_sharp_does_not():
    edge = torch.cat([torch.zeros(1, 1, 1, 8, 4), torch.ones(1, 1, 1, 8, 4)], -1)
    blurred = edge.clone()
    blurred[..., 3], blurred[..., 4] = 0.25, 0.75
    assert lost_sharpness(blurred, edge) > 0.2 * edge.diff(dim=-1).square().mean().sqrt()
    for kept in (edge.roll(1, -1)[..., 1:], 2 * edge, edge + 0.5):
        assert lost_sharpness(kept, edge[..., : kept.shape[-1]]).item() == pytest.approx(0, abs=1e-3)
