"""A folder is one recipe's: another is refused by its first key, and its record survives the disk."""

import json
from pathlib import Path

import pytest
import yaml

from tron.claim import first_difference, read_recipe, require_same
from tron.errors import TronError
from tron.nested import leaves, nested_items
from tron.storage import write_if_changed

RECIPE = {"seed": 0, "train": {"scenes": 2, "lights": ["sun"]}, "rate": 1e-05, "none": None, "empty": {}}


def changed(**values) -> dict:
    return {**RECIPE, **values}


@pytest.mark.parametrize(
    ("now", "said"),
    [
        (changed(), None),
        (changed(new=None), None),
        (changed(seed=1), "seed=0, not 1"),
        (changed(train={"scenes": 2, "lights": ["sun", "sky"]}), "train.lights=['sun'], not ['sun', 'sky']"),
        (changed(train=None), "train.scenes=2, not None"),
        (changed(new=3), "new=None, not 3"),
        (changed(rate="1" * 99), f"rate=1e-05, not {'1' * 60}..."),
        ({key: value for key, value in RECIPE.items() if key != "seed"}, "seed=0, not None"),
    ],
)
def test_the_first_key_that_differs_is_named(now, said):
    assert first_difference(RECIPE, now) == said


@pytest.mark.parametrize(
    ("before", "now", "said"),
    [
        ({"a": 1}, {"a": 1, "new": 2}, None),
        ({"a": 1}, {"a": 1, "new": 3}, "new=2, not 3"),
        ({"a": 1, "new": 3}, {"a": 1, "new": 2}, "new=3, not 2"),
        ({"part": {"x": 1}}, {"part": {"x": 1, "y": 5}}, None),
        ({"part": {"x": 1}}, {"part": {"x": 1, "y": 6}}, "part.y=5, not 6"),
        ({}, {"part": {"x": 0, "y": 5}}, None),
        ({"part": None}, {"part": {"x": 0, "y": 5}}, "part.x=None, not 0"),
        ({"new": None}, {"new": 2}, "new=None, not 2"),
        ({"a": 1}, {"a": 1, "unknown": 2}, "unknown=None, not 2"),
        ({"old": 1}, {}, "old=1, not None"),
    ],
)
def test_a_key_that_an_older_recipe_lacks_has_its_default(before, now, said):
    assert first_difference(before, now, {"a": 0, "new": 2, "part": {"x": 0, "y": 5}}) == said


def test_a_refusal_is_one_line_with_folder_and_way_out(tmp_path):
    require_same(RECIPE, RECIPE, tmp_path, "a dataset")
    with pytest.raises(TronError) as caught:
        require_same(RECIPE, changed(seed=1), tmp_path, "a dataset")
    assert str(caught.value) == (
        f"output_dir holds a dataset made with seed=0, not 1 ({tmp_path}): choose another output_dir, or "
        "delete that one"
    )


@pytest.mark.parametrize(("name", "write"), [("a.json", json.dumps), ("a.yaml", yaml.safe_dump)])
def test_a_recipe_survives_the_disk(tmp_path: Path, name, write):
    assert read_recipe(tmp_path / name) is None
    (tmp_path / name).write_text(write(RECIPE))
    assert read_recipe(tmp_path / name) == RECIPE


@pytest.mark.parametrize(
    ("name", "text"), [("a.json", "{"), ("a.yaml", "[1"), ("a.yaml", "[]"), ("b.yaml", "")]
)
def test_a_damaged_record_is_said(tmp_path: Path, name, text):
    (tmp_path / name).write_text(text)
    with pytest.raises(TronError, match=f"{name} is damaged"):
        read_recipe(tmp_path / name)


def test_a_file_that_says_so_already_is_not_touched(tmp_path: Path):
    path = tmp_path / "a.txt"
    write_if_changed(path, "é")
    before = path.stat().st_mtime_ns
    write_if_changed(path, "é")
    assert path.stat().st_mtime_ns == before
    write_if_changed(path, "e")
    assert path.read_text() == "e"


def test_dotted_keys_name_every_value_parents_first():
    values = {"a": {"b": [{"c": 1}], "d": {}}, "e": None}
    assert dict(nested_items(values)) == {
        "a": values["a"], "a.b": [{"c": 1}], "a.b.0": {"c": 1}, "a.b.0.c": 1, "a.d": {}, "e": None,
    }  # fmt: skip
    assert leaves(values) == {"a.b": [{"c": 1}], "a.d": {}, "e": None}
