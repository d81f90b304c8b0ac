"""A folder is one recipe's: another is refused by its first key, and its record survives the disk."""

from pathlib import Path

import pytest

from tron.errors import TronError
from tron.run_folder import RunFolder, first_difference, leaves, nested_items
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


def test_a_hash_is_told_by_the_key_that_names_its_file():
    before = {
        "scene_sha256": "a" * 64,
        "splits_sha256": {"train_b": "c" * 64 + "#photos"},
        "capture": "e" * 64,
    }
    for now, said in (
        ({"scene_sha256": "b" * 64}, f"another scene (sha256 {'a' * 12}, not {'b' * 12})"),
        (
            {"splits_sha256": {"train_b": "d" * 64}},
            f"another splits.train_b (sha256 {'c' * 12}, not {'d' * 12})",
        ),
        ({"capture": "f" * 64}, f"another capture (sha256 {'e' * 12}, not {'f' * 12})"),
        ({"start_from_sha256": "b" * 64}, f"another start_from (sha256 none, not {'b' * 12})"),
    ):
        assert first_difference(before, before | now) == said


def test_a_refusal_is_one_line_with_folder_and_way_out(tmp_path):
    folder = RunFolder(tmp_path, "a dataset")
    folder.require(RECIPE)
    folder.keep(RECIPE)
    folder.require(RECIPE)
    with pytest.raises(TronError) as caught:
        folder.require(changed(seed=1))
    assert str(caught.value) == (
        f"output_dir holds a dataset made with seed=0, not 1 ({tmp_path}): choose another output_dir, or "
        "delete that one"
    )


def test_a_recipe_survives_the_disk(tmp_path: Path):
    for name in ("a.json", "a.yaml"):
        folder = RunFolder(tmp_path, record=name)
        assert folder.recipe() is None
        folder.keep(RECIPE)
        assert folder.recipe() == RECIPE


def test_results_are_there_or_cleared_and_a_folder_of_others_is_no_new_one(tmp_path: Path):
    folder = RunFolder(tmp_path / "run", "captures")
    folder.require_empty()
    folder.keep(RECIPE)
    (folder.folder / "0.png").touch()
    assert folder.has("config.yaml", "0.png")
    assert not folder.has("0.png", "1.png")
    folder.clear("*.png", "absent")
    assert [path.name for path in folder.folder.iterdir()] == ["config.yaml"]
    with pytest.raises(TronError, match="folder holds something else than captures"):
        folder.require_empty()


@pytest.mark.parametrize(
    ("name", "text"), [("a.json", "{"), ("a.yaml", "[1"), ("a.yaml", "[]"), ("b.yaml", "")]
)
def test_a_damaged_record_is_said(tmp_path: Path, name, text):
    (tmp_path / name).write_text(text)
    with pytest.raises(TronError, match=f"{name} is damaged"):
        RunFolder(tmp_path, record=name).recipe()


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


@pytest.mark.parametrize(
    ("before", "now", "said"),
    [
        ({"part": None}, {"part": {"x": 0}}, "part.x=None, not 0"),
        ({"a": 1}, {"a": 1, "new": 2}, "new=None, not 2"),
        ({"a": 1}, {"a": 1, "new": None}, None),
        ({"old": 1}, {}, "old=1, not None"),
    ],
)
def test_a_key_that_one_of_two_recipes_lacks_counts_as_null(before, now, said):
    assert first_difference(before, now) == said
