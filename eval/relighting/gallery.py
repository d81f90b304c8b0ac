"""Side-by-side pictures of held-out frames: methods against the truth, the guidance against its own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from eval.relighting.shadows import MEMBERS as SHADOW_MEMBERS
from eval.relighting.shadows import direct_light, same_depth, shadow_errors
from eval.report.page import Picture, Pictures
from tron import metrics
from tron.color import linear_to_srgb, luminance, to_display
from tron.shards.schema import Clip, ClipMeta

METHOD_TITLES = {
    "pbr": "pbr",
    "irradiance": "irradiance",
    "shadow_ratio": "shadow_ratio",
    "affine_ratio": "affine_ratio",
    "pixel_mlp": "pixel_mlp",
    "neural": "neural renderer",
}
METHOD_ALTS = {
    "pbr": "split-sum shading of the surfels without shadows",
    "irradiance": "light arriving at each surface, with shadows, as a white surface would show it",
    "shadow_ratio": "pbr darkened by the share of light that arrives",
    "affine_ratio": "best linear blend of pbr, irradiance and shadow_ratio",
    "pixel_mlp": "a network that sees one pixel at a time",
    "neural": "the neural renderer's image",
}
ERROR_GAIN = 3


@dataclass(frozen=True)
class Shown:
    """The middle frame of a clip, display values (H, W, 3): by every method, the truth, and the guidance
    pictures.

    ``psnr`` holds dB on the foreground of these very pictures; ``guidance`` is empty without references.
    """

    meta: ClipMeta
    frame: int
    methods: dict[str, np.ndarray]
    truth: np.ndarray
    psnr: dict[str, float]
    guidance: dict[str, np.ndarray]

    @property
    def title(self) -> str:
        """Scene, light and frame in words."""
        name = self.meta.light.removeprefix(f"{self.meta.scene}-")
        light = name if name.startswith(self.meta.light_family) else f"{name} ({self.meta.light_family})"
        return f"Scene {self.meta.scene} · light {light} · frame {self.frame + 1} of {self.meta.frames}"


def middle_frame(clip: Clip, shown: dict[str, np.ndarray], truth: np.ndarray) -> Shown:
    """Take the middle frame of a clip's predictions (method -> (K, H, W, 3)) and of its truth."""
    k = clip.meta.frames // 2
    frames, exposure = clip.frames, clip.meta.exposure
    methods = {name: images[k] for name, images in shown.items()}
    methods["irradiance"] = to_display(frames["irradiance"][k], exposure)
    foreground = frames["foreground"][k, ..., 0] > 0.5
    where = foreground if foreground.any() else None
    psnr = {
        name: metrics.capped_psnr(image, truth[k], where)
        for name, image in methods.items()
        if name != "irradiance"
    }
    return Shown(clip.meta, k, methods, truth[k], psnr, _guidance_pictures(clip, k))


def _guidance_pictures(clip: Clip, k: int) -> dict[str, np.ndarray]:
    frames = {name: images[k] for name, images in clip.frames.items()}
    if not {"irradiance_ref", "base_color", "base_color_ref", "normal", "normal_ref"} <= frames.keys():
        return {}
    foreground = frames["foreground"] > 0.5
    ours, truth = (
        np.where(foreground, to_display(frames[name], clip.meta.exposure), 0)
        for name in ("irradiance", "irradiance_ref")
    )
    pictures = {
        "irradiance, surfels": ours,
        "irradiance, path-traced": truth,
        f"difference ×{ERROR_GAIN}": np.clip(np.abs(ours - truth) * ERROR_GAIN, 0, 1),
    }
    if set(SHADOW_MEMBERS) <= frames.keys():
        pictures["shadow errors"] = _shadow_error_picture(frames, truth)
    for name, title in (("base_color", "base color"), ("normal", "normals")):
        for member, whose in ((name, "surfels"), (f"{name}_ref", "true")):
            image = frames[member]
            if name == "base_color":
                picture = linear_to_srgb(np.clip(image, 0, 1))
            else:
                picture = np.where(np.linalg.norm(image, axis=-1, keepdims=True) > 0.5, image / 2 + 0.5, 0)
            pictures[f"{title}, {whose}"] = np.clip(np.where(foreground, picture, 0), 0, 1)
    return pictures


def _shadow_error_picture(frames: dict[str, np.ndarray], truth: np.ndarray) -> np.ndarray:
    """The true irradiance in faint grey, leaking pixels orange, darkened pixels blue."""
    leaking, darkened = shadow_errors(frames["irradiance"], direct_light(frames), same_depth(frames))
    picture = np.repeat(luminance(truth)[..., None] * 0.6, 3, axis=-1)
    picture[leaking] = (1.0, 0.5, 0.05)
    picture[darkened] = (0.2, 0.6, 1.0)
    return picture


def comparison(shown: Shown) -> Pictures:
    """pbr, irradiance, the strongest baselines, the neural renderer, the truth and the error of the neural
    one.
    """
    pictures = []
    where = f"scene {shown.meta.scene} under light {shown.meta.light}"
    for name, title in METHOD_TITLES.items():
        if name in shown.methods:
            figure = f"{shown.psnr[name]:.1f} dB" if name in shown.psnr else ""
            alt = f"{METHOD_ALTS[name]}, {where}"
            pictures.append(Picture(shown.methods[name], title, alt, figure, strong=name == "neural"))
    pictures.append(Picture(shown.truth, "path-traced truth", f"path-traced ground truth, {where}"))
    judged_name = "neural" if "neural" in shown.methods else "pbr"
    error = np.clip(np.abs(shown.methods[judged_name] - shown.truth) * ERROR_GAIN, 0, 1)
    title = f"|{METHOD_TITLES[judged_name]} − truth| ×{ERROR_GAIN}"
    pictures.append(Picture(error, title, f"absolute error of {judged_name} times {ERROR_GAIN}, {where}"))
    return Pictures(shown.title, pictures)


def guidance(shown: Shown) -> Pictures:
    """Irradiance, its reference and errors; base color and normals of the surfels beside the true ones."""
    where = f"scene {shown.meta.scene} under light {shown.meta.light}"
    pictures = [Picture(image, name, f"{name}, {where}") for name, image in shown.guidance.items()]
    return Pictures(shown.title, pictures)
