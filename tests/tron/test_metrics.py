"""Metrics against closed forms and independent implementations."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.ndimage import correlate1d

from tron import metrics
from tron.errors import TronError
from tron.seeds import generator


def pair(height: int = 40, width: int = 56) -> tuple[np.ndarray, np.ndarray]:
    rng = generator(0, "metrics")
    a = rng.random((height, width, 3))
    return a, np.clip(a + 0.1 * rng.normal(size=a.shape), 0, 1)


def half_mask(height: int = 40, width: int = 56) -> np.ndarray:
    return np.broadcast_to(np.arange(width) < width // 2, (height, width))


def test_psnr_of_a_constant_error_is_its_closed_form():
    a = np.full((4, 5, 3), 0.5)
    assert metrics.psnr(a, a + 0.1) == pytest.approx(20)
    assert metrics.psnr(a, a) == float("inf")
    assert metrics.capped_psnr(a, a) == metrics.PSNR_CAP
    assert metrics.capped_psnr(a, a + 0.1) == metrics.psnr(a, a + 0.1)


def test_psnr_looks_at_the_mask_alone():
    a, b = pair()
    outside = np.where(half_mask()[..., None], b, 1 - b)
    assert metrics.psnr(a, outside, half_mask()) == metrics.psnr(a[:, :28], b[:, :28])


def test_ssim_agrees_with_a_direct_evaluation_of_its_formula():
    """Wang et al. 2004 in float64 by SciPy: Gaussian weights, population moments, mirrored borders."""
    a, b = pair()
    weights = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    weights /= weights.sum()

    def blur(x: np.ndarray) -> np.ndarray:
        return correlate1d(correlate1d(x, weights, axis=0, mode="mirror"), weights, axis=1, mode="mirror")

    ma, mb = blur(a), blur(b)
    va, vb, cov = blur(a * a) - ma**2, blur(b * b) - mb**2, blur(a * b) - ma * mb
    similarity = (2 * ma * mb + 1e-4) * (2 * cov + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4))
    assert metrics.ssim(a, b) == pytest.approx(similarity.mean(), abs=1e-6)
    assert metrics.ssim(a, b, half_mask()) == pytest.approx(similarity[:, :28].mean(), abs=1e-6)
    assert metrics.ssim(a, a) == pytest.approx(1)


def test_angular_error_of_known_rotations():
    a = generator(0, "normals").normal(size=(6, 7, 3))
    a /= np.linalg.norm(a, axis=-1, keepdims=True)
    across = np.cross(a, generator(1, "axis").normal(size=3))
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    for degrees in (0.0, 1e-4, 5.0, 90.0, 179.0):
        t = np.radians(degrees)
        b = 3 * (np.cos(t) * a + np.sin(t) * across)  # length must not matter
        assert metrics.angular_error_deg(a, b) == pytest.approx(degrees, rel=1e-6, abs=1e-9)
    assert metrics.angular_error_deg(a, -a) == pytest.approx(180)
    assert metrics.angular_error_deg(a, 0 * a) == pytest.approx(90)


def test_scaling_recovers_known_factors_whatever_lies_outside_the_mask():
    truth, _ = pair()
    factors = np.array([0.5, 2.0, 1.25])
    prediction = np.where(half_mask()[..., None], truth / factors, 7.0)
    for method in ("least_squares", "median_ratio"):
        scaled = metrics.scale_albedo(prediction, truth, half_mask(), method)
        np.testing.assert_allclose(scaled[:, :28], truth[:, :28], rtol=1e-5)
        np.testing.assert_allclose(scaled[:, 28:], 7 * np.broadcast_to(factors, (40, 28, 3)), rtol=1e-5)


def test_least_squares_is_the_best_factor_and_the_median_shrugs_off_outliers():
    truth, prediction = pair()
    best = metrics.psnr(metrics.scale_albedo(prediction, truth), truth)
    for factor in (0.9, 0.99, 1.01, 1.1):
        assert metrics.psnr(factor * metrics.scale_albedo(prediction, truth), truth) < best
    spoiled = truth.copy()
    spoiled[:4] = 50
    np.testing.assert_allclose(metrics.scale_albedo(truth, spoiled, method="median_ratio"), truth, rtol=1e-5)


def test_black_prediction_stays_black():
    truth, _ = pair()
    for method in ("least_squares", "median_ratio"):
        assert (metrics.scale_albedo(0 * truth, truth, method=method) == 0).all()


def test_empty_masks_and_different_shapes_are_refused():
    a, b = pair()
    nothing = np.zeros((40, 56), bool)
    for metric in (metrics.psnr, metrics.ssim, metrics.angular_error_deg, metrics.scale_albedo):
        with pytest.raises(TronError, match="selects no pixel"):
            metric(a, b, nothing)
        with pytest.raises(ValueError, match="shape"):
            metric(a, b[:-1])
    with pytest.raises(TronError, match="at least 6"):
        metrics.ssim(a[:5], b[:5])


def image_batch() -> tuple[torch.Tensor, torch.Tensor]:
    rng = generator(0, "lpips")
    a = rng.uniform(-1, 1, (2, 3, 40, 56))
    b = np.clip(a + 0.3 * rng.normal(size=a.shape), -1, 1)
    return torch.from_numpy(a).float(), torch.from_numpy(b).float()


def test_lpips_agrees_with_torchmetrics_on_the_same_random_backbone(
    random_vgg: Path, vgg16_features: Callable[[], torch.nn.Sequential], monkeypatch: pytest.MonkeyPatch
):
    import torchmetrics.functional.image.lpips as theirs

    def same_backbone(net: str, pretrained: bool = False) -> torch.nn.Sequential:
        features = vgg16_features()
        state = torch.load(random_vgg, weights_only=True)
        features.load_state_dict({k[9:]: v for k, v in state.items() if k.startswith("features.")})
        return features

    monkeypatch.setattr(theirs, "_get_tv_model_features", same_backbone)
    witness = theirs._LPIPS(net="vgg", pnet_rand=True)
    a, b = image_batch()
    ours = metrics.LPIPS.load(random_vgg)(a, b)
    assert ours.shape == (2,)
    assert ours.min() > 0
    torch.testing.assert_close(ours, witness(a, b).flatten(), rtol=1e-5, atol=1e-6)


def test_lpips_is_zero_at_identity_symmetric_and_differentiable(random_vgg: Path):
    lpips = metrics.LPIPS.load(random_vgg)
    a, b = image_batch()
    torch.testing.assert_close(lpips(a, b), lpips(b, a))
    same = a.clone().requires_grad_()
    distance = lpips(same, a)
    assert distance.abs().max() == 0
    distance.sum().backward()
    assert same.grad is not None
    assert torch.isfinite(same.grad).all()
    moved = b.clone().requires_grad_()
    before = lpips(moved, a).sum()
    before.backward()
    assert moved.grad is not None
    step = 1e-3 * moved.grad / moved.grad.abs().mean()
    assert lpips(b - step, a).sum() < before


def test_lpips_keeps_its_weights_out_of_modules(random_vgg: Path):
    class Model(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.lpips: Any = metrics.LPIPS.load(random_vgg)

    module = Model()
    assert not list(module.parameters())
    assert not module.state_dict()


def test_lpips_without_its_weights_says_what_to_fetch(tmp_path: Path):
    with pytest.raises(TronError, match=r"VGG-16.*vgg16-397923af\.pth"):
        metrics.LPIPS.load(tmp_path / "absent.pth")


@pytest.mark.parametrize("content", [b"", b"text", b"\x80\x02cposix\nsystem\n(S'touch owned'\ntR."])
def test_lpips_refuses_other_files_without_running_them(tmp_path: Path, content: bytes):
    (tmp_path / "vgg.pth").write_bytes(content)
    with pytest.raises(TronError, match="not torchvision's"):
        metrics.LPIPS.load(tmp_path / "vgg.pth")
    assert not (Path.cwd() / "owned").exists()


def test_lpips_refuses_a_checkpoint_of_something_else(tmp_path: Path):
    torch.save({"weight": torch.zeros(3)}, tmp_path / "other.pth")
    with pytest.raises(TronError, match="not torchvision's"):
        metrics.LPIPS.load(tmp_path / "other.pth")


def test_lpips_refuses_images_too_small_for_its_poolings(random_vgg: Path):
    with pytest.raises(ValueError, match="16"):
        metrics.LPIPS.load(random_vgg)(torch.zeros(1, 3, 15, 40), torch.zeros(1, 3, 15, 40))
