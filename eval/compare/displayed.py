"""Methods' pictures as they are seen, for what looks at pictures and not at figures: judges and clips."""

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
    """Name -> folder of every method, and TRUTH, None, where the suite knows all of it.

    Raises:
        TronError: there is no method, one is damaged or of another suite, or two share a name.
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
    """Each light's pictures (K, H, W, 3) by a method, None: by the suite itself, display float32.

    As benchmark=compare judges them: the factor of methods that ask for one, and the truth behind the
    subject where not both have the environment there, if it is known.

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
