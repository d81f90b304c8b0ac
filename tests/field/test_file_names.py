"""File names as people have them, typed as the settings of every command: no quotes but the shell's."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
from hydra.utils import get_object

from tron.cli.recipes import compose_recipe, path_value, resolve
from tron.errors import TronError

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
NAMES = (
    "/a/b (1).ply",
    "a,b.hdr",
    "~backup.ply",
    "a~1.ply",
    "a=b.ply",
    "[draft] scan.ply",
    "scan [1].ply",
    "[1]",
    "Bob's scan.ply",
    "scan {2}.ply",
    "Küche & Büro #2.ply",
    "2024",
    "1e3",
    "true",
    "a;b+c@d!.ply",
    "a`b.ply",
    'a"b.ply',
    "choice(a,b)",
    "C:\\scans\\a (1).ply",
    "s3://bucket/a?b=c,d",
)
ONE = "/x y/[a] (1), =~é.z"
"""A name that holds all of them."""

PATHS = [
    ("tron-relight", "scene", []),
    ("tron-relight", "environment", []),
    ("tron-relight", "output_dir", []),
    ("tron-relight", "cameras", []),
    ("tron-relight", "checkpoint", []),
    ("tron-reconstruct", "capture", []),
    ("tron-reconstruct", "images", []),
    ("tron-reconstruct", "prior.folder", ["prior=precomputed"]),
    ("tron-reconstruct", "prior.checkpoint", ["prior=rgbx"]),
    ("tron-datagen", "assets", []),
    ("tron-datagen", "captured.truth", []),
    ("tron-train", "dataset", []),
    ("tron-train", "loss.vgg_weights", []),
    ("tron-eval", "dataset", ["benchmark=relighting"]),
    ("tron-eval", "renderer", ["benchmark=relighting"]),
    ("tron-eval", "benchmark.real_data", ["benchmark=renderer"]),
    ("tron-eval", "+benchmark.data.synthetic_128", ["benchmark=renderer"]),
]
"""Settings of every command that are paths; what chooses the recipe that has them."""


def value_of(script: str, key: str, typed: str, *others: str) -> object:
    """What a command's setting is, of a value as it is typed."""
    command = get_object(SCRIPTS[script].replace(":", ".")).load()
    recipe = compose_recipe(command.config_module, command.settings, [*others, f"{key}={typed}"])
    found = resolve(recipe) if key.startswith("output") else recipe
    for part in key.lstrip("+").split("."):
        found = found[part]
    return found


@pytest.mark.parametrize(("script", "key", "recipe"), PATHS, ids=[f"{path[0]} {path[1]}" for path in PATHS])
def test_a_path_of_every_command_may_have_any_name(
    tmp_path: Path, script: str, key: str, recipe: list[str]
) -> None:
    path = tmp_path / ONE.lstrip("/")
    path.parent.mkdir(parents=True)
    path.touch()  # of a setting that takes several, a comma without brackets is one file where there is one
    assert value_of(script, key, str(path), *recipe) == str(path)


@pytest.mark.parametrize("name", NAMES)
def test_a_name_stands_as_it_is_typed(name: str) -> None:
    assert path_value(name, several=False) == name
    if "," not in name and not name.startswith("[1"):
        assert path_value(name, several=True) == name
        assert path_value(f"[{name}, b.hdr]", several=True) == [name, "b.hdr"]


@pytest.mark.parametrize(
    ("typed", "kept"),
    [
        ("~/scans/a (1).ply", "{home}/scans/a (1).ply"),
        ("~", "{home}"),
        (" a.ply ", "a.ply"),
        ("null", None),
        ("", None),
        ("${seed}/a", None),
        ('"a, b.ply"', None),
        ("'a, b.ply'", None),
    ],
)
def test_home_is_expanded_and_hydras_own_syntax_stays(monkeypatch, typed: str, kept: str | None) -> None:
    monkeypatch.setenv("HOME", "/home/of me")
    assert path_value(typed, several=False) == (kept and kept.format(home="/home/of me"))


@pytest.mark.parametrize(
    ("typed", "kept"),
    [
        ("[a.hdr,b.hdr]", ["a.hdr", "b.hdr"]),
        ("[a (1).hdr, ~x.hdr]", ["a (1).hdr", "~x.hdr"]),
        ('["a,b.hdr",c.hdr]', ["a,b.hdr", "c.hdr"]),
        ("a.hdr", "a.hdr"),
        ("2024.hdr", "2024.hdr"),
    ],
)
def test_lists_of_paths_are_lists(typed: str, kept: object) -> None:
    assert value_of("tron-relight", "environment", typed) == kept


@pytest.mark.parametrize("typed", ["a.hdr,b.hdr", "a (1).hdr,b.hdr"])
def test_a_comma_that_forgets_its_brackets_is_told(typed: str) -> None:
    with pytest.raises(TronError, match=r"'environment' takes one value .*: for a list write") as caught:
        value_of("tron-relight", "environment", typed)
    assert f"environment=[{typed}]" in str(caught.value)


@pytest.mark.parametrize(
    ("script", "key", "typed", "kept"),
    [
        ("tron-relight", "up", "[0,0,1]", [0, 0, 1]),
        ("tron-relight", "weights", "{pbr: 0.3, irradiance: 0.7}", {"pbr": 0.3, "irradiance": 0.7}),
        ("tron-relight", "background", "[1,1,1]", [1, 1, 1]),
        ("tron-relight", "cameras", "null", None),
        ("tron-relight", "output_dir", "out/${seed}", "out/0"),
        ("tron-train", "splits", '{train_b: "captures#train"}', {"train_b": "captures#train"}),
    ],
)
def test_other_settings_keep_hydras_grammar(script: str, key: str, typed: str, kept: object) -> None:
    assert value_of(script, key, typed) == kept


def test_a_sweep_of_another_setting_is_told_as_before() -> None:
    with pytest.raises(TronError, match="'frames' takes one value"):
        value_of("tron-relight", "frames", "1,2")
