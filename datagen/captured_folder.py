"""The captures in a folder, and which split each of them is in."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from datagen.captured_settings import Shares
from datagen.settings import SPLITS, Settings, Split
from tron.captures.photo_files import SUFFIXES
from tron.captures.transforms import has_transforms
from tron.errors import TronError
from tron.seeds import integer

log = logging.getLogger(__name__)

PICTURES = frozenset(SUFFIXES)
"""Suffixes of files that are counted as photos, to estimate bytes and time; what reads them decides."""

OWN = Path("captures", "manifest.json")
"""What tron-datagen's own captures have below its output_dir."""


@dataclass(frozen=True)
class FoundCapture:
    """A folder of photos.

    Attributes:
        name: of the folder.
        photos: about how many it holds.
    """

    name: str
    photos: int


def find_captures(settings: Settings) -> list[FoundCapture]:
    """Captures in a folder, by name: its sub-folders that hold pictures, hidden ones left out.

    Raises:
        TronError: no such folder, one that is a capture itself, no captures in it, or one that is asked for
            by name and is not there.
    """
    folder = settings.captures
    assert folder is not None
    if not folder.is_dir():
        raise TronError("captures is no folder", folder, "give the local folder that holds them")
    if settings.output_dir.resolve().is_relative_to(folder.resolve()):
        raise TronError(
            "output_dir lies in captures, whose sub-folders are captures", settings.output_dir, "give another"
        )
    if (folder / OWN).is_file():
        raise TronError("captures lie one folder down", folder, f"give captures={folder / OWN.parent}")
    if has_transforms(folder) or (folder / "sparse").is_dir():
        raise TronError(
            "captures is a capture itself", folder, "give the folder that holds it: one capture a sub-folder"
        )
    try:
        counts = {
            path.name: count_photos(path)
            for path in sorted(folder.iterdir())
            if path.is_dir() and not path.name.startswith(".")
        }
    except OSError as error:
        raise TronError(f"captures cannot be read: {error.strerror}", folder) from error
    for name in settings.captured.names:
        if not counts.get(name):
            raise TronError("no such capture", folder / name, f"captured.names takes sub-folders of {folder}")
    found = [
        FoundCapture(name, count)
        for name, count in counts.items()
        if count and (not settings.captured.names or name in settings.captured.names)
    ]
    if not found:
        raise TronError("captures holds no captures", folder, "each is a sub-folder with photos in it")
    return found


def count_photos(folder: Path) -> int:
    """About how many photos a capture has: its pictures in the folder that has most of them.

    Copies of other sizes, masks and maps lie in folders of their own, and are no more than the photos.
    """
    counts = [
        sum(path.suffix.lower() in PICTURES for path in each.iterdir())
        for each in (folder, *(path for path in folder.rglob("*") if path.is_dir()))
    ]
    return max(counts)


def split_of(names: Sequence[str], shares: Shares, seed: int) -> dict[Split, list[str]]:
    """Split -> names of its captures, sorted; those of a split with none are not there.

    Captures stand in an order drawn by (seed, name), and are cut where the shares say, to the nearest whole
    numbers (largest remainders). A split with a share has one at least where there are as many captures as
    such splits; where there are fewer, the largest shares come first.

    >>> {k: len(v) for k, v in split_of(list("abcdefghij"), Shares(), seed=0).items()}
    {'train': 8, 'validation': 1, 'test': 1}
    """
    wanted: dict[Split, float] = {split: getattr(shares, split) for split in SPLITS}
    counts = apportioned(wanted, len(names))
    order = sorted(names, key=lambda name: (integer(seed, "captured", "split", name, bits=64), name))
    found: dict[Split, list[str]] = {}
    begin = 0
    for split in SPLITS:
        if counts[split]:
            found[split] = sorted(order[begin : begin + counts[split]])
            begin += counts[split]
    return found


def split_by_name(names: Sequence[str]) -> dict[Split, list[str]]:
    """Split -> names of its captures, sorted, by what stands before the hyphen in each.

    Raises:
        TronError: a name that begins with no split's.
    """
    found: dict[Split, list[str]] = {}
    for split in SPLITS:
        if own := sorted(name for name in names if name.startswith(f"{split}-")):
            found[split] = own
    if others := sorted(set(names).difference(*found.values())):
        raise TronError(
            f"captured.split_by_name, but the capture {others[0]} begins with no split's name",
            mend=f"rename it, such as train-{others[0]}, or leave captured.split_by_name out",
        )
    return found


def named_by_split(settings: Settings) -> bool:
    """Whether all captures are named by splits, as pseudo-captures are, and the settings take no note."""
    names = [each.name for each in find_captures(settings)]
    heads = tuple(f"{split}-" for split in SPLITS)
    return not settings.captured.split_by_name and all(name.startswith(heads) for name in names)


def apportioned(shares: Mapping[Split, float], total: int) -> dict[Split, int]:
    """Whole numbers that sum to ``total``, in proportion to shares: see :func:`split_of`."""
    wanted: list[Split] = sorted(
        (name for name in SPLITS if shares[name] > 0), key=lambda name: -shares[name]
    )
    counts: dict[Split, int] = {name: int(name in wanted[:total]) for name in SPLITS}
    whole = sum(shares.values())
    while sum(counts.values()) < total:
        lacking = {name: shares[name] / whole * total - counts[name] for name in wanted}
        counts[max(wanted, key=lambda name: lacking[name])] += 1
    return counts
