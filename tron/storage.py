"""Files that appear whole or not at all, their hashes, locks on folders and the check for free space."""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import filelock

from tron.errors import TronError

LOCK_NAME = ".tron.lock"


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path beside ``path``; what is written there becomes ``path`` when the block succeeds.

    The temporary file keeps the suffix (writers choose their format by it) and is flushed to disk before it
    is renamed, so that neither a crash nor a power cut leaves half a file under the final name. On any
    exception it is removed; what a killed process leaves is overwritten by the next one, since its name is
    always the same. Parent folders are made.

    Raises:
        TronError: the folder cannot be made or written to, the disk is full, or another run is writing this
            file.
    """
    final = Path(path)
    temporary = final.with_name(f".{final.stem}.part{final.suffix}")
    try:
        final.parent.mkdir(parents=True, exist_ok=True)
        with _claimed(temporary):
            try:
                yield temporary
                _flush(temporary)
                os.replace(temporary, final)
                _flush(final.parent)
            finally:
                temporary.unlink(missing_ok=True)
    except BlockingIOError as error:
        raise TronError("file is being written by another run", final, "wait for it") from error
    except OSError as error:
        raise TronError(f"cannot write: {error.strerror or error}", final) from error


@contextmanager
def _claimed(path: Path) -> Iterator[None]:
    """Make an empty file, or empty one that was left behind, and lock it; BlockingIOError if it is locked."""
    handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.ftruncate(handle, 0)
        yield
    finally:
        os.close(handle)


def _flush(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_atomic(path: str | os.PathLike[str], data: bytes | str) -> None:
    """Write ``data`` (text as UTF-8) to ``path``, whole or not at all; TronError as in atomic_path."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data.encode() if isinstance(data, str) else data)


def sha256(path: str | os.PathLike[str]) -> str:
    """Return the SHA-256 of a file as 64 hexadecimal digits; TronError if it cannot be read."""
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise TronError(f"cannot read: {error.strerror or error}", path) from error


@contextmanager
def locked(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Hold a folder for this process alone; the folder is made if it is missing.

    The lock is the operating system's, so it disappears with the process that holds it, however that ends.

    Raises:
        TronError: another process holds the folder, or the lock cannot be made there.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = filelock.FileLock(folder / LOCK_NAME)
        lock.acquire(timeout=0)
    except filelock.Timeout as error:
        raise TronError("folder is in use by another run", folder, "wait for it or choose another") from error
    except OSError as error:
        raise TronError(f"cannot lock folder: {error.strerror or error}", folder) from error
    try:
        yield
    finally:
        lock.release()


def require_free_space(folder: str | os.PathLike[str], n_bytes: int) -> None:
    """Raise TronError unless the disk of ``folder``, which need not exist yet, has ``n_bytes`` free."""
    existing = Path(folder).absolute()
    while not existing.exists():
        existing = existing.parent
    free = shutil.disk_usage(existing).free
    if free < n_bytes:
        raise TronError(
            f"not enough disk space: {n_bytes / 1e9:.2f} GB needed, {free / 1e9:.2f} GB free",
            folder,
            "free some space or choose another folder",
        )
