"""Claiming a folder for a recipe: what it holds was made with the same one, or the run is refused.

Results of two recipes are never mixed in a folder. What it was made with lies in it as YAML or JSON.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from tron.errors import TronError
from tron.nested import leaves

CHOOSE_ANOTHER = "choose another output_dir, or delete that one"
SHOWN_CHARACTERS = 60
"""Characters of a value in a message."""


def first_difference(
    before: Mapping[str, Any], now: Mapping[str, Any], defaults: Mapping[str, Any] | None = None
) -> str | None:
    """The first key in which two recipes (nested plain values) differ, as `key=old, not new`; None if none.

    A key that `before` lacks is younger than that recipe, and has its default; without one, a key that one of
    the two lacks counts as null.
    """
    old, new = leaves(_completed(before, now, defaults or {})), leaves(now)
    for key in dict.fromkeys((*new, *old)):
        if old.get(key) != new.get(key):
            return f"{key}={_shown(old.get(key))}, not {_shown(new.get(key))}"
    return None


def require_same(
    before: Mapping[str, Any],
    now: Mapping[str, Any],
    where: Path,
    what: str,
    mend: str = CHOOSE_ANOTHER,
    defaults: Mapping[str, Any] | None = None,
) -> None:
    """Refuse a folder whose contents were made with another recipe.

    Args:
        before: the recipe of what is there, nested plain values.
        now: the recipe that is asked for.
        where: the folder or file.
        what: what is there, such as "a dataset".
        mend: what the user can do.
        defaults: values of keys that an older program did not write, as `tron.cli.recipes.model_defaults`
            gives them.

    Raises:
        TronError: the recipes differ; it names the first key.
    """
    difference = first_difference(before, now, defaults)
    if difference is not None:
        raise TronError(f"output_dir holds {what} made with {difference}", where, mend)


def read_recipe(path: Path) -> dict[str, Any] | None:
    """Recipe that was kept as YAML or JSON; None where there is no such file.

    Raises:
        TronError: the file is unreadable or holds no mapping.
    """
    if not path.is_file():
        return None
    try:
        text = path.read_text("utf-8")
        # YAML takes JSON's 1e-05 for a word.
        recipe = json.loads(text) if path.suffix == ".json" else yaml.safe_load(text)
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise TronError(f"{path.name} is damaged", path, CHOOSE_ANOTHER) from error
    if not isinstance(recipe, dict):
        raise TronError(f"{path.name} is damaged: it holds no settings", path, CHOOSE_ANOTHER)
    return recipe


def _completed(
    before: Mapping[str, Any], now: Mapping[str, Any], defaults: Mapping[str, Any]
) -> dict[str, Any]:
    """`before` with the defaults of what only `now` has, at every depth that all three reach."""
    completed = dict(before)
    for key in now.keys() & defaults.keys():
        if key not in before:
            completed[key] = defaults[key]
        elif all(isinstance(each[key], Mapping) for each in (before, now, defaults)):
            completed[key] = _completed(before[key], now[key], defaults[key])
    return completed


def _shown(value: Any) -> str:
    text = str(value)
    return text if len(text) <= SHOWN_CHARACTERS else text[:SHOWN_CHARACTERS] + "..."
