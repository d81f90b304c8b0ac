"""Splits that the user's files serve: what is tested on is never trained on."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import TypeVar

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

HELD_OUT = 4
"""Every fourth model, texture set or map of a folder is the test split's alone, where there are as many."""

Item = TypeVar("Item")


def families(contents: Sequence[Collection[str]]) -> np.ndarray:
    """Number of each thing's family, from 0 in the order of first members, (N,) int.

    Two things are of one family where they share a hash, or each shares one with a third: copies under other
    names, and models that have a texture in common.

    Args:
        contents: the hashes in each thing.
    """
    hashes = {digest: k for k, digest in enumerate(dict.fromkeys(h for each in contents for h in each))}
    rows = [i for i, each in enumerate(contents) for _ in each]
    columns = [len(contents) + hashes[h] for each in contents for h in each]
    size = len(contents) + len(hashes)
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(size, size))
    labels = connected_components(graph, directed=False)[1][: len(contents)]
    _, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[inverse]


def for_split(items: Sequence[Item], split: str, hashes: Callable[[Item], Collection[str]]) -> list[Item]:
    """The things that serve a split: of every HELD_OUT families one is the test split's; few are shared.

    Validation has those of training: to hold out more would take them from it.

    Args:
        items: in an order that does not depend on the machine.
        split: name of the split.
        hashes: what is in a thing.
    """
    if not separable(items, hashes):
        return list(items)
    numbers = families([hashes(item) for item in items])
    return [item for item, k in zip(items, numbers) if (k % HELD_OUT == HELD_OUT - 1) == (split == "test")]


def separable(items: Sequence[Item], hashes: Callable[[Item], Collection[str]]) -> bool:
    """True where there are families enough to hold some out."""
    return len(items) > 0 and int(families([hashes(item) for item in items]).max()) + 1 >= HELD_OUT
