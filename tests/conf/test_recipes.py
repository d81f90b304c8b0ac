"""Every shipped recipe composes, holds only keys its command knows, and names classes that exist."""

import inspect
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import pytest
import yaml
from hydra.utils import get_object
from omegaconf import OmegaConf
from pydantic import BaseModel

from tron.cli.command_line import Command
from tron.cli.recipes import (
    SHARED_GROUP,
    check,
    complete,
    compose_recipe,
    field_keys,
    group_options,
    model_defaults,
    nested_model,
    resolve,
)
from tron.run_folder import leaves, nested_items

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
COMMANDS = {name.removeprefix("tron-"): target for name, target in SCRIPTS.items()}


def shipped_recipes() -> Iterator[Any]:
    """(folder, overrides) of every YAML file under conf/."""
    for path in sorted((ROOT / "conf").rglob("*.yaml")):
        folder, *group, name = path.relative_to(ROOT / "conf").with_suffix("").parts
        overrides = [f"{'/'.join(group)}={name}"] if group else []
        if folder != SHARED_GROUP:
            yield pytest.param(folder, overrides, id=str(path.relative_to(ROOT)))
            continue
        for command in yaml.safe_load(path.read_text()):
            yield pytest.param(command, [f"{folder}={name}"], id=f"{path.relative_to(ROOT)} of {command}")


def load_command(folder: str) -> Command:
    return get_object(COMMANDS[folder].replace(":", ".")).load()


def test_every_command_has_a_folder_of_recipes_and_no_folder_is_without_a_command():
    folders = {path.parent.name for path in (ROOT / "conf").glob("*/config.yaml")}
    assert folders == set(COMMANDS)


@pytest.mark.parametrize(("folder", "overrides"), shipped_recipes())
def test_a_shipped_recipe_is_valid_its_classes_exist_and_its_seeds_are_those_of_the_run(
    folder: str, overrides: list[str]
):
    """What only the user can know, names and paths, has a stand-in. No class that takes a seed is without."""
    command = load_command(folder)
    if "seed" in command.settings.model_fields:
        overrides = [*overrides, "seed=7"]
    recipe = compose_recipe(command.config_module, command.settings, overrides)
    for key, value in nested_items(OmegaConf.to_container(complete(recipe))):
        if value == "???":
            OmegaConf.update(recipe, key, "stand-in", force_add=True)
    check(recipe, command.settings)
    values = dict(nested_items(resolve(complete(recipe))))
    seeds = {key: value for key, value in values.items() if key.rpartition(".")[2] == "seed"}
    for key, value in values.items():
        if key.rpartition(".")[2] == "_target_":
            made = get_object(value)
            assert callable(made), f"{key}={value}"
            if "seed" in inspect.signature(made).parameters:
                parent = key.removesuffix("_target_")
                seeds[f"{parent}seed"] = values.get(f"{parent}seed")
    assert seeds == dict.fromkeys(seeds, 7)


FILES = [path for path in sorted((ROOT / "conf").rglob("*.yaml")) if path.parent.name != SHARED_GROUP]


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_key_is_stated_twice_with_one_value(path: Path):
    """Defaults are the model's: YAML says what differs from the model and from the YAML beneath it."""
    folder, *group, _ = path.relative_to(ROOT / "conf").with_suffix("").parts
    command = load_command(folder)
    written = yaml.safe_load(path.read_text())
    said = {key: value for key, value in written.items() if key != "defaults"}
    others = [each for each in written.get("defaults", ()) if isinstance(each, str) and each != "_self_"]
    if not group:
        beneath = OmegaConf.create(model_defaults(command.settings))
    elif "@package _global_" in path.read_text():
        overrides = [f"{'/'.join(group)}={name}" for name in others]
        beneath = complete(compose_recipe(command.config_module, command.settings, overrides))
    else:
        beneath = complete(OmegaConf.create(only_targets(said)))
    known = leaves(cast(dict, OmegaConf.to_container(beneath)))
    named = {key: value for key, value in leaves(said).items() if key.rpartition(".")[2] != "_target_"}
    assert {key: value for key, value in named.items() if key in known and known[key] == value} == {}


