"""Colour spaces of files: from theirs to linear BT.709 or to sRGB display values, by colour-science.

Matrices go from one set of primaries and white to another by Bradford's adaptation. Code points are those of
ITU-T H.273, which videos, HEIC and PNG (chunk cICP) share. Only RGB is converted, channels last.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from functools import lru_cache
from types import ModuleType
from unittest.mock import Mock

import numpy as np

from tron.color import linear_to_srgb, srgb_to_linear
from tron.errors import TronError

BT709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
"""Chromaticities (x, y) of red, green, blue and white, one after another: sRGB's too."""
XYZ = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1 / 3, 1 / 3)
"""Primaries of CIE XYZ. It is no RGB space: its white says how it is scaled, not what was adapted to."""

SDR_WHITE = 203.0
"""Candela per square metre of HLG and PQ that a white of SDR is shown at (ITU-R BT.2408)."""
HLG_PEAK, HLG_GAMMA = 1000.0, 1.2
"""Candela per square metre of the display that HLG is shown on, and its gamma there (ITU-R BT.2100)."""
BT2020_LUMINANCE = (0.2627, 0.6780, 0.0593)

PRIMARIES = {
    1: "BT.709",
    5: "BT.601 (625 lines)",
    6: "BT.601 (525 lines)",
    7: "SMPTE 240M",
    9: "BT.2020",
    11: "DCI-P3",
    12: "Display P3",
    22: "EBU Tech 3213",
}
"""Names of the primaries that are converted, by H.273's code points; all with D65 but theatres' DCI-P3."""
TRANSFERS = {
    1: "BT.709",
    4: "gamma 2.2",
    5: "gamma 2.8",
    6: "BT.601",
    8: "linear",
    13: "sRGB",
    14: "BT.2020",
    15: "BT.2020",
    16: "PQ",
    18: "HLG",
}
"""Names of the transfer characteristics that are decoded, by H.273's code points."""
PQ, HLG = 16, 18
_GAMMAS = {4: 2.2, 5: 2.8, 8: 1.0}
_D65, _DCI_WHITE = BT709[6:], (0.314, 0.351)
_SAME = 1e-3
"""Chromaticities this close are the same: files state them with three or four digits."""


@lru_cache(maxsize=64)
def to_bt709(chromaticities: tuple[float, ...]) -> np.ndarray | None:
    """(3, 3) float64 from linear RGB of these chromaticities to linear BT.709; None where they are its own.

    Args:
        chromaticities: x, y of red, green, blue and white; XYZ's own are not adapted.

    Raises:
        TronError: no colours have such chromaticities.
    """
    if np.allclose(chromaticities, BT709, rtol=0, atol=_SAME):
        return None
    primaries, white = np.reshape(chromaticities, (4, 2))[:3], np.asarray(chromaticities[6:], np.float64)
    corners = np.column_stack([primaries, 1 - primaries.sum(1)])
    if (
        not np.isfinite(chromaticities).all()
        or abs(np.linalg.det(corners)) < 1e-6
        or np.abs(chromaticities).max() > 10  # those of ACES' rivals reach 1.5
        or white.min() < 1e-3
    ):
        shown = ", ".join(f"{value:.4g}" for value in chromaticities)
        raise TronError(f"chromaticities ({shown}) are no colour space", mend="store the file in sRGB")
    colour = colour_science()
    to_xyz = colour.normalised_primary_matrix(primaries, white)
    adaptation = np.eye(3)
    if not np.allclose(chromaticities, XYZ, rtol=0, atol=_SAME):
        whites = [colour.xy_to_XYZ(xy) for xy in (white, _D65)]
        adaptation = colour.adaptation.matrix_chromatic_adaptation_VonKries(*whites, "Bradford")
    own = np.reshape(BT709, (4, 2))
    return np.linalg.inv(colour.normalised_primary_matrix(own[:3], own[3])) @ adaptation @ to_xyz


def luminance_weights(chromaticities: Sequence[float]) -> np.ndarray:
    """(3,) float64: shares of linear red, green and blue of these chromaticities in luminance."""
    corners = np.reshape(chromaticities, (4, 2))
    weights = colour_science().normalised_primary_matrix(corners[:3], corners[3])[1]
    return weights / weights.sum()


def in_bt709(linear: np.ndarray, chromaticities: Sequence[float]) -> np.ndarray:
    """Linear RGB (..., 3 or 4) of these chromaticities in BT.709, float32; a fourth channel stays as it is.

    Colours outside of BT.709 have negative values.
    """
    matrix = to_bt709(tuple(float(value) for value in chromaticities))
    if matrix is None:
        return linear
    rgb = np.asarray(linear[..., :3], np.float64) @ matrix.T
    return np.concatenate([rgb.astype(np.float32), linear[..., 3:]], axis=-1)


