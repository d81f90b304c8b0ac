"""Editing a scene: parts of it taken out, put in, moved as rigid bodies and scaled.

What the edits of :mod:`tron.editing` are made of.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tron.errors import TronError
from tron.gaussians.fields import FIELDS
from tron.gaussians.harmonics import rotate_sh
from tron.gaussians.scene import GaussianScene, measure_spacing, quats_from_matrices

_TOLERANCE = 1e-4
_SIZES = ("log_scales", "log_thickness")

KERNEL_WIDTHS = 1.45
"""A kernel of degree 2 with so many times the scales stands for one of degree 4.

Between 1.37, of equal volume, and 1.59, of equal width at half height. Baked light of three development
scenes at 1.3, 1.4 and 1.5: 31.0, 31.0, 30.7 dB through a rasteriser of 3DGS, drawn by TRON with degree 2
31.9, 32.8, 32.9; with degree 4 33.9. Four worlds whose surfels stand more evenly at 1.4, 1.45 and 1.5: 30.6,
30.9, 31.2 through the rasteriser, 30.4, 31.0, 31.5 by TRON, 32.2 with degree 4.
"""


def subset(scene: GaussianScene, which: np.ndarray) -> GaussianScene:
    """The surfels ``which``, (M,) bool or indices, alone; their spacing is measured anew.

    Raises:
        TronError: nothing is selected, or what there is not.
    """
    selected = _selection(which, len(scene))
    arrays = {name: getattr(scene, name)[selected] for name in FIELDS}
    return replace(scene, **arrays, spacing=measure_spacing(arrays["means"]))


def removed(scene: GaussianScene, which: np.ndarray) -> GaussianScene:
    """The scene without the surfels ``which``, (M,) bool or indices; all else, spacing included, stays.

    Raises:
        TronError: nothing is selected, or what there is not, or everything.
    """
    kept = ~_selection(which, len(scene))
    if not kept.any():
        raise TronError("no surfel is left", mend="select fewer")
    return replace(scene, **{name: getattr(scene, name)[kept] for name in FIELDS})


def joined(scene: GaussianScene, other: GaussianScene) -> GaussianScene:
    """Both scenes' surfels, those of ``other`` last, so that numbers of surfels stay.

    What belongs to a whole scene (spacing, up, offset, projection) is that of ``scene``.

    Raises:
        TronError: kernels of different degrees.
    """
    if other.kernel_degree != scene.kernel_degree:
        what = f"kernels of degree {scene.kernel_degree} and {other.kernel_degree} cannot stand in one scene"
        raise TronError(what, mend="give the other scene the same kernel")
    return replace(
        scene, **{name: np.concatenate([getattr(scene, name), getattr(other, name)]) for name in FIELDS}
    )


def with_kernel(scene: GaussianScene, degree: int) -> GaussianScene:
    """The scene with kernels of a degree, 2 or 4; where it is another, surfels get :data:`KERNEL_WIDTHS`."""
    if scene.kernel_degree == degree:
        return scene
    widths = KERNEL_WIDTHS if degree == 2 else 1 / KERNEL_WIDTHS
    wider = {name: getattr(scene, name) + np.float32(np.log(widths)) for name in _SIZES}
    return replace(scene, **wider, kernel_degree=degree)


def scaled(scene: GaussianScene, which: np.ndarray, factor: float, pivot: np.ndarray) -> GaussianScene:
    """The scene with some surfels larger by a factor: their distances from ``pivot`` and their sizes.

    Args:
        scene: the surfels.
        which: (M,) bool, or indices of surfels.
        factor: above 0.
        pivot: (3,), world, stays where it is.

    Raises:
        TronError: nothing is selected, or what there is not; the factor is not a positive number.
    """
    selected = _selection(which, len(scene))
    if not (np.isfinite(factor) and factor > 0):
        raise TronError(f"factor is {factor}", mend="give a number above 0")
    about = _vector("pivot", pivot)
    means, sizes = scene.means.copy(), {name: getattr(scene, name).copy() for name in _SIZES}
    means[selected] = (means[selected].astype(np.float64) - about) * factor + about
    for each in sizes.values():
        each[selected] += np.float32(np.log(factor))
    return replace(scene, means=means, **sizes)


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
        TronError: nothing is selected, or what there is not; ``rotation`` is not a rotation, or another
            argument not three finite numbers.
    """
    selected = _selection(which, len(scene))
    turn = np.eye(3) if rotation is None else np.asarray(rotation, np.float64)
    if turn.shape != (3, 3) or not np.allclose(turn @ turn.T, np.eye(3), atol=_TOLERANCE):
        raise TronError("rotation is not a rotation matrix", mend="give an orthogonal (3, 3) array")
    if np.linalg.det(turn) < 0:
        raise TronError("rotation mirrors the surfels", mend="give a matrix of determinant 1")
    means = scene.means[selected].astype(np.float64)
    shift = _vector("translation", np.zeros(3) if translation is None else translation)
    about = _vector("pivot", means.mean(0) if pivot is None else pivot)

    changed = scene.means.copy()
    changed[selected] = (means - about) @ turn.T + about + shift
    if rotation is None:
        return replace(scene, means=changed)
    quats, sh = scene.quats.copy(), scene.sh.copy()
    quats[selected] = quats_from_matrices(turn @ scene.rotations()[selected])
    sh[selected] = rotate_sh(scene.sh[selected], turn)
    return replace(scene, means=changed, quats=quats, sh=sh)


def _selection(which: np.ndarray, count: int) -> np.ndarray:
    """(count,) bool mask of a mask or of indices."""
    which = np.asarray(which)
    if which.dtype == bool:
        if which.shape != (count,):
            raise TronError(
                f"the mask has shape {which.shape}", mend=f"give one bool for each of {count} surfels"
            )
        selected = which
    else:
        if which.size and (which.dtype.kind not in "iu" or which.min() < 0 or which.max() >= count):
            raise TronError("the selection is neither a mask nor indices", mend=f"indices are 0..{count - 1}")
        selected = np.zeros(count, bool)
        selected[which.astype(np.int64)] = True
    if not selected.any():
        raise TronError("no surfel is selected", mend="give a mask or indices of surfels")
    return selected


def _vector(name: str, values: np.ndarray) -> np.ndarray:
    values = np.asarray(values, np.float64)
    if values.shape != (3,) or not np.isfinite(values).all():
        raise TronError(f"{name} is {values.tolist()}", mend="give three finite numbers")
    return values
