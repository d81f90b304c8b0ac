"""How long loops say how far they have come."""

from __future__ import annotations

from collections.abc import Callable, Iterable

Track = Callable[[Iterable, str], Iterable]
"""Wraps long loops as ``track(items, label)``, such as :func:`tron.cli.progress.track`."""


def untracked(items: Iterable, _label: str) -> Iterable:
    """The items, without any word of how far the work on them has come."""
    return items
