"""The folder of a dataset, on a disk or in an object store."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import IO, Annotated

from fsspec.core import url_to_fs
from pydantic import BeforeValidator

from tron.errors import TronError

Place = str | Path
"""Path of a folder, or URL of one that fsspec opens, such as s3://bucket/dataset."""
PROBE_NAME = ".tron-probe"
"""File that is written and removed to see whether a store can be written."""

BLOCK_BYTES = 2**20


def is_url(place: Place) -> bool:
    """Whether a place is named by a URL."""
    return "://" in str(place)


def _path_or_url(value: object) -> object:
    return Path(value) if isinstance(value, str) and not is_url(value) else value


DatasetPlace = Annotated[Path | str, BeforeValidator(_path_or_url)]
"""A setting that names a dataset: a Path, or a URL, which stays as it is."""


class DatasetFolder:
    """Files of a dataset by their names within it.

    Args:
        place: path, or URL such as ``s3://bucket/dataset``.

    Raises:
        TronError: fsspec does not know the URL's protocol, or lacks its package.
    """

    def __init__(self, place: Place) -> None:
        self.place = str(place)
        self.local = None if is_url(place) else Path(place)
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
            # Some stores read 50 MB ahead unless they are told.
            ahead = {} if self._on_a_disk() else {"block_size": 4 * BLOCK_BYTES}
            return self._files.open(self._path(name), "rb", **ahead)
        except Exception as error:  # as above
            raise self._unreadable(name, error) from error

    def read(self, name: str, start: int = 0, size: int | None = None) -> bytes:
        """Bytes of a file, all of it or ``size`` from ``start``; TronError where it cannot be read."""
        try:
            end = None if size is None else start + size
            return self._files.cat_file(self._path(name), start=start or None, end=end)
        except Exception as error:  # as above
            raise self._unreadable(name, error) from error

    def sha256(self, name: str) -> str:
        """SHA-256 of a file, 64 hexadecimal digits, read as it comes; TronError where it cannot be read."""
        found = hashlib.sha256()
        with self.open(name) as file:
            try:
                while block := file.read(BLOCK_BYTES):
                    found.update(block)
            except Exception as error:  # as above
                raise self._unreadable(name, error) from error
        return found.hexdigest()

    def sizes(self, below: str = "") -> dict[str, int]:
        """Bytes of the files in this folder, or in one within it, by name; none where it is not.

        Raises:
            TronError: the store does not answer.
        """
        inner = self._path(below).rstrip("/")
        try:
            self._files.invalidate_cache()
            if not self._files.exists(inner):
                return {}
            listed = self._files.ls(inner, detail=True)
        except FileNotFoundError:
            return {}
        except Exception as error:  # as above
            raise self._unreadable(below, error) from error
        return {
            each["name"].rstrip("/").rpartition("/")[2]: int(each["size"] or 0)
            for each in listed
            if each["type"] == "file"
        }

    def put(self, path: Path, name: str) -> None:
        """Send a file there under a name, whole or not at all, and see that it has arrived.

        Large files go in several parts; an object store shows an object when the last has come. Its client
        sends checksums along where the store knows them; the size is looked up afterwards.

        Raises:
            TronError: the store cannot be written, or holds another number of bytes afterwards.
        """
        target = self._path(name)
        try:
            if self._on_a_disk():
                self._files.makedirs(target.rpartition("/")[0], exist_ok=True)
                half = f"{target}.part"
                self._files.put_file(str(path), half)
                self._files.mv(half, target)
            else:
                self._files.put_file(str(path), target)
            self._files.invalidate_cache()
            there = int(self._files.info(target)["size"])
        except Exception as error:  # as above
            raise self._unwritable(name, error) from error
        wanted = path.stat().st_size
        if there != wanted:
            raise TronError(f"{there} bytes arrived of {wanted}", self.where(name), "start this again")

    def require_writable(self) -> None:
        """Raise TronError where a small file cannot be written and removed."""
        probe = self._path(PROBE_NAME)
        try:
            if self._on_a_disk():
                self._files.makedirs(self._root, exist_ok=True)
            self._files.pipe_file(probe, b"tron")
            self._files.rm_file(probe)
        except Exception as error:  # as above
            raise self._unwritable("", error) from error

    def _on_a_disk(self) -> bool:
        return "file" in self._files.protocol

    def _unwritable(self, name: str, error: Exception) -> TronError:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        mend = "mend the store's URL, address or credentials, and start this again: it goes on"
        return TronError(f"cannot write: {reason}", self.where(name), mend)

    def _path(self, name: str) -> str:
        return f"{self._root.rstrip('/')}/{name}"

    def _unreadable(self, name: str, error: Exception) -> TronError:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        return TronError(f"cannot read: {reason}", self.where(name))
