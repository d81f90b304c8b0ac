"""The table of a surfel's fields: whatever stores, uploads, optimises or checks surfels derives from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tron.gaussians.harmonics import SH_COUNT

LOG_SCALE_LIMIT = 40.0
"""Scales beyond e^+-40 overflow float32 once they are squared."""


@dataclass(frozen=True)
class Field:
    """An array of :class:`tron.gaussians.GaussianScene`, one row a surfel.

    Attributes:
        shape: of a row.
        properties: names in a PLY, in the order of the row's numbers, of those that a file must have.
        unit: whether its numbers lie in [0, 1].
        trained: whether it is a parameter, which an optimiser may change.
        dtype: of its numbers.
        zero: whether they are logarithms that may be -infinity.
    """

    shape: tuple[int, ...]
    properties: tuple[str, ...]
    unit: bool = False
    trained: bool = True
    dtype: type[np.generic] = np.float32
    zero: bool = False


FIELDS = {
    "means": Field((3,), ("x", "y", "z")),
    "quats": Field((4,), ("rot_0", "rot_1", "rot_2", "rot_3")),
    "log_scales": Field((2,), ("scale_0", "scale_1")),
    "opacity_logits": Field((), ("opacity",)),
    "sh": Field((SH_COUNT, 3), ("f_dc_0", "f_dc_1", "f_dc_2")),
    "base_color": Field((3,), ("base_color_0", "base_color_1", "base_color_2"), unit=True),
    "roughness": Field((), ("roughness",), unit=True),
    "metallic": Field((), ("metallic",), unit=True),
    "object_id": Field((), ("object_id",), trained=False, dtype=np.int32),
    "log_thickness": Field((), ("scale_2",), trained=False, zero=True),
    "emission": Field((3,), ("emission_0", "emission_1", "emission_2"), trained=False),
}
PARAMETERS = tuple(name for name, field in FIELDS.items() if field.trained)
MATERIALS = tuple(name for name, field in FIELDS.items() if field.unit)

FLATNESS = 1e-3
"""Third scale over the smaller of the others up to which a Gaussian is flat, and far from underflow."""


def third_scales(log_scales: np.ndarray, log_thickness: np.ndarray | float = -np.inf) -> np.ndarray:
    """(M,) third logarithmic scales as files have them, of (M, 2) scales and (M,) thicknesses: none is 0."""
    return np.maximum(log_thickness, log_scales.min(axis=1) + np.float32(np.log(FLATNESS)))
