"""Image and G-buffer metrics: PSNR, SSIM, LPIPS, angular error of normals, albedo scaling.

Arrays are NumPy, images (H, W, 3) of display values in [0, 1] unless said otherwise, masks (H, W) bool with
True for the pixels that count. torch and torchmetrics are imported only by SSIM and LPIPS.
"""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from tron.errors import TronError

if TYPE_CHECKING:
    import torch

PSNR_CAP = 100.0
"""dB that a picture without any error counts as in means and files; float32 pictures hold no more."""


def psnr(a: np.ndarray, b: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Peak signal-to-noise ratio in dB for peak 1, over all channels of the pixels in the mask; inf if equal.

    Raises:
        TronError: the mask selects nothing.
        ValueError: shapes differ.
    """
    _same_shape(a, b)
    error = _selected((np.asarray(a, np.float64) - np.asarray(b, np.float64)) ** 2, mask).mean()
    return float("inf") if error == 0 else float(-10 * np.log10(error))


def capped_psnr(a: np.ndarray, b: np.ndarray, mask: np.ndarray | None = None) -> float:
    """:func:`psnr`, at most PSNR_CAP: finite, so that it can be averaged and written as JSON."""
    return min(psnr(a, b, mask), PSNR_CAP)


def ssim(a: np.ndarray, b: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Structural similarity (Wang et al. 2004): Gaussian window of 11 pixels, sigma 1.5, mean over channels.

    With a mask, the similarity map of the whole image is averaged over the mask, as windows need neighbours.

    Raises:
        TronError: the mask selects nothing, or the image is smaller than half the window (6 pixels).
        ValueError: shapes differ.
    """
    _same_shape(a, b)
    if min(a.shape[:2]) < 6:
        raise TronError(f"SSIM needs images of at least 6 x 6 pixels, not {a.shape[1]} x {a.shape[0]}")
    import torch
    from torchmetrics.functional.image import structural_similarity_index_measure

    # In float64 the same convolutions take 25 times as long, and the mean differs by less than 1e-6.
    first, second = (torch.from_numpy(np.asarray(x, np.float32)).movedim(-1, 0)[None] for x in (a, b))
    _, image = structural_similarity_index_measure(first, second, data_range=1.0, return_full_image=True)
    similarity = image[0].movedim(0, -1).numpy()
    return float(_selected(similarity, mask).mean())


def angular_error_deg(a: np.ndarray, b: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Mean of :func:`angular_errors_deg`."""
    return float(angular_errors_deg(a, b, mask).mean())


def angular_errors_deg(a: np.ndarray, b: np.ndarray, mask: np.ndarray | None = None) -> np.ndarray:
    """Angles in degrees between two normal maps (H, W, 3) of any length; a zero vector counts as 90.

    Returns:
        (N,) float64, of the N pixels that the mask selects, row by row.

    Raises:
        TronError: the mask selects nothing.
        ValueError: shapes differ.
    """
    _same_shape(a, b)
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    # The arc tangent is exact for small angles, where the arc cosine loses half its digits.
    angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(axis=-1))
    missing = ~(a.any(axis=-1) & b.any(axis=-1))
    return np.degrees(_selected(np.where(missing, np.pi / 2, angle), mask)).ravel()


def scale_albedo(
    prediction: np.ndarray,
    truth: np.ndarray,
    mask: np.ndarray | None = None,
    method: Literal["least_squares", "median_ratio"] = "least_squares",
) -> np.ndarray:
    """Predicted albedo scaled to the truth by ``albedo_scale``: (..., 3) float32, not clipped."""
    return (prediction * albedo_scale(prediction, truth, mask, method)).astype(np.float32)


def albedo_scale(
    prediction: np.ndarray,
    truth: np.ndarray,
    mask: np.ndarray | None = None,
    method: Literal["least_squares", "median_ratio"] = "least_squares",
) -> np.ndarray:
    """Factors (3,) that bring a predicted albedo to the truth: reflectance is known only up to them.

    Papers disagree, and the figures differ: TRON fits by least squares for each view (call once a view),
    TensoIR, GS-IR and IRGS take the median ratio of all views together (call once with the views stacked).

    Args:
        prediction, truth: (..., 3) linear.
        mask: (...) bool, pixels that are fitted.
        method: ``least_squares`` minimises the squared error, ``median_ratio`` is the median of truth /
            prediction where the prediction exceeds 1e-6.

    Raises:
        TronError: the mask selects nothing.
        ValueError: shapes differ.
    """
    _same_shape(prediction, truth)
    p = _selected(np.asarray(prediction, np.float64), mask).reshape(-1, prediction.shape[-1])
    t = _selected(np.asarray(truth, np.float64), mask).reshape(p.shape)
    if method == "least_squares":
        energy = (p * p).sum(axis=0)
        return np.where(energy > 0, (p * t).sum(axis=0) / np.where(energy > 0, energy, 1), 1.0)
    ratios = [tc[pc > 1e-6] / pc[pc > 1e-6] for pc, tc in zip(p.T, t.T)]
    return np.array([np.median(ratio) if ratio.size else 1.0 for ratio in ratios])


def _same_shape(a: np.ndarray, b: np.ndarray) -> None:
    if a.shape != b.shape or a.shape[-1] != 3:
        raise ValueError(f"arrays must have one shape (..., 3), not {a.shape} and {b.shape}")


def _selected(values: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    if mask is None:
        return values
    if not mask.any():
        raise TronError("the mask of a metric selects no pixel")
    return values[mask.astype(bool)]


class LPIPS:
    """Learned perceptual distance (Zhang et al. 2018, version 0.1) with the VGG-16 backbone, differentiable.

    ``lpips(a, b)`` takes torch images (B, 3, H, W) scaled to [-1, 1] and gives (B,) distances, on the device
    and in the precision of ``a``. It is a plain object rather than a module on purpose: its frozen 15 million
    weights must stay out of a model's parameters, checkpoints and moving averages.
    """

    # Places in torchvision's vgg16.features.
    _CONVOLUTIONS = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)
    _AFTER_POOLING = (5, 10, 17, 24)
    _TAPS = (2, 7, 14, 21, 28)  # compared after their ReLU
    _CHANNELS = (64, 128, 256, 512, 512)  # at the taps
    _SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)

    def __init__(self, backbone: dict[str, torch.Tensor], linear: dict[str, torch.Tensor]):
        """Take torchvision's VGG-16 state dict and the linear layers' as torchmetrics ships them."""
        names = [f"features.{i}.{kind}" for i in self._CONVOLUTIONS for kind in ("weight", "bias")]
        self._weights = {name: backbone[name].detach() for name in names}
        for k, channels in enumerate(self._CHANNELS):
            self._weights[f"linear{k}"] = linear[f"lin{k}.model.1.weight"].detach().reshape(1, channels, 1, 1)

    @classmethod
    def load(cls, vgg_weights: str | os.PathLike[str]) -> LPIPS:
        """Read the backbone from a local ``vgg16-397923af.pth``; the linear layers come with torchmetrics.

        Nothing is downloaded and nothing in the file is executed.

        Raises:
            TronError: the file is missing, or not torchvision's VGG-16.
        """
        import torch

        path = Path(vgg_weights)
        if not path.is_file():
            raise TronError(
                "LPIPS needs the VGG-16 weights, and the file is missing",
                path,
                "fetch https://download.pytorch.org/models/vgg16-397923af.pth and give its path",
            )
        try:
            backbone = torch.load(path, map_location="cpu", weights_only=True)
            return cls(backbone, torch.load(_linear_weights(), map_location="cpu", weights_only=True))
        except Exception as error:  # torch's reader meets other files with errors of every type
            raise TronError(
                "not torchvision's VGG-16 weights", path, "the file is named vgg16-397923af.pth"
            ) from error

    def __call__(self, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        """Distances (B,) between images (B, 3, H, W) in [-1, 1]; H and W at least 16.

        Raises:
            ValueError: shapes differ, or images are too small for the backbone's four poolings.
        """
        if a.shape != b.shape or a.ndim != 4 or a.shape[1] != 3 or min(a.shape[2:]) < 16:
            raise ValueError(f"LPIPS needs two (B, 3, H, W) with H, W >= 16, not {a.shape} and {b.shape}")
        from torch.nn.functional import conv2d

        self._weights = {name: w.to(a.device, a.dtype) for name, w in self._weights.items()}
        distance: Any = 0.0
        for k, (fa, fb) in enumerate(zip(self._features(a), self._features(b))):
            difference = (_normalized(fa) - _normalized(fb)).square()
            distance = distance + conv2d(difference, self._weights[f"linear{k}"]).mean(dim=(1, 2, 3))
        return distance

    def _features(self, x: torch.Tensor) -> list[torch.Tensor]:
        from torch.nn.functional import conv2d, max_pool2d, relu

        x = (x - x.new_tensor(self._SHIFT).view(1, 3, 1, 1)) / x.new_tensor(self._SCALE).view(1, 3, 1, 1)
        taps = []
        for i in self._CONVOLUTIONS:
            if i in self._AFTER_POOLING:
                x = max_pool2d(x, 2)
            name = f"features.{i}"
            x = relu(conv2d(x, self._weights[f"{name}.weight"], self._weights[f"{name}.bias"], padding=1))
            if i in self._TAPS:
                taps.append(x)
        return taps


def _normalized(features: torch.Tensor) -> torch.Tensor:
    return features / (1e-8 + features.square().sum(dim=1, keepdim=True)).sqrt()


def _linear_weights() -> Path:
    spec = importlib.util.find_spec("torchmetrics")
    if spec is None or spec.origin is None:
        raise TronError("LPIPS needs torchmetrics", mend="pip install 'tron-relight[train]'")
    return Path(spec.origin).parent / "functional" / "image" / "lpips_models" / "vgg.pth"
