"""Truths that meshes beside surfels are judged by: closed forms of a table."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from eval.applications import meshes
from eval.report.outcome import Outcome
from tron.errors import TronError
from tron.shading.environments.environment import EnvironmentMap

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(meshes, "VIEW", meshes.VIEW.resized(64, 36))


def test_the_truth_of_a_table_under_an_even_light_is_its_radiance(small):
    light = EnvironmentMap(np.full((8, 16, 3), 0.7, np.float32))
    truth = meshes.Truth.of({meshes.TABLE: [meshes._slab()]}, light, 0)
    on_top = truth.number == 1
    assert 0.1 < on_top.mean() < 0.6
    np.testing.assert_allclose(truth.irradiance[on_top], 0.7, rtol=0.02)
    assert truth.lit[on_top][:, 0].mean() > 1.5 * truth.lit[on_top][:, 2].mean()  # reddish


def test_a_pixel_of_two_things_is_of_none(small):
    light = EnvironmentMap(np.full((8, 16, 3), 0.7, np.float32))
    slab = meshes._slab()
    halves = [slab.vertices * [0.5, 1, 1] + [x, 0, 0] for x in (-0.9, 0.9)]
    left, right = ([replace(slab, vertices=half)] for half in halves)
    number = meshes.Truth.of({"left": left, "right": right}, light, 0).number
    assert (number == 1).sum() > 100
    assert (number == 2).sum() > 100
    seam = (number[:, :-1] == 1) & (number[:, 1:] == 2)
    assert seam.sum() < 0.5 * (number == 1).any(1).sum()


def test_missing_data_are_one_line(tmp_path: Path):
    with pytest.raises(TronError, match="no such model"):
        meshes.measure_meshes(tmp_path, 0, Outcome(tmp_path))
