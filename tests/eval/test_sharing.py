"""The record of frames under many lights, as the data engine writes it and the benchmark reads it."""

import json
from pathlib import Path

import numpy as np
import pytest

import eval.datagen.sharing
from eval.datagen.sharing import measure_sharing
from tron.errors import TronError
from tron.images import write_image
from tron.report.page import Table


def case(scene: str, gain: float, bias: float) -> dict:
    return {
        "scene": scene, "lights": 20, "pixels": 64, "gain": gain, "bias": bias,
        "paths": {"alone": 64, "together": 50.0},
        "seconds": {"alone": 4.0, "together": 4.0 / gain, "64": 1.0},
        "error": {"alone": 0.001, "64": 0.0008},
        "error_by_light": {"alone": [0.001, 0.002], "16": [0.1, 0.1], "64": [0.0004, 0.003]},
    }  # fmt: skip


@pytest.fixture
def engine(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Stands in for tron-datagen, which tests/datagen/test_sharing.py runs; its arguments are kept."""
    calls: list[list[str]] = []

    def wrote(arguments: list[str], output: Path) -> float:
        calls.append([*arguments])
        (output / "sharing").mkdir(parents=True)
        cases = [case("test-000000", 3.0, -0.001), case("test-000001", 5.0, 0.0005)]
        for each in cases:
            write_image(output / "sharing" / f"{each['scene']}.png", np.full((8, 20, 3), 0.5, np.float32))
        (output / "sharing.json").write_text(json.dumps({"cases": cases}))
        return 1.0

    monkeypatch.setattr(eval.datagen.sharing, "make", wrote)
    return calls


def test_the_gain_is_the_mean_over_scenes(tmp_path, engine):
    found = measure_sharing(["sharing.size=8"], tmp_path)
    assert engine == [["sharing.size=8", "mode=sharing"]]
    rows = {row.metric: row for row in found.rows(seed=0)}
    assert rows["lights.sharing_gain"].value == pytest.approx(4.0)
    assert rows["lights.sharing_gain"].scenes == 2
    assert rows["lights.worst_light_error_ratio"].value == pytest.approx(1.5)
    assert rows["lights.largest_bias"].value == pytest.approx(0.001)
    (section,) = found.sections(tmp_path / "pictures")
    table = section.blocks[0]
    assert isinstance(table, Table)
    assert [row[-1] for row in table.rows] == ["3.00 x", "5.00 x"]
    assert (tmp_path / "pictures" / "sharing-test-000001.png").is_file()


def test_a_broken_record_is_named(tmp_path, monkeypatch):
    def wrote(_arguments: list[str], output: Path) -> float:
        output.mkdir(parents=True)
        (output / "sharing.json").write_text("{}")
        return 1.0

    monkeypatch.setattr(eval.datagen.sharing, "make", wrote)
    with pytest.raises(TronError, match="not a record of shared lights"):
        measure_sharing([], tmp_path)
