"""The recipe that a folder of captures was made with, which no other may add to."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from datagen.settings import Settings
from tron.claim import read_recipe, require_same
from tron.cli.recipes import model_defaults
from tron.errors import TronError
from tron.storage import write_if_changed

CONFIG_NAME = "config.yaml"


def adopt_recipe(folder: Path, recipe: Mapping[str, Any], *, may_grow: tuple[str, ...] = ()) -> None:
    """Make a folder of captures this recipe's, or make sure that it is already.

    Args:
        folder: the captures'; config.yaml in it keeps the recipe.
        recipe: plain values.
        may_grow: keys that matter only where both recipes have them, such as splits.

    Raises:
        TronError: the folder was made by another recipe (names the key), or holds something else.
    """
    path, before = folder / CONFIG_NAME, read_recipe(folder / CONFIG_NAME)
    now = dict(recipe)
    if before is None:
        require_nobodys(folder)
    else:
        if "captures" in before:  # as the key was called at first
            before["capture"] = before.pop("captures")
        grown = {key: now.get(key, before.get(key)) for key in may_grow if key in now or key in before}
        same = {key for key in may_grow if key in now and key in before}
        for values in (before, now):
            for key in set(may_grow) - same:
                values.pop(key, None)
        require_same(before, now, folder, "captures", defaults=model_defaults(Settings))
        now |= grown
    write_if_changed(path, yaml.safe_dump(now, sort_keys=True, allow_unicode=True))


def require_nobodys(folder: Path) -> None:
    """Raise TronError unless a folder of captures to be made is absent or empty."""
    if folder.is_dir() and any(folder.iterdir()):
        raise TronError(
            "folder holds something else than these captures", folder, "choose another output_dir"
        )
