"""The folder of a dataset, on a disk or in an object store."""

from __future__ import annotations

import hashlib
import os
import subprocess
import tarfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Annotated
from urllib.error import URLError
from urllib.request import Request, urlopen

from pydantic import BeforeValidator

from tron.errors import TronError

Place = str | Path
"""Path of a folder, or URL of one that fsspec opens, such as s3://bucket/dataset."""
PROBE_NAME = ".tron-probe"
"""File that is written and removed to see whether a store can be written."""

BLOCK_BYTES = 2**20
PARTIAL_CONTENT = 206
SIGNALLED = 128
"""Least exit code of a shell whose command was ended by a signal, as by a pipe that is closed early."""
PATIENCE = 60.0
"""Seconds that a server may be silent."""
DAMAGE = (tarfile.TarError, OSError, EOFError, UnicodeError, ValueError)
"""Exceptions raised by reading a damaged tar."""


def is_url(place: Place) -> bool:
    """Return whether a place is a URL or `pipe:COMMAND` instead of a path."""
    return "://" in str(place) or is_pipe(place)


def is_pipe(place: Place) -> bool:
    """Return whether a place is `pipe:COMMAND`, the output of a shell command, as in webdataset."""
    return str(place).startswith("pipe:")


def gives_ranges(url: str) -> bool:
    """Return whether a server supports range requests; also true if the file or server is missing."""
    if not url.startswith(("http://", "https://")):
        return not is_pipe(url)
    try:
        with urlopen(Request(url, headers={"Range": "bytes=0-0"}), timeout=PATIENCE) as response:
            return response.status == PARTIAL_CONTENT
    except (OSError, ValueError):
        return True


@contextmanager
def open_stream(place: Place) -> Iterator[IO[bytes]]:
    """Open a file for sequential reading: a path, a URL, or `pipe:COMMAND`.

    Raises:
        TronError: it cannot be opened or read, ends too early, or the command fails.
    """
    text = str(place)
    try:
        if is_pipe(place):
            with _running(text) as file:
                yield file
        elif text.startswith(("http://", "https://")):
            with urlopen(text, timeout=PATIENCE) as response:
                yield response
                _drain(response)
                if response.length:
                    raise TronError(f"connection ended {response.length} bytes too early", text)
        elif is_url(place):
            folder, _, name = text.rpartition("/")
            with DatasetFolder(folder).open(name) as file:
                yield file
        else:
            with open(place, "rb") as file:
                yield file
    except URLError as error:
        raise TronError(f"cannot read: {error}", text) from error
    except (TronError, *DAMAGE):
        raise
    except Exception as error:  # stores raise whatever their package does
        raise TronError(f"cannot read: {type(error).__name__}: {error}", text) from error


@contextmanager
def _running(place: str) -> Iterator[IO[bytes]]:
    """Output of a pipe's command, which is stopped where it is left before its end."""
    owner = os.getpid()
    process = subprocess.Popen(place.removeprefix("pipe:"), shell=True, stdout=subprocess.PIPE)
    assert process.stdout is not None
    try:
        with process.stdout as output:
            yield output
            _drain(output)
        if code := process.wait():
            raise TronError(f"its command ended with {code}", place)
    except DAMAGE as error:
        code = _exit_code(process)
        if 0 < code < SIGNALLED:  # what it left unsaid is the damage
            raise TronError(f"its command ended with {code}", place) from error
        raise
    finally:
        if os.getpid() == owner:  # else a forked process lets go of its copy
            process.kill()
            process.wait()


def _exit_code(process: subprocess.Popen[bytes]) -> int:
    """Of a command that nobody listens to any more; 0 where it goes on."""
    try:
        return process.wait(5.0)
    except subprocess.TimeoutExpired:
        return 0


def _drain(file: IO[bytes]) -> None:
    """Read what lies behind a tar's end, so that who sends it comes to an end of his own."""
    while file.read(BLOCK_BYTES):
        pass


def _path_or_url(value: object) -> object:
    return Path(value) if isinstance(value, str) and not is_url(value) else value


DatasetPlace = Annotated[Path | str, BeforeValidator(_path_or_url)]
"""Type of a setting that names a dataset: a Path, or a URL as text."""


class DatasetFolder:
    """Files of a dataset by their names within it.

    Args:
        place: path, or URL such as ``s3://bucket/dataset``.

    Raises:
        TronError: fsspec does not know the URL's protocol, or lacks its package; or it is a pipe.
    """

    def __init__(self, place: Place) -> None:
        if is_pipe(place):
            raise TronError("a pipe is no dataset folder", str(place), "only tron-train reads pipes")
        self.place = str(place)
        self.local = None if is_url(place) else Path(place)
        from fsspec.core import url_to_fs

        try:
            self._files, self._root = url_to_fs(self.place)
        except (ImportError, ValueError) as error:
            raise TronError(
                f"cannot open: {error}", self.place, "pip install 'tron-relight[stores]', or mend the URL"
            ) from error

    def __str__(self) -> str:
        return self.place

    def where(self, name: str) -> str:
        """Return the full path or URL of a file, for messages."""
        return f"{self.place.rstrip('/')}/{name}"

    def size(self, name: str) -> int | None:
        """Return the size of a file in bytes; None if it is missing.

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
        """Open a file for sequential reading; TronError if it cannot be opened."""
        try:
            # Some stores read 50 MB ahead unless they are told.
            ahead = {} if self._on_a_disk() else {"block_size": 4 * BLOCK_BYTES}
            return self._files.open(self._path(name), "rb", **ahead)
        except Exception as error:  # as above
            raise self._unreadable(name, error) from error

    def read(self, name: str, start: int = 0, size: int | None = None) -> bytes:
        """Read a file, whole or ``size`` bytes from ``start``; TronError if it cannot be read."""
        try:
            end = None if size is None else start + size
            return self._files.cat_file(self._path(name), start=start or None, end=end)
        except Exception as error:  # as above
            raise self._unreadable(name, error) from error

    def sha256(self, name: str) -> str:
        """Return the SHA-256 of a file, 64 hexadecimal digits; TronError if it cannot be read."""
        found = hashlib.sha256()
        with self.open(name) as file:
            try:
                while block := file.read(BLOCK_BYTES):
                    found.update(block)
            except Exception as error:  # as above
                raise self._unreadable(name, error) from error
        return found.hexdigest()

    def sizes(self, below: str = "") -> dict[str, int]:
        """Return the sizes in bytes of all files in this folder, or a sub-folder, by name; empty if missing.

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
        """Upload a file under a name, whole or not at all, and check its size there.

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
        """Raise TronError if a small file cannot be written and removed."""
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
