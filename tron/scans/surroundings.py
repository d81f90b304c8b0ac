"""Treatment of what surrounds a scene: a shell of sky is left out, or stands behind it, or stays a lid."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from tron.gaussians.edit import subset
from tron.gaussians.scene import GaussianScene

log = logging.getLogger(__name__)

Treatment = Literal["drop", "background", "keep"]
_SAYS = {
    "drop": "they are left out; %(key)s=background shows them behind the scene, %(key)s=keep keeps them in "
    "the light's way",
    "background": "they are seen behind the scene, and cast no shadow",
}


@dataclass(frozen=True)
class Surrounded:
    """A scene and what surrounds it.

    Attributes:
        shown: the surfels that cameras see.
        content: those of them that are framed and meet light.
        backdrop: (M,) bool, those of ``shown`` that are not in ``content``; None where all are.
        around: (N,) bool, those of the scene that are not in ``content``; None where all are.
    """

    shown: GaussianScene
    content: GaussianScene
    backdrop: np.ndarray | None = None
    around: np.ndarray | None = None


def treat_surroundings(
    scene: GaussianScene, treatment: Treatment, where: Path, key: str = "surroundings"
) -> Surrounded:
    """Find what surrounds a scene, say so in a line that names ``key``, unless that is empty, and treat it.

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
