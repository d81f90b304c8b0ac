"""Splits of a training run by name, from its dataset or from another dataset's folder."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

from train.settings import SplitPlace
from tron.errors import TronError
from tron.shards.clip_store import ClipStore
from tron.shards.dataset_folder import Place
from tron.shards.streaming import load_manifest, manifest_bytes, open_clips


class Splits:
    """Clips of a run's splits.

    Args:
        dataset: its dataset's folder or URL, or shards by name (tron.shards.streaming).
        elsewhere: name of a split -> FOLDER or FOLDER#SPLIT where it is read from.

    Raises:
        TronError: a folder is no dataset, or lacks the split to be read from it.
    """

    def __init__(self, dataset: Place, elsewhere: Mapping[str, str] | None = None) -> None:
        self._dataset = dataset
        self._places = {name: SplitPlace.parse(name, value) for name, value in (elsewhere or {}).items()}
        self._manifests = {str(dataset): load_manifest(dataset)}
        self._stores: dict[str, ClipStore] = {}
        for name, place in self._places.items():
            if place.folder not in self._manifests:
                self._manifests[place.folder] = load_manifest(place.folder)
            self.clips(name)

    def __contains__(self, name: str) -> bool:
        return name in self._places or name in self._manifests[str(self._dataset)].splits()

    def names(self) -> list[str]:
        """All splits that can be read, by name."""
        return sorted({*self._places, *self._manifests[str(self._dataset)].splits()})

    def clips(self, name: str) -> ClipStore:
        """Clips of a split; if it does not exist, TronError names the existing splits."""
        if name not in self._stores:
            place = self._places.get(name, SplitPlace(str(self._dataset), (name,)))
            try:
                store = open_clips(place.folder, place.splits, self._manifests[place.folder])
            except TronError as error:
                raise TronError(error.what, place.folder, error.mend) from error
            self._stores[name] = store
        return self._stores[name]


def manifest_hash(folder: Place) -> str:
    """Hexadecimal SHA-256 of a dataset's manifest, which holds the hashes of all its shards."""
    return hashlib.sha256(manifest_bytes(folder)).hexdigest()


def split_hashes(elsewhere: Mapping[str, str]) -> dict[str, str]:
    """For each split of another dataset: that dataset's `manifest_hash` and the split's name in it."""
    places = {name: SplitPlace.parse(name, value) for name, value in elsewhere.items()}
    return {name: f"{manifest_hash(place.folder)}#{'+'.join(place.splits)}" for name, place in places.items()}
