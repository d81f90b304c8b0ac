"""Splits of a training run by name: of its dataset, or of another dataset's folder."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

from train.split_place import SplitPlace
from tron.dataset_folder import DatasetFolder, Place
from tron.errors import TronError
from tron.shards.clip_store import ClipStore
from tron.shards.manifest import MANIFEST_NAME, Manifest


class Splits:
    """Clips of a run's splits.

    Args:
        dataset: its dataset's folder.
        elsewhere: name of a split -> FOLDER or FOLDER#SPLIT where it is read from.

    Raises:
        TronError: a folder is no dataset, or has not the split that is to come from it.
    """

    def __init__(self, dataset: Place, elsewhere: Mapping[str, str] | None = None) -> None:
        self._dataset = dataset
        self._places = {name: SplitPlace.parse(name, value) for name, value in (elsewhere or {}).items()}
        self._manifests = {str(dataset): Manifest.load(dataset)}
        self._stores: dict[str, ClipStore] = {}
        for name, place in self._places.items():
            if place.folder not in self._manifests:
                self._manifests[place.folder] = Manifest.load(place.folder)
            self.clips(name)

    def __contains__(self, name: str) -> bool:
        return name in self._places or name in self._manifests[str(self._dataset)].splits()

    def names(self) -> list[str]:
        """All splits that can be read, by name."""
        return sorted({*self._places, *self._manifests[str(self._dataset)].splits()})

    def clips(self, name: str) -> ClipStore:
        """Clips of a split; TronError, naming those there are, where there is none."""
        if name not in self._stores:
            place = self._places.get(name, SplitPlace(str(self._dataset), (name,)))
            try:
                store = ClipStore(place.folder, place.splits, manifest=self._manifests[place.folder])
            except TronError as error:
                raise TronError(error.what, place.folder, error.mend) from error
            self._stores[name] = store
        return self._stores[name]


def manifest_hash(folder: Place) -> str:
    """SHA-256 of a dataset's manifest, which names the hash of each of its shards, hexadecimal."""
    return hashlib.sha256(DatasetFolder(folder).read(MANIFEST_NAME)).hexdigest()


def split_hashes(elsewhere: Mapping[str, str]) -> dict[str, str]:
    """Of each split that is read elsewhere, its dataset's `manifest_hash` and its name there."""
    places = {name: SplitPlace.parse(name, value) for name, value in elsewhere.items()}
    return {name: f"{manifest_hash(place.folder)}#{'+'.join(place.splits)}" for name, place in places.items()}
