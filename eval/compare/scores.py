"""Score a method's folder on a suite: every picture against the truth, and every fault by name.

Pictures are judged in display values: the suite's exposure and tone curve apply, as :func:`shown` does for
each of three colour spaces. Figures are over the foreground, pixels that surfaces cover fully; if method and
suite have the same environment behind it, also over the whole frame. For all other methods, metrics that
look at neighbours (SSIM, FLIP, LPIPS) see the truth around the foreground.

A scene with any faulty picture has no figures at all: a mean over the remaining pictures would favour methods
that leave out hard ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from eval.light_scale import COVERED, fitted_factor
from eval.protocol.method import Method, MethodFolder, write_method
from eval.protocol.pictures import Fault
from eval.protocol.suite import Suite, SuiteScene
from eval.relighting.flip import INSTALLED, flip
from eval.relighting.scores import METRICS
from tron.color import linear_to_srgb, srgb_to_linear
from tron.errors import TronError
from tron.metrics import LPIPS, albedo_scale, angular_errors_deg, capped_psnr, ssim

LPIPS_LEAST_SIDE = 16
TOLERANCE = 1e-6
"""Within which a figure is the same, in its unit."""
SWAPPED = 0.5
"""Normals whose mean error in another frame is below this share of that in their own are in another frame."""


@dataclass(frozen=True)
class FrameScore:
    """Figures of one picture; names that end in ``_full`` are over the whole frame."""

    scene: str
    kind: str
    light: str
    family: str
    frame: int
    figures: Mapping[str, float]


@dataclass(frozen=True)
class FoundFault:
    """A fault: its place, its kind, and a sentence about it."""

    scene: str
    what: str
    kind: str
    text: str


@dataclass
class Judged:
    """Scores and faults of a method.

    Attributes:
        frames: scores in the scenes whose relit pictures have no fault.
        maps: scene -> figures of MAP_MEASURES, means over views.
        factors: scene -> the factor on its light, of methods that ask for one.
        faults: in the suite's order.
        missing: maps that the suite could judge and the method lacks.
    """

    folder: MethodFolder
    frames: list[FrameScore] = field(default_factory=list)
    maps: dict[str, dict[str, float]] = field(default_factory=dict)
    factors: dict[str, float] = field(default_factory=dict)
    faults: list[FoundFault] = field(default_factory=list)
    missing: set[str] = field(default_factory=set)

    @property
    def name(self) -> str:
        """Name of the method in rows."""
        return self.folder.method.name

    @property
    def whole(self) -> set[str]:
        """Scenes with figures."""
        return {score.scene for score in self.frames}


Score = Callable[[np.ndarray, np.ndarray, np.ndarray | None], dict[str, float]]


def judged_lights(scene: SuiteScene) -> list[str]:
    """Return the lights of a scene with known truth."""
    return [name for name, light in scene.lights.items() if light.truth]


def foreground(scene: SuiteScene) -> np.ndarray:
    """(K, H, W) bool: pixels that show only surfaces; all pixels if the suite has no masks."""
    mask = scene.mask()
    if mask is None:
        return np.ones((scene.entry.frames, scene.size.height, scene.size.width), bool)
    return mask > COVERED


def judge_method(suite: Suite, folder: MethodFolder, lpips: LPIPS | None = None) -> Judged:
    """Read and score a method's folder, one scene in memory at a time."""
    found = Judged(folder)
    for scene in suite.scenes.values():
        inside = foreground(scene)
        _judge_lights(found, suite, scene, inside, lpips)
        for what in ("albedo", "normals"):
            if what in scene.entry.maps:
                _judge_map(found, scene, what, inside, lpips)
    return found


