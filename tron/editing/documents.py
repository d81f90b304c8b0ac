"""YAML of edits and motions: read, and refused in one line."""

from __future__ import annotations

from collections.abc import Callable, Collection
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from tron.errors import TronError

_SHOWN = 60


def read_yaml(path: Path, mend: str) -> Any:
    """Plain values of a file; ``mend`` says what it should be.

    Raises:
        TronError: no such file, or no YAML.
    """
    try:
        return yaml.safe_load(path.read_text("utf-8"))
    except OSError as error:
        raise TronError(f"cannot read: {error.strerror or error}", path) from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # also of numbers and dates
        reason = str(getattr(error, "problem", None) or "not text")
        raise TronError(f"not YAML: {reason}", path, mend) from error


def in_one_line(error: ValidationError, where: str, known: Collection[str], below: int = 0) -> TronError:
    """The first mistake of a document, with its key.

    Args:
        error: of pydantic.
        where: file, and place in it.
        known: all keys that there are, to guess the one that was meant.
        below: parts of a mistake's place that no file has, such as the kind of an edit.
    """
    errors = error.errors()
    # A misspelt key often leaves a second error behind, of the key that was meant. What may be of several
    # types fails as each of them: the error furthest inside says most.
    first = max(errors, key=lambda each: (each["type"] == "extra_forbidden", len(each["loc"])))
    key = ".".join(str(part) for part in first["loc"][below:] if _is_key(part))
    if first["type"] == "extra_forbidden":
        key_given = str(first["loc"][-1])
        near = get_close_matches(key_given, sorted(set(known) - {key_given}), n=1)
        return TronError(f"unknown key '{key}'", where, f"did you mean '{near[0]}'?" if near else None)
    reason = first["msg"].removeprefix("Value error, ")
    if first["type"] == "value_error":
        return TronError(reason, where)
    if first["type"] == "missing":
        return TronError(f"'{key}' has no value", where)
    shown = repr(first["input"])
    shown = shown if len(shown) <= _SHOWN else f"{shown[:_SHOWN]}..."
    return TronError(f"wrong value for '{key}': {shown}", where, reason[:1].lower() + reason[1:])


def _is_key(part: int | str) -> bool:
    """Whether a part of an error's place is written in the file: names of types are pydantic's."""
    return isinstance(part, int) or (part.islower() and part.isidentifier() and part not in ("float", "int"))


def with_paths(data: Any, changed: Callable[[str], str]) -> Any:
    """Plain values of a document whose files (of ``insert``, of masks, of lights) have other paths."""
    try:
        return _with_paths(data, changed)
    except RecursionError:
        raise TronError("the file holds itself", mend="leave out anchors that lead back") from None


def _with_paths(data: Any, changed: Callable[[str], str]) -> Any:
    if isinstance(data, list):
        return [_with_paths(each, changed) for each in data]
    if not isinstance(data, dict):
        return data
    result = {name: _with_paths(value, changed) for name, value in data.items()}
    for name in ("file", "environment"):
        if isinstance(result.get(name), str):
            result[name] = changed(result[name])
    if isinstance(result.get("masks"), dict):
        masks = result["masks"].items()
        result["masks"] = {k: changed(path) if isinstance(path, str) else path for k, path in masks}
    return result