PAPER = {
    "relight": {
        "estimator": "plain",
        "two_sided": False,
        "denoise": False,
        "bounces": 0,
        "reflections": 0,
        "supersample": 1,
        "brdf": "lambert",
        "look": "none",
        "ground": "none",
        "proxy": "never",
        "projection": "disks",
    },
    "datagen": {"estimator": "plain", "two_sided": False, "brdf": "lambert", "bounces": 0},
    "reconstruct": {
        "light.estimator": "plain",
        "light.two_sided": False,
        "light.brdf": "lambert",
        "light.coarsest": 64,
        "radiance.exposures": False,
    },
    "train": {"renderer.config.guidance": ["pbr", "irradiance"]},
    "eval": {},
    "edit": {},
    "bake": {},
    "environment": {},
    "export": {},
    "view": {},
}


@pytest.mark.parametrize("folder", sorted(COMMANDS))
def test_the_papers_fidelity_sets_its_own_choices_and_nothing_else(folder: str):
    command = load_command(folder)
    options = group_options(command.config_module)
    assert list(options.get(SHARED_GROUP, {})) == (["paper"] if PAPER[folder] else [])
    recipes = [
        leaves(resolve(complete(compose_recipe(command.config_module, command.settings, overrides))))
        for overrides in ([], [f"{SHARED_GROUP}=paper"] if PAPER[folder] else [])
    ]
    assert {key: value for key, value in recipes[1].items() if recipes[0][key] != value} == PAPER[folder]


def only_targets(values: dict[str, Any]) -> dict[str, Any]:
    """What a file of one object would be if it said nothing but the classes."""
    inner = {name: only_targets(value) for name, value in values.items() if isinstance(value, dict)}
    named = {"_target_": values["_target_"]} if "_target_" in values else {}
    return named | {name: value for name, value in inner.items() if value}


@pytest.mark.parametrize("folder", sorted(COMMANDS))
def test_every_setting_can_be_set_from_the_command_line(folder: str):
    """A field that its YAML leaves out would be an unknown key to Hydra."""
    command = load_command(folder)
    values = OmegaConf.to_container(compose_recipe(command.config_module, command.settings))
    written = {key for key, _ in nested_items(values)}
    optional = {
        key for key, value in nested_items(values) if value is None
    }  # a nested model that is left out
    missing = set(field_keys(command.settings)) - written
    assert {key for key in missing if key.rpartition(".")[0] not in optional} == set()


@pytest.mark.parametrize("folder", sorted(COMMANDS))
def test_every_setting_is_described(folder: str):
    command = load_command(folder)
    assert undescribed(command.settings) == []
    assert len(command.examples) >= 2


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_recipe_names_a_folder_beside_the_checkout(path: Path):
    assert "../" not in path.read_text("utf-8")


def undescribed(model: type[BaseModel], prefix: str = "") -> list[str]:
    names = []
    for name, field in model.model_fields.items():
        inner = nested_model(field.annotation)
        if inner is not None:
            names += undescribed(inner, f"{prefix}{name}.")
        elif not field.description:
            names.append(prefix + name)
    return names


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_the_line_that_help_shows_is_a_whole_sentence(path: Path):
    """Help shows the first line of a file's comment alone."""
    lines = [line for line in path.read_text("utf-8").splitlines() if not line.startswith("# @package")]
    if lines and lines[0].startswith("#") and lines[1].startswith("#"):
        assert lines[0].endswith((".", ")", ":")), lines[0]


@pytest.mark.parametrize("folder", sorted(COMMANDS))
def test_every_group_option_says_what_it_is_for(folder: str):
    options = group_options(load_command(folder).config_module)
    assert [f"{group}={name}" for group in options for name, said in options[group].items() if not said] == []
