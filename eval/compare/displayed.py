"""Methods' pictures in display values, for judges and clips, which look at pictures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from eval.compare.benchmark import find_methods
from eval.compare.scores import foreground, judged_lights, scene_factor, shown
from eval.protocol.method import MethodFolder
from eval.protocol.suite import Suite, SuiteScene
from tron.errors import TronError

TRUTH = "truth"
"""Name of the suite's own pictures; no method may have it."""


def methods_and_truth(given: Path | Sequence[Path], suite: Suite) -> dict[str, MethodFolder | None]:
    """Return method name -> folder, and TRUTH -> None if the suite has the whole truth.

    Raises:
        TronError: there is no method, a method is damaged or of another suite, or two share a name.
    """
    found: dict[str, MethodFolder | None] = {each.method.name: each for each in find_methods(given, suite)}
    if TRUTH in found:
        raise TronError(
            f"a method is named {TRUTH}, as the suite's own pictures are", str(given), "rename it"
        )
    known = all(light.truth for scene in suite.scenes.values() for light in scene.lights.values())
    return {**found, **({TRUTH: None} if known else {})}


def displayed(
    suite: Suite, scene: SuiteScene, folder: MethodFolder | None
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield light -> pictures (K, H, W, 3) of a method, or of the suite for None; display float32.

    Pictures are prepared as in benchmark=compare: with the factor of methods that ask for one, and with the
    known truth behind the subject unless both have the environment there.

    Raises:
        Fault: what is wrong with them.
    """
    inside, factor = foreground(scene), 1.0
    if folder is not None and folder.method.scale == "scene" and (known := judged_lights(scene)):
        stored = {light: folder.frames(scene, light) for light in known}
        truths = {light: scene.truth(light) for light in known}
        factor = scene_factor(suite, scene, folder, stored, truths, inside)
    for name, light in scene.lights.items():
        truth = suite.display(scene.truth(name) * np.float32(light.exposure)) if light.truth else None
        if folder is None:
            assert truth is not None, "the truth is asked for where it is known"
            yield name, truth
            continue
        pictures = shown(suite, folder, folder.frames(scene, name), light.exposure, factor)
        if truth is not None and not folder.method.background == suite.file.background == "environment":
            pictures = np.where(inside[..., None], pictures, truth)
        yield name, pictures
