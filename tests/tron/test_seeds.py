"""The seed tree: streams depend on their path alone, on every machine and in every process."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tron import seeds

PATHS = st.lists(st.one_of(st.text(max_size=8), st.integers(-(2**70), 2**70)), max_size=4)


def test_known_values_never_change():
    """Every data set ever made from a seed depends on these numbers."""
    assert seeds.integer(0, "scene", 12, "lights") == 3572106527
    assert seeds.generator(0, "scene", 12, "lights").integers(0, 1000, 6).tolist() == [
        842,
        293,
        814,
        731,
        36,
        519,
    ]


@given(PATHS, PATHS)
def test_different_paths_give_different_streams(a: list, b: list):
    same = [(type(x), x) for x in a] == [(type(x), x) for x in b]
    assert (seeds.integer(7, *a, bits=64) == seeds.integer(7, *b, bits=64)) == same


def test_path_boundaries_and_types_matter():
    paths = [("ab", "c"), ("a", "bc"), ("abc",), ("1",), (1,), (), ("",), ("", "")]
    assert len({seeds.integer(0, *path, bits=64) for path in paths}) == len(paths)


def test_every_root_is_a_seed_of_its_own_zero_and_negative_included():
    assert len({seeds.integer(root, "a") for root in (0, 1, -1, 2**200)}) == 4


def test_stream_does_not_depend_on_what_else_was_drawn():
    alone = seeds.generator(3, "b").random(4)
    seeds.generator(3, "a").random(1000)
    np.random.random(5)  # noqa: NPY002  the global state must have no influence
    assert (seeds.generator(3, "b").random(4) == alone).all()


def test_stream_does_not_depend_on_the_process():
    code = "from tron import seeds; print(seeds.integer(5, 'x', 1, bits=64))"
    printed = subprocess.run(
        [sys.executable, "-c", code],
        env={"PYTHONHASHSEED": "12345"},
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert int(printed) == seeds.integer(5, "x", 1, bits=64)


def test_numpy_integers_name_the_same_path():
    assert seeds.integer(0, "s", np.int64(3)) == seeds.integer(0, "s", 3)  # type: ignore[arg-type]


def test_sibling_streams_are_uncorrelated():
    draws = np.stack([seeds.generator(0, "pixel", i).random(4000) for i in range(20)])
    correlation = np.corrcoef(draws) - np.eye(20)
    assert np.abs(correlation).max() < 5 / np.sqrt(4000)


@pytest.mark.parametrize("bits", [1, 8, 32, 63, 64])
def test_integers_fill_their_range(bits: int):
    values = [seeds.integer(0, i, bits=bits) for i in range(200)]
    assert 0 <= min(values) < 2**bits * 0.1
    assert 2**bits * 0.9 <= max(values) + 1 <= 2**bits


@pytest.mark.parametrize("bits", [0, 65])
def test_width_beyond_a_word_is_refused(bits: int):
    with pytest.raises(ValueError, match="bits"):
        seeds.integer(0, "a", bits=bits)
