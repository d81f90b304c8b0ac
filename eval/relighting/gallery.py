"""Side-by-side pictures of held-out frames: methods and the truth, guidance and true guidance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from eval.relighting.baselines import (
    BASELINES,
    FINER,
    NETWORKS,
    NEURAL,
    NEURAL_LIT,
    ON_LIT,
    Method,
)
from eval.relighting.shadows import frame_shadow_pixels, same_depth
from tron import metrics
from tron.color import linear_to_srgb, luminance, to_display
from tron.report.page import Picture, Pictures
from tron.shards.schema import Clip, ClipMeta

ERROR_GAIN = 3
LIT = next(baseline for baseline in BASELINES if baseline.name == "lit")
PICTURED: list[Method] = [
    *(each for each in BASELINES if each.pictured and each is not LIT and ON_LIT not in each.groups),
    NEURAL,
    *(each for each in BASELINES if each.pictured and ON_LIT in each.groups),
    FINER[-1],
    LIT,
    NEURAL_LIT,
]
"""Methods among the pictures, from the left; lit and the network that starts from it come last."""

IRRADIANCE = "light arriving at each surface, with shadows, as a white surface would show it"


@dataclass(frozen=True)
class Example:
    """The middle frame of a clip, display values (H, W, 3).

    Attributes:
        meta: metadata of the clip.
        frame: number of the frame.
        methods: method name -> its picture.
        irradiance: irradiance in display values.
        truth: the path-traced picture.
        psnr: method name -> dB on the foreground of this picture.
        guidance: title -> picture of the guidance or its error; empty without references.
    """

    meta: ClipMeta
    frame: int
    methods: dict[str, np.ndarray]
    irradiance: np.ndarray
    truth: np.ndarray
    psnr: dict[str, float]
    guidance: dict[str, np.ndarray]

    @property
    def title(self) -> str:
        """Scene, light and frame in words."""
        name = self.meta.light.removeprefix(f"{self.meta.scene}-")
        light = name if name.startswith(self.meta.light_family) else f"{name} ({self.meta.light_family})"
        return f"Scene {self.meta.scene} · light {light} · frame {self.frame + 1} of {self.meta.frames}"


def middle_frame(clip: Clip, shown: dict[str, np.ndarray], truth: np.ndarray) -> Example:
    """Return the middle frame of a clip's predictions (method -> (K, H, W, 3)) and of its truth."""
    k = clip.meta.frames // 2
    methods = {name: images[k] for name, images in shown.items()}
    foreground = clip.frames["foreground"][k, ..., 0] > 0.5
    where = foreground if foreground.any() else None
    psnr = {name: metrics.capped_psnr(image, truth[k], where) for name, image in methods.items()}
    irradiance = clip.displayed("irradiance")[k]
    return Example(clip.meta, k, methods, irradiance, truth[k], psnr, _guidance_pictures(clip, k))


def _guidance_pictures(clip: Clip, k: int) -> dict[str, np.ndarray]:
    if not clip.has_reference:
        return {}
    frame = {name: images[k] for name, images in clip.frames.items()}
    foreground = frame["foreground"] > 0.5
    ours, truth = (to_display(frame[f"irradiance{of}"], clip.meta.exposure) for of in ("", "_ref"))
    pictures = {
        "irradiance, surfels": ours,
        "irradiance, path-traced": truth,
        f"difference ×{ERROR_GAIN}": np.clip(np.abs(ours - truth) * ERROR_GAIN, 0, 1),
        "shadow errors": _shadow_errors(frame, np.where(foreground, truth, 0)),
    }
    for of, whose in (("", "surfels"), ("_ref", "true")):
        pictures[f"base color, {whose}"] = linear_to_srgb(np.clip(frame[f"base_color{of}"], 0, 1))
    for of, whose in (("", "surfels"), ("_ref", "true")):
        normal = frame[f"normal{of}"]
        there = np.linalg.norm(normal, axis=-1, keepdims=True) > 0.5
        pictures[f"normals, {whose}"] = np.where(there, np.clip(normal / 2 + 0.5, 0, 1), 0)
    return {
        title: image if title == "shadow errors" else np.where(foreground, image, 0)
        for title, image in pictures.items()
    }


def _shadow_errors(frame: dict[str, np.ndarray], truth: np.ndarray) -> np.ndarray:
    """Draw the true irradiance in faint grey, leaking pixels orange, darkened pixels blue."""
    found = frame_shadow_pixels(frame, same_depth(frame))
    picture = np.repeat(luminance(truth)[..., None] * 0.6, 3, axis=-1)
    picture[found.leaking] = (1.0, 0.5, 0.05)
    picture[found.darkened] = (0.2, 0.6, 1.0)
    return picture


def comparison(example: Example) -> Pictures:
    """Show guidance and methods beside the truth, and errors of lit and of the network."""
    where = f"scene {example.meta.scene} under light {example.meta.light}"
    shown = [method for method in PICTURED if method.name in example.methods]
    network = next((method for method in NETWORKS if method in shown), None)
    shown.sort(key=lambda method: method is network)
    judged = shown[-1]

    def picture(method: Method) -> Picture:
        image, figure = example.methods[method.name], f"{example.psnr[method.name]:.1f} dB"
        return Picture(image, method.title, f"{method.what}, {where}", figure, strong=method is judged)

    def error(method: Method) -> Picture:
        image = np.clip(np.abs(example.methods[method.name] - example.truth) * ERROR_GAIN, 0, 1)
        alt = f"absolute error of the {method.title} times {ERROR_GAIN}, {where}"
        return Picture(image, f"|{method.title} − truth| ×{ERROR_GAIN}", alt)

    pictures = [picture(method) for method in shown]
    pictures.insert(1, Picture(example.irradiance, "irradiance", f"{IRRADIANCE}, {where}"))
    if judged in NETWORKS and LIT in shown:
        pictures.insert(shown.index(LIT) + 1, error(LIT))
    truth = Picture(example.truth, "path-traced truth", f"path-traced ground truth, {where}")
    return Pictures(example.title, [*pictures, truth, error(judged)])


def opening(example: Example) -> Pictures:
    """Show lit, the network and the truth of one frame on the first screen; pbr if there is no network."""
    whole = comparison(example).pictures
    network = next((method for method in NETWORKS if method.name in example.methods), None)
    titles = [LIT.title if network else "pbr", network.title if network else LIT.title, "path-traced truth"]
    shown = [picture for title in titles for picture in whole if picture.title == title]
    return Pictures(example.title, shown, columns=len(shown))


def guidance(example: Example) -> Pictures:
    """Show irradiance, its reference and errors; base color and normals beside the true ones."""
    where = f"scene {example.meta.scene} under light {example.meta.light}"
    pictures = [Picture(image, name, f"{name}, {where}") for name, image in example.guidance.items()]
    return Pictures(example.title, pictures)
