"""Progress reports of long loops."""

from __future__ import annotations

from collections.abc import Callable, Iterable

Track = Callable[[Iterable, str], Iterable]
"""Wraps long loops as ``track(items, label)``, such as :func:`tron.cli.progress.track`."""


def untracked(items: Iterable, _label: str) -> Iterable:
    """The items, without any progress report."""
    return items
