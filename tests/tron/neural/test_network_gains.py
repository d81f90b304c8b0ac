"""The rule by which checkpoint=auto takes the network: gains between, at and beyond the sizes measured."""

import numpy as np
import pytest

from tron.estimation import QUALITY
from tron.neural import network_gains
from tron.neural.network_gains import GAINS, expected_gain, quality_of


@pytest.fixture(autouse=True)
def measured(monkeypatch):
    monkeypatch.setattr(
        network_gains, "GAINS", {"preview": {128: 2.0, 512: -1.0}, "final": {128: 1.0, 512: 0.5}}
    )


def test_a_size_between_two_gains_what_lies_between_by_octaves():
    assert expected_gain("preview", 128, 128) == pytest.approx(2.0)
    assert expected_gain("preview", 256, 256) == pytest.approx(0.5), "an octave of two"
    assert expected_gain("preview", 512, 128) == pytest.approx(0.5), "as many pixels as 256 x 256"
    assert expected_gain("preview", 512, 512) == pytest.approx(-1.0)


def test_beyond_what_was_measured_the_nearest_size_holds():
    assert expected_gain("final", 16, 16) == pytest.approx(1.0)
    assert expected_gain("final", 4096, 2160) == pytest.approx(0.5)


def test_qualities_of_the_command_are_told_apart_by_their_estimation():
    for name, estimation in QUALITY.items():
        assert quality_of(estimation.supersample, estimation.reflections) == name
    assert quality_of(1, 2) == quality_of(2, 0) == "final"


def test_what_is_shipped_was_measured_at_three_sizes_of_both_qualities():
    assert set(GAINS) == set(QUALITY)
    for sizes in GAINS.values():
        assert list(sizes) == [128, 256, 512], "ascending, as interpolation needs them"
        assert np.isfinite(list(sizes.values())).all()
