"""Scores of a reconstruction: its pictures against photos, its maps against the truth where there is any.

Pictures are compared over the whole frame, with the training background behind the subject, and on the
subject if views have masks. Pixels excluded by a view's ``valid`` do not count (SSIM and LPIPS, which use
neighbourhoods, see the true picture there). Base color is known up to a factor: it is scaled for each view
and channel by least squares on the subject, as in the TRON paper (conventions.md, 11).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from tron.cameras import Camera
from tron.captures import View
from tron.gaussians.scene import GaussianScene
from tron.metrics import LPIPS, angular_errors_deg, capped_psnr, scale_albedo, ssim
from tron.reconstruction.progress import Track, untracked
from tron.tracing import GBuffer

LOOKS = ("psnr", "ssim", "lpips", "psnr_subject")
"""Figures of pictures only, not of maps."""
_SUBJECT = 0.5
BACKGROUND = {"black": 0.0, "white": 1.0, "random": 0.0}
_LPIPS_LEAST_SIDE = 16


@dataclass(frozen=True)
class ViewScore:
    """Figures of one view.

    Attributes:
        view: its name.
        figures: by name, such as ``psnr`` (dB), ``ssim``, ``normal_mae_deg``; those that are not there could
            not be measured.
    """

    view: str
    figures: Mapping[str, float]


class Seen(Protocol):
    """Renders the G-buffer of surfels: a tracer, or a Relighter, which orients surfels without a sign."""

    @property
    def scene(self) -> GaussianScene: ...

    def gbuffer(self, camera: Camera) -> GBuffer: ...


def score_views(
    tracer: Seen,
    views: Sequence[View],
    background: str = "black",
    lpips: LPIPS | None = None,
    track: Track = untracked,
) -> list[ViewScore]:
    """Score what the surfels show from each view.

    Figures: ``psnr``, ``ssim``, ``lpips`` of the whole frame; ``psnr_subject`` where the view has a mask;
    ``normal_mae_deg``, ``normal_median_deg``, ``base_color_psnr`` (linear, scaled), ``roughness_mae``,
    ``metallic_mae``, ``metallic_wrong`` (share of pixels on the wrong side of a half) where the view has the
    truth, over its subject. All are finite: a PSNR is at most
    PSNR_CAP of :mod:`tron.metrics`.

    Args:
        tracer: the surfels.
        views: display images.
        background: as trained with; random is judged on black.
        lpips: the metric, where its weights are given.
        track: shows progress.
    """
    scores = []
    for view in track(views, "scores"):
        buffers = tracer.gbuffer(view.camera).numpy()
        scores.append(ViewScore(view.name, dict(_figures(buffers, view, BACKGROUND[background], lpips))))
    return scores


def mean_figures(scores: Sequence[ViewScore]) -> dict[str, float]:
    """Mean of each figure over the views that have it, and their number as ``views``."""
    names = dict.fromkeys(name for score in scores for name in score.figures)
    means = {
        name: float(np.mean([score.figures[name] for score in scores if name in score.figures]))
        for name in names
    }
    return {"views": len(scores), **means}


def picture(buffers: Mapping[str, np.ndarray], behind: float = 0.0) -> np.ndarray:
    """(H, W, 3) display values in [0, 1]: the surfels' radiance over a grey of this brightness."""
    return np.clip(buffers["rgb"] + (1 - buffers["opacity"][..., None]) * behind, 0, 1)


def wanted_picture(view: View, behind: float = 0.0) -> np.ndarray:
    """(H, W, 3) display values: the view's image, its subject alone where it has a mask."""
    image = view.read("image")
    if not view.has("mask"):
        return image
    mask = view.read("mask")[..., None]
    return mask * image + (1 - mask) * np.float32(behind)


def _figures(
    buffers: Mapping[str, np.ndarray], view: View, behind: float, lpips: LPIPS | None
) -> Iterator[tuple[str, float]]:
    rendered, wanted, believed = picture(buffers, behind), wanted_picture(view, behind), view.believed()
    if not believed.any():
        return
    yield "psnr", capped_psnr(rendered, wanted, believed)
    rendered = np.where(believed[..., None], rendered, wanted)
    if min(rendered.shape[:2]) >= 6:
        yield "ssim", ssim(rendered, wanted)
    if lpips is not None and min(rendered.shape[:2]) >= _LPIPS_LEAST_SIDE:
        yield "lpips", _distance(lpips, rendered, wanted)
    subject = view.read("mask") > _SUBJECT if view.has("mask") else np.ones(rendered.shape[:2], bool)
    subject &= believed
    if not subject.any():
        return
    if view.has("mask"):
        yield "psnr_subject", capped_psnr(rendered, wanted, subject)
    if view.has("normal"):
        normal = view.read("normal")
        known = subject & normal.any(axis=-1)
        if known.any():
            angles = angular_errors_deg(buffers["normal"], normal, known)
            yield "normal_mae_deg", float(angles.mean())
            yield "normal_median_deg", float(np.median(angles))
    if view.has("base_color"):
        truth = view.read("base_color")
        scaled = scale_albedo(buffers["base_color"], truth, subject)
        yield "base_color_psnr", capped_psnr(np.clip(scaled, 0, 1), truth, subject)
    for name in ("roughness", "metallic"):
        if view.has(name):
            yield f"{name}_mae", float(np.abs(buffers[name] - view.read(name))[subject].mean())
    if view.has("metallic"):
        wrong = (buffers["metallic"] > 0.5) != (view.read("metallic") > 0.5)
        yield "metallic_wrong", float(wrong[subject].mean())


def _distance(lpips: LPIPS, rendered: np.ndarray, wanted: np.ndarray) -> float:
    import torch

    pair = [torch.from_numpy(2 * np.float32(image) - 1).movedim(-1, 0)[None] for image in (rendered, wanted)]
    with torch.no_grad():
        return float(lpips(*pair)[0])
