"""The object store to which finished shards move from output_dir.

Records stay in output_dir. A scene is finished when its record is there and each of its shards is in the
folder or, with its bytes, in the store; shards that remain in the folder are sent when the command is run
again.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from pathlib import Path

from datagen.dataset.clip_preview import script_name, sheet_name, thumbnail_name
from datagen.dataset.records import Record, Work, read_record
from datagen.run.account import ACCOUNT
from datagen.settings.command import Settings
from tron.errors import TronError
from tron.shards.dataset_folder import DatasetFolder
from tron.shards.index import index_name

log = logging.getLogger(__name__)


class StoreError(TronError):
    """The store refuses shards, and would refuse the next ones too."""


class Store:
    """Shards of a dataset in a store, named by a URL.

    Raises:
        TronError: fsspec does not know the URL's protocol, or lacks its package.
    """

    def __init__(self, url: str) -> None:
        self._folder = DatasetFolder(url)

    @classmethod
    def of(cls, settings: Settings) -> Store | None:
        """Return the settings' store; TronError if it cannot be written."""
        if settings.store is None:
            return None
        store = cls(settings.store)
        store._folder.require_writable()
        return store

    def shards(self) -> dict[str, int]:
        """Return shard name -> bytes in the store."""
        return {name: size for name, size in self._folder.sizes().items() if name.endswith(".tar")}

    def send(self, output: Path, record: Record) -> None:
        """Send a finished scene's previews and shards; each shard leaves output_dir when it has arrived.

        Raises:
            StoreError: the store cannot be written. Remaining shards are sent the next time.
        """
        for name in _previews(record):
            if (output / name).is_file():
                self._put(output, name)
        for entry in record.shards:
            for name in (index_name(entry.name), entry.name):
                if (output / name).is_file():
                    self._put(output, name)
                    (output / name).unlink()

    def empty(self, output: Path, items: Iterable[Work]) -> None:
        """Send the remaining shards of finished scenes in output_dir; raises as :meth:`send`."""
        waiting = {path.name for path in output.glob("*.tar")}
        stored = self.shards() if waiting else {}
        for item in items if waiting else ():
            record = read_record(output, item.name, stored)
            if record is not None and any(entry.name in waiting for entry in record.shards):
                self.send(output, record)

    def finish(self, settings: Settings) -> None:
        """Send the account, the manifest last; a part sends none, because mode=merge sends the whole."""
        if settings.shard is not None:
            return
        output = settings.output_dir
        for name in ACCOUNT:
            if (output / name).is_file():
                self._put(output, name)

    def _put(self, output: Path, name: str) -> None:
        try:
            self._folder.put(output / name, name)
        except TronError as error:
            raise StoreError(error.what, error.where, error.mend) from error


def _previews(record: Record) -> list[str]:
    keys = [key for entry in record.shards for key in entry.keys]
    names = [name for key in keys for name in (thumbnail_name(key), script_name(key))]
    return [*names, *(sheet_name(entry.name) for entry in record.shards)]