def _judge_lights(
    found: Judged, suite: Suite, scene: SuiteScene, inside: np.ndarray, lpips: LPIPS | None
) -> None:
    method, stored, before = found.folder.method, {}, len(found.faults)
    for light in judged_lights(scene):
        try:
            stored[light] = found.folder.frames(scene, light)
        except Fault as fault:
            found.faults.append(FoundFault(scene.name, light, fault.kind, str(fault)))
    if len(found.faults) > before:
        return
    truths = {light: scene.truth(light) for light in stored}
    factor = 1.0
    if method.scale == "scene":
        factor = found.factors[scene.name] = scene_factor(suite, scene, found.folder, stored, truths, inside)
    for light, frames in stored.items():
        of_light = scene.lights[light]
        true_light = truths[light] * np.float32(of_light.exposure)
        truth, linear = suite.display(true_light), None
        picture = shown(suite, found.folder, frames, of_light.exposure, factor)
        if method.color_space == "linear":
            linear = frames * np.float32(of_light.exposure * factor)
        same_behind = method.background == suite.file.background == "environment"
        for k, mask in enumerate(inside):
            image = picture[k] if same_behind else np.where(mask[..., None], picture[k], truth[k])
            figures = {}
            if mask.any():
                figures |= picture_figures(image, truth[k], mask, lpips)
                if linear is not None:
                    figures |= hdr_figures(linear[k], true_light[k], mask)
            if same_behind:
                whole = picture_figures(image, truth[k], None, lpips)
                figures |= {f"{name}_full": value for name, value in whole.items()}
            if figures:
                score = FrameScore(scene.name, scene.kind, light, of_light.family, k, figures)
                found.frames.append(score)


def shown(
    suite: Suite, folder: MethodFolder, frames: np.ndarray, exposure: float, factor: float = 1.0
) -> np.ndarray:
    """Return display pictures, (..., 3) float32: apply the suite's exposure, a factor and the tone curve."""
    match folder.method.color_space:
        case "display":
            return np.clip(frames, 0, 1)
        case "linear":
            return suite.display(frames * np.float32(exposure * factor))
        case "srgb":
            return suite.display(np.asarray(srgb_to_linear(np.clip(frames, 0, 1)), np.float32) * factor)


def scene_factor(
    suite: Suite,
    scene: SuiteScene,
    folder: MethodFolder,
    stored: Mapping[str, np.ndarray],
    truths: Mapping[str, np.ndarray],
    inside: np.ndarray,
) -> float:
    """Fit one factor on a method's radiance in a scene, over all lights: `eval.light_scale.fitted_factor`.

    Args:
        suite, scene, folder: whose pictures they are.
        stored: light -> pictures (K, H, W, 3) as the method stored them.
        truths: light -> true radiance.
        inside: (K, H, W) bool, pixels that count.
    """
    lights = []
    for light, frames in stored.items():
        exposure = scene.lights[light].exposure
        truth = suite.display(truths[light] * np.float32(exposure))
        if folder.method.color_space == "srgb":
            frames, exposure = np.asarray(srgb_to_linear(np.clip(frames, 0, 1)), np.float32), 1.0
        lights.append((frames, exposure, truth, inside))
    return fitted_factor(lights, suite.display)


def picture_figures(
    image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None, lpips: LPIPS | None
) -> dict[str, float]:
    """Score display values (H, W, 3) in [0, 1] on the pixels of ``mask`` (H, W); None: all pixels."""
    least = min(image.shape[:2])
    small = {"ssim"} if least < 6 else set()
    figures = {each.name: each.measure(image, truth, mask) for each in METRICS if each.name not in small}
    if lpips is not None and least >= LPIPS_LEAST_SIDE:
        figures["lpips"] = _lpips(lpips, image, truth)
    return figures


