"""Folder that a split of a training run is read from, as it is typed."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SplitPlace:
    """A dataset's folder or URL, and the name of one of its splits, or several joined by +."""

    folder: str
    split: str

    @classmethod
    def parse(cls, name: str, value: str) -> SplitPlace:
        """Place of the split that a run calls ``name``: FOLDER or FOLDER#SPLIT+SPLIT..., else ValueError."""
        folder, mark, split = value.rpartition("#")
        place = cls(folder, split) if mark else cls(value, name)
        if not place.folder or not all(place.names):
            raise ValueError(f"{name}={value!r} is neither FOLDER nor FOLDER#SPLIT")
        return place

    @property
    def names(self) -> list[str]:
        """The splits one by one."""
        return self.split.split("+")
