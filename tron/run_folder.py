"""One run folder for every command: results of two recipes are never mixed in it, and a run goes on there."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from tron.errors import TronError
from tron.storage import write_if_changed

CHOOSE_ANOTHER = "choose another output_dir, or delete that one"
HASH = re.compile(r"[0-9a-f]{64}\b")
SHOWN_CHARACTERS = 60
"""Characters of a value in a message."""


def first_difference(before: Mapping[str, Any], now: Mapping[str, Any]) -> str | None:
    """The first key in which two recipes (nested plain values) differ, as `key=old, not new`; None if none.

    Of a file that is known by its hash the user's key is named: `another scene (sha256 ...)`.
    A key that one of the two lacks counts as null.
    """
    old, new = leaves(before), leaves(now)
    for key in dict.fromkeys((*new, *old)):
        if old.get(key) != new.get(key) and not ("sha256" in key and not old.get(key) and not new.get(key)):
            return _difference(key, old.get(key), new.get(key))
    return None


class RunFolder:
    """A folder of results: claimed by a recipe, kept as YAML or JSON in it, refused to any other, resumed.

    A recipe is nested plain values. The folder itself is locked with `tron.storage.locked`; what is finished
    in it is there under its own name, for files appear whole or not at all.

    Args:
        folder: it need not exist yet.
        what: the results in a message, such as "a dataset".
        record: name of the file that keeps the recipe.
        mend: what the user can do where the folder is another recipe's.
    """

    def __init__(
        self,
        folder: Path,
        what: str = "a run",
        record: str = "config.yaml",
        mend: str = CHOOSE_ANOTHER,
    ) -> None:
        self.folder, self.what, self.record, self.mend = folder, what, folder / record, mend

    def recipe(self) -> dict[str, Any] | None:
        """Recipe that the results were made with; None where no record is there.

        Raises:
            TronError: the record is unreadable or holds no mapping.
        """
        if not self.record.is_file():
            return None
        try:
            text = self.record.read_text("utf-8")
            # YAML takes JSON's 1e-05 for a word.
            found = json.loads(text) if self.record.suffix == ".json" else yaml.safe_load(text)
        except (OSError, ValueError, yaml.YAMLError) as error:
            raise TronError(f"{self.record.name} is damaged", self.record, CHOOSE_ANOTHER) from error
        if not isinstance(found, dict):
            damage = f"{self.record.name} is damaged: it holds no settings"
            raise TronError(damage, self.record, CHOOSE_ANOTHER)
        return found

    def difference(self, now: Mapping[str, Any], before: Mapping[str, Any] | None = None) -> str | None:
        """The first key in which the folder's recipe (or `before`) differs; None too where it has none."""
        before = self.recipe() if before is None else before
        return None if before is None else first_difference(before, now)

    def require(self, now: Mapping[str, Any], before: Mapping[str, Any] | None = None) -> None:
        """Raise TronError, naming the first key that differs, where the results are another recipe's.

        Args:
            now: the recipe that is asked for.
            before: the recipe of what is there, where it is not the record as it stands.
        """
        difference = self.difference(now, before)
        if difference is not None:
            raise TronError(f"output_dir holds {self.what} made with {difference}", self.folder, self.mend)

    def require_empty(self) -> None:
        """Raise TronError where the folder holds anything."""
        if self.folder.is_dir() and any(self.folder.iterdir()):
            raise TronError(
                f"folder holds something else than {self.what}", self.folder, "choose another output_dir"
            )

    def claim(self, recipe: Mapping[str, Any], may_grow: Sequence[str] = ()) -> None:
        """Make the folder this recipe's, or make sure that it is already.

        Args:
            recipe: what the results are made with.
            may_grow: keys that matter only where both recipes have them, such as splits; all are kept.

        Raises:
            TronError: the folder is another recipe's, or holds files and no record.
        """
        before = self.recipe()
        if before is None:
            self.require_empty()
        else:
            loose = {key for key in may_grow if key not in recipe or key not in before}
            then, now = ({key: each[key] for key in each if key not in loose} for each in (before, recipe))
            self.require(now, then)
            recipe = {**{key: before[key] for key in loose & before.keys()}, **recipe}
        self.keep(recipe, sort_keys=True)

    def keep(self, recipe: Mapping[str, Any], sort_keys: bool = False) -> None:
        """Write the record, unless it says that already."""
        if self.record.suffix == ".json":
            text = json.dumps(recipe, indent=1) + "\n"
        else:
            text = yaml.safe_dump(dict(recipe), sort_keys=sort_keys, allow_unicode=True)
        write_if_changed(self.record, text)

    def clear(self, *patterns: str) -> None:
        """Delete the files that have these names (shell patterns): results of a run that is begun anew."""
        for path in [path for pattern in patterns for path in self.folder.glob(pattern)]:
            path.unlink()

    def has(self, *names: str) -> bool:
        """Whether all these files are there, and hence whole."""
        return all((self.folder / name).is_file() for name in names)


def _difference(key: str, old: Any, new: Any) -> str:
    if not any(HASH.match(str(value)) for value in (old, new)):
        return f"{key}={_shown(old)}, not {_shown(new)}"
    then, now = (str(value)[:12] if value else "none" for value in (old, new))
    return f"another {re.sub('[_.]sha256', '', key)} (sha256 {then}, not {now})"


def _shown(value: Any) -> str:
    text = str(value)
    return text if len(text) <= SHOWN_CHARACTERS else text[:SHOWN_CHARACTERS] + "..."


def nested_items(values: Any, prefix: str = "", lists: bool = True) -> Iterator[tuple[str, Any]]:
    """Every dotted key of nested mappings, and of lists (`stages.0.steps`), with its value; parents first."""
    if isinstance(values, Mapping):
        pairs = values.items()
    elif lists and isinstance(values, list):
        pairs = enumerate(values)
    else:
        return
    for name, value in pairs:
        yield f"{prefix}{name}", value
        yield from nested_items(value, f"{prefix}{name}.", lists)


def leaves(values: Mapping[str, Any]) -> dict[str, Any]:
    """Dotted key -> value of everything in nested mappings that is no mapping, or an empty one."""
    pairs = nested_items(values, lists=False)
    return {key: value for key, value in pairs if not (isinstance(value, Mapping) and value)}
