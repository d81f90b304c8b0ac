"""Splats as files of other programs hold them, and how a file places them."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from tron.errors import TronError
from tron.gaussians.fields import FIELDS, third_scales
from tron.gaussians.harmonics import SH_COUNT, rotate_sh
from tron.gaussians.ply import REST, THIRD_SCALE, Stored

log = logging.getLogger(__name__)

Y_UP = (0.0, 1.0, 0.0)
Z_UP = (0.0, 0.0, 1.0)
_UNEVEN = 1e-4
"""Relative difference of a matrix's three scales from which its axes are stretched apart."""


@dataclass(frozen=True)
class Splats:
    """M Gaussians of 3DGS.

    Attributes:
        means: (M, 3).
        quats: (M, 4) (w, x, y, z) of any length.
        log_scales: (M, 3) natural logarithms; -infinity of a flat splat.
        opacity_logits: (M,).
        sh: (M, 1, 4, 9 or 16, 3) harmonics of degree 0 to 3, display values less 0.5.
        up: of their frame; None where the file does not say.
    """

    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray
    opacity_logits: np.ndarray
    sh: np.ndarray
    up: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        count, bands = self.sh.shape[:2] if self.sh.ndim == 3 else (-1, 0)
        shapes = {
            "means": (count, 3),
            "quats": (count, 4),
            "log_scales": (count, 3),
            "opacity_logits": (count,),
        }
        for name, shape in shapes.items():
            found = getattr(self, name).shape
            if found != shape:
                raise TronError(
                    f"{name} of its splats have shape {found} beside harmonics of {self.sh.shape}"
                )
        if bands not in (1, 4, 9, SH_COUNT) or self.sh.shape[2] != 3:
            raise TronError(
                f"harmonics of its splats have shape {self.sh.shape}", mend="degrees 0 to 3 are read"
            )

    @classmethod
    def of(cls, scene: Mapping[str, Any]) -> Splats:
        """Those of what a scene of kernel degree 2 holds."""
        third = third_scales(scene["log_scales"], scene["log_thickness"])
        log_scales = np.concatenate([scene["log_scales"], third[:, None]], axis=1)
        return cls(scene["means"], scene["quats"], log_scales, scene["opacity_logits"], scene["sh"])

    def stored(self) -> Stored:
        """By the names of 3DGS' properties."""
        rest = self.sh[:, 1:].transpose(0, 2, 1).reshape(len(self.sh), -1).T
        columns = {
            **dict(zip(FIELDS["means"].properties, self.means.T)),
            **dict(zip(FIELDS["sh"].properties, self.sh[:, 0].T)),
            **dict(zip(REST, rest)),
            "opacity": self.opacity_logits,
            **dict(zip((*FIELDS["log_scales"].properties, THIRD_SCALE), self.log_scales.T)),
            **dict(zip(FIELDS["quats"].properties, self.quats.T)),
        }
        return Stored(columns, up=None if self.up is None else np.array(self.up))

    def placed(self, matrix: np.ndarray) -> Splats:
        """The splats under an affine (4, 4) matrix that turns, shifts, and scales all axes alike.

        Raises:
            TronError: it does something else.
        """
        if np.array_equal(matrix, np.eye(4)):
            return self
        linear = np.asarray(matrix, np.float64)[:3, :3]
        scale = float(np.cbrt(np.linalg.det(linear))) if np.isfinite(matrix).all() else 0.0
        if not (scale > 0 and np.allclose(linear @ linear.T, scale**2 * np.eye(3), atol=_UNEVEN * scale**2)):
            raise TronError(
                "its splats are mirrored or stretched by a transform", mend="apply it before the export"
            )
        turn = Rotation.from_matrix(linear / scale)
        lengths = np.linalg.norm(self.quats, axis=1)
        quats = np.array(self.quats, np.float64)
        some = lengths > 0
        quats[some] = (turn * Rotation.from_quat(quats[some], scalar_first=True)).as_quat(scalar_first=True)
        return replace(
            self,
            means=self.means @ linear.T + np.asarray(matrix)[:3, 3],
            quats=quats,
            log_scales=self.log_scales + np.log(scale),
            sh=rotate_sh(_filled(self.sh), turn.as_matrix()),
        )


def joined(parts: Sequence[Splats], up: tuple[float, float, float] | None) -> Splats:
    """One or more parts of a file as one."""
    arrays = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in ("means", "quats", "log_scales", "opacity_logits")
    }
    return Splats(**arrays, sh=np.concatenate([_filled(part.sh) for part in parts]), up=up)


def _filled(sh: np.ndarray) -> np.ndarray:
    """(M, 16, 3) harmonics; of degrees that are not there they are zero."""
    return np.pad(sh.astype(np.float32), ((0, 0), (0, SH_COUNT - sh.shape[1]), (0, 0)))


@contextmanager
def one_line(path: Path) -> Iterator[None]:
    """Whatever damaged numbers make Python, NumPy and other readers raise becomes a TronError of the file."""
    try:
        yield
    except TronError as error:
        raise TronError(error.what.replace("model", "file"), error.where or path, error.mend) from error
    except OSError as error:
        raise TronError(f"cannot read: {error.strerror or error}", path) from error
    except Exception as error:
        what = f"cannot be read, {type(error).__name__}: {str(error)[:200]}"
        raise TronError(what, path, "it is damaged: export it again") from error


_MEANT = 0.1
"""Share of values that their format does not allow from which all are stored otherwise; a few are broken."""


def logarithms(scales: np.ndarray, path: Path) -> np.ndarray:
    """Natural logarithms of linear scales; -infinity of zero, NaN of what is negative.

    Where many are negative they are logarithms already, as splat-transform wrote glTF before its issue 267
    was mended: a line says so.
    """
    scales = np.asarray(scales, np.float64)
    if scales.size and (scales < 0).mean() > _MEANT:
        log.warning("%s: its scales are negative, which lengths are not: read as logarithms", path)
        return scales
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.log(scales)


def logits(opacities: np.ndarray, path: Path) -> np.ndarray:
    """Logits of opacities in [0, 1]; infinite at its ends, NaN outside.

    Where many lie outside they are logits already: a line says so.
    """
    opacities = np.asarray(opacities, np.float64)
    if opacities.size and ((opacities < 0) | (opacities > 1)).mean() > _MEANT:
        log.warning("%s: its opacities lie outside [0, 1]: read as logits", path)
        return opacities
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.log(opacities) - np.log1p(-opacities)
