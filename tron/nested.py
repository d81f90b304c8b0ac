"""Nested plain values, such as settings, by their dotted keys."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any


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
