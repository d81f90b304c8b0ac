"""The command that makes a dataset, as typed."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf

from datagen.settings.captures import CapturedSettings
from datagen.settings.command import OUTSIDE, Settings
from tron.cli.recipes import complete, compose_recipe, group_options
from tron.run_folder import leaves


def command_line(settings: Settings, output_dir: str, only: Sequence[str] = (), machine: bool = True) -> str:
    """Return the command that makes a dataset, with every key that differs from the shipped configuration.

    It does not lean on recipes, whose content may change. ``output_dir`` and ``only`` are the caller's;
    without ``machine`` it leaves out what decides nothing of the content: cluster and workers.
    """
    groups, values, shipped = COMPARED[settings.source](settings)
    values |= {"output_dir": output_dir, "only": list(only)}
    if not machine:
        values = {key: value for key, value in values.items() if key not in OUTSIDE}
        values |= {"output_dir": output_dir}
    defaults, wanted = leaves(shipped), leaves(values)
    parents = {key.rsplit(".", 1)[0] for key in defaults if "." in key}
    folded, words = _folded(wanted, defaults), ["tron-datagen", *groups]
    for key, value in folded.items():
        if key not in defaults and key not in parents:
            words.append(f"+{key}={_hydra(value)}")
        elif defaults.get(key, ...) != value:
            words.append(f"{key}={_hydra(value)}")
    # A cluster of another kind has other options: those of the shipped one must go.
    inside = {key.rsplit(".", 1)[0] for key in wanted if "." in key}
    words += [f"~{key}" for key in defaults if key not in folded and key.rsplit(".", 1)[0] in inside]
    return " ".join(shlex.quote(word) for word in words)


def _synthetic(settings: Settings) -> tuple[list[str], dict[str, Any], dict[str, Any]]:
    """Groups to choose, values, and those that are shipped; what ``captured`` holds is nobody's."""
    shipped = _plain(compose_recipe("conf.datagen", Settings, []))
    return [], settings.model_dump(mode="json") | {"captured": shipped["captured"]}, shipped


def _captured(settings: Settings) -> tuple[list[str], dict[str, Any], dict[str, Any]]:
    """The same of captures, whose prior is a group and whose seeds follow from the dataset's."""
    groups, values = _prior_group(settings), settings.model_dump(mode="json")
    for part in ("reconstruction", "light"):
        values["captured"][part]["seed"] = "${seed}"  # as it is shipped: each capture has its own
    return groups, values, _plain(complete(compose_recipe("conf.datagen", Settings, groups)))


COMPARED = {"synthetic": _synthetic, "captured": _captured}
"""Source -> what its values are compared with."""


def _plain(recipe: DictConfig) -> dict[str, Any]:
    return cast(dict, OmegaConf.to_container(recipe, resolve=False))


def _prior_group(settings: Settings) -> list[str]:
    """Return the override that chooses the prior, if it is shipped and not the default."""
    target = settings.captured.prior["_target_"]
    if target == CapturedSettings().prior["_target_"]:
        return []
    for name in group_options("conf.datagen")["prior"]:
        shipped = compose_recipe("conf.datagen", Settings, [f"prior={name}"])
        if shipped.captured.prior["_target_"] == target:
            return [f"prior={name}"]
    return []


def _folded(wanted: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """The leaves; a mapping in a plain value's place stays whole, for nothing can be added under that."""
    folded: dict[str, Any] = {}
    for key, value in wanted.items():
        parent, _, name = key.rpartition(".")
        if defaults.get(parent) is not None:
            folded.setdefault(parent, {})[name] = value
        else:
            folded[key] = value
    return folded


def _hydra(value: Any) -> str:
    """Format a value in the grammar of Hydra's overrides."""
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{name}:{_hydra(item)}" for name, item in value.items()) + "}"
    if isinstance(value, str):
        plain = value != "" and all(c.isalnum() or c in "_-./" for c in value)
        return value if plain else json.dumps(value)
    if isinstance(value, list):
        return "[" + ",".join(_hydra(item) for item in value) + "]"
    return json.dumps(value)
