"""The folder of a dataset, on a disk or in an object store."""

from __future__ import annotations

from pathlib import Path
from typing import IO

from fsspec.core import url_to_fs

from tron.errors import TronError

Place = str | Path
"""Path of a folder, or URL of one that fsspec opens, such as s3://bucket/dataset."""


class DatasetFolder:
    """Files of a dataset by their names within it.

    Args:
        place: path, or URL such as ``s3://bucket/dataset``.

    Raises:
        TronError: fsspec does not know the URL's protocol, or lacks its package.
    """

    def __init__(self, place: Place) -> None:
        self.place = str(place)
        self.local = None if "://" in self.place else Path(place)
        try:
            self._files, self._root = url_to_fs(self.place)
        except (ImportError, ValueError) as error:
            raise TronError(
                f"cannot open: {error}", self.place, "pip install 'tron-relight[stores]', or mend the URL"
            ) from error

    def __str__(self) -> str:
        return self.place

    def where(self, name: str) -> str:
        """Full path or URL of a file, for messages."""
        return f"{self.place.rstrip('/')}/{name}"

    def size(self, name: str) -> int | None:
        """Bytes of a file; None where there is none.

        Raises:
            TronError: the store does not answer.
        """
        try:
            return (
                int(self._files.size(self._path(name)) or 0) if self._files.isfile(self._path(name)) else None
            )
        except Exception as error:  # stores raise whatever their package does
            raise self._unreadable(name, error) from error

    def open(self, name: str) -> IO[bytes]:
        """A file to read from its start to its end; TronError where it cannot be opened."""
        try:
            return self._files.open(self._path(name), "rb")
        except Exception as error:  # as above
            raise self._unreadable(name, error) from error

    def read(self, name: str, start: int = 0, size: int | None = None) -> bytes:
        """Bytes of a file, all of it or ``size`` from ``start``; TronError where it cannot be read."""
        try:
            end = None if size is None else start + size
            return self._files.cat_file(self._path(name), start=start or None, end=end)
        except Exception as error:  # as above
            raise self._unreadable(name, error) from error

    def _path(self, name: str) -> str:
        return f"{self._root.rstrip('/')}/{name}"

    def _unreadable(self, name: str, error: Exception) -> TronError:
        return TronError(f"cannot read: {type(error).__name__}: {error}", self.where(name))