def radiance_in_bt709(linear: np.ndarray, chromaticities: Sequence[float]) -> np.ndarray:
    """:func:`in_bt709` of radiance: what no display shows and no light can have is kept from the matrix.

    A texel with an infinite channel is infinite in all. Colours outside of BT.709 are clipped to zero; what
    is negative in the file itself stays so, for whoever judges it.
    """
    if to_bt709(tuple(float(value) for value in chromaticities)) is None:
        return linear
    rgb = linear[..., :3]
    endless = np.isposinf(rgb).any(-1, keepdims=True)
    found = in_bt709(np.where(endless, 0, linear), chromaticities)
    color = np.where((rgb >= 0).all(-1, keepdims=True), np.maximum(found[..., :3], 0), found[..., :3])
    color = np.where(endless, np.float32(np.inf), color)
    return np.concatenate([color, linear[..., 3:]], axis=-1)


def chromaticities_of(primaries: int) -> tuple[float, ...]:
    """Chromaticities of H.273's primaries.

    Raises:
        TronError: others than those of PRIMARIES.
    """
    if primaries == 1:
        return BT709
    if primaries not in PRIMARIES:
        raise TronError(f"primaries {primaries} of H.273 are not converted", mend="store the file in sRGB")
    corners = np.ravel(colour_science().models.COLOUR_PRIMARIES_ITUTH273[primaries])
    return (*corners.tolist(), *(_DCI_WHITE if primaries == 11 else _D65))


def srgb_of(values: np.ndarray, primaries: int, transfer: int) -> np.ndarray:
    """sRGB display values (..., 3) float32 in [0, 1] of encoded ones (..., 3) in [0, 1], by H.273's codes.

    What lies outside of sRGB is clipped: its colours, and of HLG and PQ what is brighter than SDR's white.
    Curves of SDR video (BT.709, 601, 2020) are taken as the display's, sRGB, as players do: video in BT.709
    stays as it is.

    Raises:
        TronError: code points that are not in PRIMARIES and TRANSFERS.
    """
    linear = in_bt709(light_of(values, transfer), chromaticities_of(primaries))
    return linear_to_srgb(np.clip(linear, 0, 1)).astype(np.float32)


def light_of(values: np.ndarray, transfer: int) -> np.ndarray:
    """Linear light (..., 3) float32 as displayed, 1 the white of SDR, of encoded values in [0, 1].

    Raises:
        TronError: a transfer characteristic that is not in TRANSFERS.
    """
    if transfer not in TRANSFERS:
        raise TronError(
            f"transfer characteristic {transfer} of H.273 is not decoded", mend="store the file in sRGB"
        )
    values = np.clip(values, 0, 1).astype(np.float32)
    if transfer in _GAMMAS:
        return values ** np.float32(_GAMMAS[transfer])
    if transfer not in (PQ, HLG):
        return srgb_to_linear(values)
    table = _curve(transfer)
    light = table[np.round(values * (len(table) - 1)).astype(np.intp)]
    if transfer == HLG:  # the display's gamma is of luminance, not of channels (BT.2100, reference OOTF)
        luminance = light @ np.asarray(BT2020_LUMINANCE, np.float32)
        light = light * (luminance ** np.float32(HLG_GAMMA - 1))[..., None] * np.float32(HLG_PEAK)
    return light / np.float32(SDR_WHITE)


@lru_cache(maxsize=2)
def _curve(transfer: int) -> np.ndarray:
    """(65536,) float32 of even steps from 0 to 1: PQ's candela per square metre, HLG's light of the scene."""
    values, models = np.linspace(0, 1, 2**16), colour_science().models
    decode = models.eotf_BT2100_PQ if transfer == PQ else models.oetf_inverse_BT2100_HLG
    return np.asarray(decode(values), np.float32)


@lru_cache(maxsize=1)
def colour_science() -> ModuleType:
    """The library, imported when it is first needed: it takes a second or two.

    Without Matplotlib it warns and leaves mocks of it in sys.modules, at which others stumble, and it changes
    how NumPy prints: both are undone.
    """
    before, printing = set(sys.modules), np.get_printoptions()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import colour
    np.set_printoptions(**printing)
    for name in set(sys.modules) - before:
        if isinstance(sys.modules[name], Mock):
            del sys.modules[name]
    return colour
