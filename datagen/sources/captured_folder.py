"""The captures in a folder, their splits, and the folders of their path-traced truth.

``captured.relit=FOLDER`` is the folder ``relit`` of pseudo-captures: a capture folder for each capture and
light, ``NAME_1_sun``, with linear radiance, masks and the light itself as environment.exr. ``captured.truth``
is their folder ``truth``, whose maps of base color tell the scale of the reconstruction's.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from glob import escape
from pathlib import Path

from datagen.settings.captures import Shares
from datagen.settings.command import SPLITS, Settings, Split
from tron.captures import View
from tron.captures.folder import read_capture_folder
from tron.captures.formats.transforms import has_transforms
from tron.captures.photos.photo_files import SUFFIXES
from tron.errors import TronError
from tron.seeds import integer

log = logging.getLogger(__name__)

PICTURES = frozenset(SUFFIXES)
"""Suffixes of files that are counted as photos, to estimate bytes and time; what reads them decides."""

OWN = Path("captures", "manifest.json")
"""What tron-datagen's own captures have below its output_dir."""


def find_captures(settings: Settings) -> dict[str, int]:
    """Find captures, the sub-folders with pictures: name -> approximate number of photos.

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
    named = settings.captured.names or counts
    found = {name: count for name, count in counts.items() if count and name in named}
    if not found:
        raise TronError("captures holds no captures", folder, "each is a sub-folder with photos in it")
    return found


def count_photos(folder: Path) -> int:
    """Estimate the number of a capture's photos: the pictures in its folder with most of them.

    Copies of other sizes, masks and maps lie in folders of their own, and are no more than the photos.
    """
    counts = [
        sum(path.suffix.lower() in PICTURES for path in each.iterdir())
        for each in (folder, *(path for path in folder.rglob("*") if path.is_dir()))
    ]
    return max(counts)


def split_of(names: Sequence[str], shares: Shares, seed: int) -> dict[Split, list[str]]:
    """Return split -> sorted names of its captures, without empty splits.

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
    """Return split -> sorted names of its captures, by the part before the hyphen in each name.

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
    """Whether all captures are named by splits, as pseudo-captures are, and the settings ignore it."""
    heads = tuple(f"{split}-" for split in SPLITS)
    named = all(name.startswith(heads) for name in find_captures(settings))
    return named and not settings.captured.split_by_name


def apportioned(shares: Mapping[Split, float], total: int) -> dict[Split, int]:
    """Return integers that sum to ``total``, in proportion to shares: see :func:`split_of`."""
    wanted: list[Split] = sorted(
        (name for name in SPLITS if shares[name] > 0), key=lambda name: -shares[name]
    )
    counts: dict[Split, int] = {name: int(name in wanted[:total]) for name in SPLITS}
    whole = sum(shares.values())
    while sum(counts.values()) < total:
        lacking = {name: shares[name] / whole * total - counts[name] for name in wanted}
        counts[max(wanted, key=lambda name: lacking[name])] += 1
    return counts


ENVIRONMENT_NAME = "environment.exr"
MEND = "give the folder truth of pseudo-captures"
_LIGHT = re.compile(r"([1-9][0-9]{0,3})_([a-z][a-z0-9_]{0,30})")


@dataclass(frozen=True)
class RelitTruth:
    """A capture's views under one other light.

    Attributes:
        folder: a capture folder, linear, with masks.
        number: of the light among the capture's, from 1.
        family: of the light.
        views: how many there are.
    """

    folder: Path
    number: int
    family: str
    views: int

    @property
    def environment(self) -> Path:
        """Path of the light, a lat-long map."""
        return self.folder / ENVIRONMENT_NAME


def find_relit(settings: Settings, capture: str) -> list[RelitTruth]:
    """Find a capture's views under other lights, in the order of the lights; none without ``captured.relit``.

    Raises:
        TronError: no such folder, nothing of this capture in it, or a folder without its light or
            without views.
    """
    folder = settings.captured.relit
    if folder is None:
        return []
    if not folder.is_dir():
        raise TronError("captured.relit is no folder", folder, "give the folder relit of pseudo-captures")
    found = []
    for path in sorted(folder.glob(f"{escape(capture)}_*")):
        light = _LIGHT.fullmatch(path.name.removeprefix(f"{capture}_"))
        if light is not None and path.is_dir():
            found.append(RelitTruth(path, int(light[1]), light[2], _views(path)))
    if not found:
        raise TronError(
            f"captured.relit holds nothing of the capture {capture}",
            folder,
            "give the relit folder that was made with these captures, or name those it has: "
            "captured.names=[...]",
        )
    return sorted(found, key=lambda truth: truth.number)


def find_truth(settings: Settings, capture: str) -> list[View]:
    """Find true views of a capture with base color maps; none without ``captured.truth``.

    Raises:
        TronError: no such folder, nothing of this capture in it, or no such map.
    """
    if settings.captured.truth is None:
        return []
    folder = settings.captured.truth / capture
    if not folder.is_dir():
        raise TronError("captured.truth holds nothing of this capture", folder, MEND)
    views = read_capture_folder(folder).views
    mapped = [view for view in views if view.has("base_color") and view.has("mask")]
    if not mapped:
        raise TronError("no true view has base color and a mask", folder, MEND)
    return mapped


def _views(folder: Path) -> int:
    """Return the number of views in a folder; TronError if it cannot be used."""
    if not (folder / ENVIRONMENT_NAME).is_file():
        raise TronError(
            "the light of the relit views is missing", folder / ENVIRONMENT_NAME, "make them again"
        )
    return len(read_capture_folder(folder).views)
