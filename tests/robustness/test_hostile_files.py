"""Hostile files cost a line, a second and 200 MB; nothing in them is executed."""

from pathlib import Path

import pytest

from eval.cli import Settings
from eval.datagen import hostile
from eval.datagen.hostile import Attempt, Hostile, measure_hostile
from eval.datagen.hostile_files import GOOD, hostile_files
from tron.cli.recipes import compose_recipe
from tron.errors import TronError

KINDS = list(hostile_files())


def only(kind: str, *names: str):
    """The files of one kind, or some of them."""
    files = hostile_files()[kind]
    return lambda: {kind: {name: files[name] for name in names or files}}


@pytest.mark.parametrize("kind", KINDS)
def test_a_hostile_file_is_refused_in_a_line_a_second_and_little_memory(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hostile, "hostile_files", only(kind))
    found = measure_hostile(tmp_path)
    assert len(found.attempts) == len(hostile_files()[kind]) - 1
    assert [(each.what, each.problem()) for each in found.attempts if each.problem()] == []


def test_a_reader_that_refuses_everything_has_refused_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = hostile_files()["recipe"]
    files[GOOD] = files["no mapping"]
    monkeypatch.setattr(hostile, "hostile_files", lambda: {"recipe": files})
    with pytest.raises(TronError, match="a good recipe is refused"):
        measure_hostile(tmp_path)


def test_only_one_cheap_line_without_execution_counts() -> None:
    good = {"said": "no", "seconds": 0.1, "megabytes": 3.0, "executed": False}
    assert Attempt("a", "b", **good).problem() is None
    bad = ({"said": None}, {"said": "two\nlines"}, {"seconds": 1.5}, {"megabytes": 201.0}, {"executed": True})
    for change in bad:
        assert Attempt("a", "b", **{**good, **change}).problem() is not None
    rows = Hostile([Attempt("a", "b", **good), Attempt("a", "c", **{**good, "executed": True})]).rows(0)
    assert {row.metric: (row.value, row.n) for row in rows}["hostile.refused"] == (1, 2)


def test_the_benchmark_asks_for_every_listed_file() -> None:
    recipe = compose_recipe("conf.eval", Settings, ["benchmark=datagen", "output_dir=x"])
    wanted = {each["metric"]: each["value"] for each in recipe["benchmark"]["targets"]}
    assert wanted["hostile.refused"] == sum(len(files) - 1 for files in hostile_files().values())