def hdr_figures(exposed: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> dict[str, float]:
    """HDR-FLIP of exposed linear radiance (H, W, 3) on a foreground; its median colour fills the rest.

    HDR-FLIP finds its range of exposures from the reference, where black surroundings would mislead it.
    """
    if not INSTALLED:
        return {}
    around = np.median(truth[mask], axis=0)
    if not around.max() > 0:
        return {}
    a, b = (np.where(mask[..., None], np.maximum(image, 0), around) for image in (exposed, truth))
    value = flip(a, b, mask, "HDR")
    return {"hdr_flip": value} if np.isfinite(value) else {}


def _lpips(lpips: LPIPS, image: np.ndarray, truth: np.ndarray) -> float:
    import torch

    pair = [torch.from_numpy(2 * np.float32(each) - 1).movedim(-1, 0)[None] for each in (image, truth)]
    with torch.no_grad():
        return float(lpips(*pair)[0])


def _judge_map(
    found: Judged,
    scene: SuiteScene,
    what: Literal["albedo", "normals"],
    inside: np.ndarray,
    lpips: LPIPS | None,
) -> None:
    try:
        given = found.folder.albedo(scene) if what == "albedo" else found.folder.normals(scene)
        if given is None:
            found.missing.add(what)
            return
        figures = (
            albedo_figures(given, _known(scene.albedo()), inside, lpips)
            if what == "albedo"
            else normal_figures(found.folder, scene, given, _known(scene.normals()), inside)
        )
    except Fault as fault:
        found.faults.append(FoundFault(scene.name, what, fault.kind, str(fault)))
        return
    found.maps.setdefault(scene.name, {}).update(figures)


def _known(maps: np.ndarray | None) -> np.ndarray:
    if maps is None:
        raise TronError("the suite lost a map that it names")
    return maps


def albedo_figures(
    given: np.ndarray, truth: np.ndarray, inside: np.ndarray, lpips: LPIPS | None = None
) -> dict[str, float]:
    """Score linear base color (K, H, W, 3) on the foreground under three scalings, as means over views.

    TRON scales each view and channel by least squares; TensoIR, GS-IR and IRGS scale each scene and channel
    by the median ratio; the third scaling is none. Scaled values are clipped to [0, 1].
    """
    views = [k for k, mask in enumerate(inside) if mask.any()]
    if not views:
        return {}
    median = albedo_scale(given, truth, inside, "median_ratio")
    found: dict[str, list[float]] = {}
    for k in views:
        mask, true = inside[k], truth[k]
        least = albedo_scale(given[k], true, mask)
        scaled = {"": least, "_median": median, "_unscaled": np.ones(3)}
        for tail, scale in scaled.items():
            image = np.clip(given[k] * scale, 0, 1).astype(np.float32)
            found.setdefault(f"albedo_psnr{tail}", []).append(capped_psnr(image, true, mask))
        image = np.where(mask[..., None], np.clip(given[k] * least, 0, 1), true)
        if min(mask.shape) >= 6:
            found.setdefault("albedo_ssim", []).append(ssim(image, true, mask))
        if lpips is not None and min(mask.shape) >= LPIPS_LEAST_SIDE:
            shown_pair = (linear_to_srgb(each).astype(np.float32) for each in (image, true))
            found.setdefault("albedo_lpips", []).append(_lpips(lpips, *shown_pair))
    return {name: float(np.mean(values)) for name, values in found.items()}


def normal_figures(
    folder: MethodFolder, scene: SuiteScene, given: np.ndarray, truth: np.ndarray, inside: np.ndarray
) -> dict[str, float]:
    """Angular errors of world normals (K, H, W, 3) where the foreground has a true normal, degrees.

    Angles do not depend on the frame once both normals are in one frame. Normals that fit far better in a
    frame other than the method's declared one are a fault: the figure would measure that mistake.
    """
    where = inside & truth.any(axis=-1)
    if not where.any():
        return {}
    angles = angular_errors_deg(given, truth, where)
    for other in ("world", "opencv", "opengl"):
        if other == folder.method.normals:
            continue
        read = folder.normals(scene, other)
        if read is not None and angular_errors_deg(read, truth, where).mean() < SWAPPED * angles.mean():
            what = f"normals are said to be of frame {folder.method.normals}, and are far nearer in {other}"
            raise Fault("wrong_frame", what, folder.folder / scene.name, f"say normals: {other}")
    return {"normal_mae_deg": float(angles.mean()), "normal_median_deg": float(np.median(angles))}


def identical_share(suite: Suite, found: Judged, folder: Path) -> float | None:
    """Share of a method's figures that stay when its display pictures of a scene are judged again as display.

    Args:
        folder: empty folder for the other method's pictures.

    Returns:
        Share of figures within TOLERANCE, without HDR-FLIP; None if no scene has figures.
    """
    scene = next((each for name, each in suite.scenes.items() if name in found.whole), None)
    if scene is None:
        return None
    factor = found.factors.get(scene.name, 1.0)
    said = {"name": "foreign", "color_space": "display", "scale": "absolute"}
    method = Method.model_validate(found.folder.method.model_dump() | said)
    with write_method(folder, method) as out:
        for light in judged_lights(scene):
            frames = found.folder.frames(scene, light)
            seen = shown(suite, found.folder, frames, scene.lights[light].exposure, factor)
            out.frames(scene.name, light, seen)
    again = Judged(MethodFolder.load(folder, suite))
    _judge_lights(again, suite, scene, foreground(scene), None)
    before = [score for score in found.frames if score.scene == scene.name]
    same = [
        abs(mine.figures[name] - value) <= TOLERANCE
        for mine, theirs in zip(before, again.frames, strict=True)
        for name, value in theirs.figures.items()
    ]
    return sum(same) / len(same)


def common_scenes(judged: Iterable[Judged]) -> set[str]:
    """Return the scenes in which all methods have figures."""
    found = [each.whole for each in judged]
    return set.intersection(*found) if found else set()
