"""Schema of results.json, and what the file refuses to hold."""

import json
from pathlib import Path

import pydantic
import pytest

from eval.results import Results, Row, Target, portable
from tron.errors import TronError


def row(metric: str = "neural.psnr", value: float = 30.0, unit: str = "dB") -> Row:
    return Row(metric=metric, value=value, unit=unit, n=3)


def test_the_file_has_exactly_the_keys_of_the_schema(tmp_path: Path):
    Results(benchmark="demo", environment={"cores": 2}, rows=[row()]).save(tmp_path / "results.json")
    written = json.loads((tmp_path / "results.json").read_text())
    assert set(written) == {"benchmark", "environment", "rows"}
    assert written["rows"] == [
        {"metric": "neural.psnr", "value": 30.0, "unit": "dB", "reference": None, "ratio": None, "n": 3}
    ]
    assert Results.load(tmp_path / "results.json").value("neural.psnr") == 30.0


def test_metric_names_are_unique():
    with pytest.raises(pydantic.ValidationError, match="appears twice"):
        Results(benchmark="demo", environment={}, rows=[row(), row(value=31.0)])


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_row_holds_finite_values_only(value: float):
    with pytest.raises(pydantic.ValidationError):
        row(value=value)


def test_rows_added_later_are_checked_when_written(tmp_path: Path):
    results = Results(benchmark="demo", environment={}, rows=[row()])
    results.rows.append(row())
    with pytest.raises(ValueError, match="twice"):
        results.save(tmp_path / "results.json")
    assert not list(tmp_path.iterdir())


def test_targets_become_references_and_ratios():
    target = Target(metric="neural.psnr", bound="at least", value=25.0)
    held = Results(benchmark="demo", environment={}, rows=[row(), row("pbr.psnr")]).held_to([target])
    assert held.rows[0].reference == "target: at least 25 dB"
    assert held.rows[0].ratio == pytest.approx(30 / 25)
    assert held.rows[1].reference is None
    assert held.rows[1].ratio is None


@pytest.mark.parametrize(
    "bound, value, reached", [("at least", 30.0, True), ("at least", 30.001, False), ("at most", 29.9, False)]
)
def test_a_bound_is_judged_on_the_unrounded_value(bound: str, value: float, reached: bool):
    target = Target(metric="neural.psnr", bound=bound, value=value)  # type: ignore[arg-type]
    assert target.reached(30.0) is reached
    assert (target.margin(30.0) >= 0) is reached


@pytest.mark.parametrize("text", ["", "[]", '{"benchmark": "demo", "environment": {}, "rows": [{}]}'])
def test_a_damaged_file_is_refused_in_one_line(tmp_path: Path, text: str):
    (tmp_path / "results.json").write_text(text)
    with pytest.raises(TronError, match=r"not a results\.json"):
        Results.load(tmp_path / "results.json")
    with pytest.raises(TronError, match="cannot read"):
        Results.load(tmp_path / "absent.json")


def test_rows_name_no_folder_of_a_machine() -> None:
    """Neither those that are written nor those that the documentation holds."""
    typed = "tron-eval 'a.b=[/work/runs/x/net.safetensors,y/z]' c=/home/me/data d=https://x.org/a/b km/h"
    assert portable({"a": [typed, 1, None]}) == {
        "a": ["tron-eval 'a.b=[x/net.safetensors,y/z]' c=me/data d=https://x.org/a/b km/h", 1, None]
    }
    for path in (Path(__file__).parents[2] / "docs" / "benchmarks").rglob("*.json"):
        content = json.loads(path.read_text())
        assert portable(content) == content, path
