"""The rule by which checkpoint=auto chooses: gains between, at and beyond sizes measured, the most first."""

import numpy as np
import pytest

from tron.estimation import QUALITY
from tron.neural import network_gains
from tron.neural.network_gains import GAINS, Way, best_first, expected_gain, quality_of


@pytest.fixture(autouse=True)
def measured(monkeypatch):
    gains = {
        "network": {"preview": {128: 2.0, 512: -1.0}, "final": {128: 1.0, 512: 0.5}},
        "oidn": {"preview": {128: 0.5, 512: 0.5}, "final": {128: 0.5, 512: 0.75}},
    }
    monkeypatch.setattr(network_gains, "GAINS", gains)


def test_a_size_between_two_gains_what_lies_between_by_octaves():
    assert expected_gain("network", "preview", 128, 128) == pytest.approx(2.0)
    assert expected_gain("network", "preview", 256, 256) == pytest.approx(0.5), "an octave of two"
    assert expected_gain("network", "preview", 512, 128) == pytest.approx(0.5), "as many pixels as 256 x 256"
    assert expected_gain("network", "preview", 512, 512) == pytest.approx(-1.0)


def test_beyond_what_was_measured_the_nearest_size_holds():
    assert expected_gain("network", "final", 16, 16) == pytest.approx(1.0)
    assert expected_gain("network", "final", 4096, 2160) == pytest.approx(0.5)


def test_what_gains_most_at_that_size_and_quality_comes_first():
    both: list[Way] = ["network", "oidn"]
    assert list(best_first(both, "preview", 128, 128).items()) == [("network", 2.0), ("oidn", 0.5)]
    assert list(best_first(both, "preview", 512, 512).items()) == [("oidn", 0.5), ("network", -1.0)]
    assert list(best_first(both, "final", 512, 512)) == ["oidn", "network"]
    assert list(best_first(["network"], "final", 512, 512)) == ["network"]


def test_qualities_of_the_command_are_told_apart_by_their_estimation():
    for name, estimation in QUALITY.items():
        assert quality_of(estimation.supersample, estimation.reflections) == name
    assert quality_of(1, 2) == quality_of(2, 0) == "final"


def test_what_is_shipped_was_measured_at_three_sizes_of_both_qualities():
    assert set(GAINS) == {"network", "oidn"}
    for qualities in GAINS.values():
        assert set(qualities) == set(QUALITY)
        for sizes in qualities.values():
            assert list(sizes) == [128, 256, 512], "ascending, as interpolation needs them"
            assert np.isfinite(list(sizes.values())).all()
