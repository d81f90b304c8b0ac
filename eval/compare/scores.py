"""Figures of a method's folder on a suite: every picture against the truth, and every fault by its name.

Pictures are judged as they are seen: exposed by the suite, through its tone curve. Three colour spaces come
to that in their own ways (:func:`shown`). A figure is taken of the foreground, pixels that surfaces cover
altogether; where method and suite have the same environment behind them also of the whole frame. Metrics
that look at neighbours (SSIM, FLIP, LPIPS) are given the truth around the foreground of any other method.

A scene one of whose pictures is at fault has no figures at all: a mean over what happened to be there would
favour who left out what is hard.
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
    """Figures of one picture; names end in ``_full`` where they are of the whole frame."""

    scene: str
    kind: str
    light: str
    family: str
    frame: int
    figures: Mapping[str, float]


@dataclass(frozen=True)
class FoundFault:
    """A fault: where, of which kind, and in a sentence."""

    scene: str
    what: str
    kind: str
    text: str


@dataclass
class Judged:
    """All that was found of a method.

    Attributes:
        frames: of the scenes without a fault in their relit pictures.
        maps: scene -> figures of MAP_MEASURES, means over views.
        factors: scene -> the factor on its light, of methods that ask for one.
        faults: in the suite's order.
        missing: maps that the method does not give and the suite could judge.
    """

    folder: MethodFolder
    frames: list[FrameScore] = field(default_factory=list)
    maps: dict[str, dict[str, float]] = field(default_factory=dict)
    factors: dict[str, float] = field(default_factory=dict)
    faults: list[FoundFault] = field(default_factory=list)
    missing: set[str] = field(default_factory=set)

    @property
    def name(self) -> str:
        """In rows."""
        return self.folder.method.name

    @property
    def whole(self) -> set[str]:
        """Scenes that have figures."""
        return {score.scene for score in self.frames}


Score = Callable[[np.ndarray, np.ndarray, np.ndarray | None], dict[str, float]]


def judged_lights(scene: SuiteScene) -> list[str]:
    """Lights of a scene whose truth is known."""
    return [name for name, light in scene.lights.items() if light.truth]


def foreground(scene: SuiteScene) -> np.ndarray:
    """(K, H, W) bool: pixels that show nothing but surfaces; all of them where the suite has no masks."""
    mask = scene.mask()
    if mask is None:
        return np.ones((scene.entry.frames, scene.size.height, scene.size.width), bool)
    return mask > COVERED


def judge_method(suite: Suite, folder: MethodFolder, lpips: LPIPS | None = None) -> Judged:
    """Read and score all that a method's folder holds, a scene in memory at a time."""
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
    """Pictures as they are seen, (..., 3) display float32: the suite's exposure, factor and tone curve."""
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
    """The factor on a method's light in a scene (:func:`eval.light_scale.fitted_factor`), of all its lights.

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
    """Figures of display values (H, W, 3) in [0, 1]; ``mask`` (H, W) counts, None: all pixels."""
    least = min(image.shape[:2])
    small = {"ssim"} if least < 6 else set()
    figures = {each.name: each.measure(image, truth, mask) for each in METRICS if each.name not in small}
    if lpips is not None and least >= LPIPS_LEAST_SIDE:
        figures["lpips"] = _lpips(lpips, image, truth)
    return figures


def hdr_figures(exposed: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> dict[str, float]:
    """HDR-FLIP of exposed linear radiance (H, W, 3) on a foreground, its median colour around it.

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
    """Means over views of linear base color (K, H, W, 3) on the foreground, by all three scalings.

    TRON scales each view and channel by least squares, TensoIR, GS-IR and IRGS each scene and channel by the
    median ratio; unscaled is as the method gives it. Scaled values are clipped to [0, 1].
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
    """Angular errors of world normals (K, H, W, 3) where the foreground has a true one, degrees.

    Angles are the same in the world and in a camera's frame, once both are in one. Normals that fit far
    better in a frame that the method does not name are a fault: the figure would be of the mistake.
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
    """Share of its figures that a method keeps as somebody else: pictures of a scene, as seen, judged anew.

    Args:
        folder: an empty one, for the other's pictures.

    Returns:
        That of figures within TOLERANCE, HDR-FLIP left out; None where no scene has figures.
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
    """Scenes that all methods have figures of."""
    found = [each.whole for each in judged]
    return set.intersection(*found) if found else set()
