"""Colour spaces, against colour-science's own conversions."""

import subprocess
import sys

import colour
import numpy as np
import pytest

from tron.errors import TronError
from tron.io.color_spaces import (
    BT709,
    HLG,
    PQ,
    SDR_WHITE,
    XYZ,
    chromaticities_of,
    colour_science,
    in_bt709,
    light_of,
    srgb_of,
    to_bt709,
)
from tron.seeds import generator

VALUES = generator(0, "colour spaces").random((300, 3))


def of_space(name: str) -> tuple[float, ...]:
    space = colour.RGB_COLOURSPACES[name]
    return (*space.primaries.ravel(), *space.whitepoint)


@pytest.mark.parametrize("name", ["ACES2065-1", "ACEScg", "Display P3", "ITU-R BT.2020", "Adobe RGB (1998)"])
def test_primaries_come_over_by_bradford(name: str):
    witness = colour.RGB_to_RGB(VALUES, name, "sRGB", "Bradford")
    # Matrices of the standards are rounded to four digits.
    np.testing.assert_allclose(in_bt709(VALUES, of_space(name)), witness, atol=6e-4)


def test_xyz_is_not_adapted():
    witness = colour.XYZ_to_RGB(VALUES, "sRGB", chromatic_adaptation_transform=None)
    np.testing.assert_allclose(in_bt709(VALUES, XYZ), witness, atol=1e-3)


def test_bt709_stays_what_it_is():
    assert to_bt709(tuple(np.asarray(BT709, np.float32).tolist())) is None
    assert in_bt709(VALUES, BT709) is VALUES


def test_alpha_stays_what_it_is():
    rgba = np.concatenate([VALUES, VALUES[:, :1]], axis=1)
    assert np.array_equal(in_bt709(rgba, of_space("ACEScg"))[:, 3], VALUES[:, 0])


@pytest.mark.parametrize("transfer, eotf", [(HLG, "ITU-R BT.2100 HLG"), (PQ, "ITU-R BT.2100 PQ")])
def test_hdr_curves_are_those_of_bt2100(transfer: int, eotf: str):
    values = np.round(VALUES * 1023) / 1023
    np.testing.assert_allclose(
        light_of(values, transfer) * SDR_WHITE, colour.eotf(values, eotf), rtol=1e-3, atol=1e-3
    )


@pytest.mark.parametrize("transfer, white", [(HLG, 0.75), (PQ, colour.eotf_inverse(203, "ITU-R BT.2100 PQ"))])
def test_the_white_of_hdr_is_that_of_sdr(transfer: int, white: float):
    np.testing.assert_allclose(srgb_of(np.full((1, 3), white), 9, transfer), 1, atol=1e-3)


def test_p3_display_values_become_srgb():
    linear = colour.RGB_to_RGB(VALUES, "Display P3", "sRGB", None, apply_cctf_decoding=True)
    witness = colour.models.eotf_inverse_sRGB(np.clip(linear, 0, 1))
    np.testing.assert_allclose(srgb_of(VALUES, 12, 13), witness, atol=2e-3)


@pytest.mark.parametrize("code", [1, 5, 6, 7, 9, 11, 12, 22])
def test_white_stays_white(code: int):
    np.testing.assert_allclose(in_bt709(np.ones((1, 3)), chromaticities_of(code)), 1, atol=1e-6)


@pytest.mark.parametrize(
    "ask",
    [
        lambda: to_bt709((0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3)),
        lambda: to_bt709((*BT709[:6], 0.3, 0.0)),
        lambda: to_bt709((float("nan"), *BT709[1:])),
        lambda: chromaticities_of(3),
        lambda: light_of(VALUES, 9),
    ],
)
def test_what_is_no_colour_space_is_refused(ask):
    with pytest.raises(TronError, match="store the file in sRGB"):
        ask()


def test_it_works_without_matplotlib_and_leaves_no_mock_of_it():
    code = """
import sys, warnings
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "matplotlib":
            raise ImportError(name)
sys.meta_path.insert(0, Absent())
warnings.simplefilter("error")
import numpy as np
from tron.io.color_spaces import XYZ, in_bt709
assert "colour" not in sys.modules
in_bt709(np.ones((1, 3)), XYZ)
assert not [name for name in sys.modules if name.startswith("matplotlib")]
assert repr(np.float32(1)) == "np.float32(1.0)"
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert colour_science() is colour
