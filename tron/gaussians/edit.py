"""Editing a scene: moving some of its surfels as a rigid body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tron.errors import TronError
from tron.gaussians.harmonics import rotate_sh
from tron.gaussians.scene import GaussianScene, quats_from_matrices

_TOLERANCE = 1e-4


def moved(
    scene: GaussianScene,
    which: np.ndarray,
    rotation: np.ndarray | None = None,
    translation: np.ndarray | None = None,
    pivot: np.ndarray | None = None,
) -> GaussianScene:
    """The scene with some surfels turned about ``pivot`` and then shifted; radiance turns with them.

    Arrays that do not change are shared with ``scene``, which stays as it is. A tracer of ``scene`` traces
    the result without sorting it anew: :meth:`tron.tracing.SurfelTracer.moved`.

    Args:
        scene: the surfels.
        which: (M,) bool, or indices of surfels; ``scene.object_id == 3`` is an object.
        rotation: (3, 3), world; none by default.
        translation: (3,), world units; none by default.
        pivot: (3,), world; the mean of the moved centres by default.

    Raises:
        TronError: nothing is selected, or ``rotation`` is not a rotation.
    """
    selected = np.zeros(len(scene), bool)
    selected[np.asarray(which)] = True
    if not selected.any():
        raise TronError("no surfel is selected", mend="give a mask or indices of the surfels to move")
    turn = np.eye(3) if rotation is None else np.asarray(rotation, np.float64)
    if turn.shape != (3, 3) or not np.allclose(turn @ turn.T, np.eye(3), atol=_TOLERANCE):
        raise TronError("rotation is not a rotation matrix", mend="give an orthogonal (3, 3) array")
    if np.linalg.det(turn) < 0:
        raise TronError("rotation mirrors the surfels", mend="give a matrix of determinant 1")
    shift = np.zeros(3) if translation is None else np.asarray(translation, np.float64)
    means = scene.means[selected].astype(np.float64)
    about = means.mean(0) if pivot is None else np.asarray(pivot, np.float64)

    changed = scene.means.copy()
    changed[selected] = (means - about) @ turn.T + about + shift
    if rotation is None:
        return replace(scene, means=changed)
    quats, sh = scene.quats.copy(), scene.sh.copy()
    quats[selected] = quats_from_matrices(turn @ scene.rotations()[selected])
    sh[selected] = rotate_sh(scene.sh[selected], turn)
    return replace(scene, means=changed, quats=quats, sh=sh)
