"""Surroundings of a scene: a shell of sky is dropped, shown as a backdrop, or kept."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tron.gaussians.edit import subset
from tron.gaussians.scene import GaussianScene
from tron.scans import Treatment

log = logging.getLogger(__name__)

_SAYS = {
    "drop": "they are left out; %(key)s=background shows them behind the scene, %(key)s=keep keeps them in "
    "the light's way",
    "background": "they are seen behind the scene, and cast no shadow",
}


@dataclass(frozen=True)
class Surrounded:
    """A scene divided into content and surroundings.

    Attributes:
        shown: the surfels that cameras see.
        content: the surfels of ``shown`` that cameras frame and that light meets.
        backdrop: (M,) bool, surfels of ``shown`` that are not in ``content``; None if all are.
        around: (N,) bool, surfels of the scene that are not in ``content``; None if all are.
    """

    shown: GaussianScene
    content: GaussianScene
    backdrop: np.ndarray | None = None
    around: np.ndarray | None = None


def treat_surroundings(
    scene: GaussianScene, treatment: Treatment, where: Path, key: str = "surroundings"
) -> Surrounded:
    """Find the surroundings of a scene and treat them; a line names the setting ``key``, unless it is empty.

    The Mitsuba variant must be set.
    """
    if treatment == "keep":
        return Surrounded(scene, scene)
    from tron.tracing.surroundings import find_surroundings

    around = find_surroundings(scene)
    if not around.any():
        return Surrounded(scene, scene)
    if key:
        log.warning(
            "%s: %d of %d splats surround the scene from afar and shut out the light, as a sky does: %s",
            where, int(around.sum()), len(scene), _SAYS[treatment] % {"key": key},
        )  # fmt: skip
    content = subset(scene, ~around)
    if treatment == "drop":
        return Surrounded(content, content, around=around)
    shown = scene.turned_over(around & scene.looks_away(np.median(content.means, axis=0)))
    shown.spacing = content.spacing
    return Surrounded(shown, content, around, around)
