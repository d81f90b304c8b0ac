"""Folder that a split of a training run is read from, as it is typed."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SplitPlace:
    """A dataset's folder or URL, and the names of those of its splits that are one here."""

    folder: str
    splits: tuple[str, ...]

    @classmethod
    def parse(cls, name: str, value: str) -> SplitPlace:
        """Place of the split that a run calls ``name``: FOLDER or FOLDER#SPLIT or FOLDER#SPLIT+SPLIT.

        Raises:
            ValueError: it is none of these, or names a split twice.
        """
        folder, mark, joined = value.rpartition("#")
        splits = tuple(joined.split("+")) if mark else (name,)
        place = cls(folder if mark else value, splits)
        if not place.folder or not all(splits) or len(set(splits)) < len(splits):
            raise ValueError(f"{name}={value!r} is neither FOLDER nor FOLDER#SPLIT, nor FOLDER#SPLIT+OTHER")
        return place
