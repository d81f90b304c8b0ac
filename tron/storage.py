"""Files that appear whole or not at all, their hashes, locks on folders and the check for free space."""

from __future__ import annotations

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
    with _written_by_one_run(final, "file"):
        try:
            temporary.write_bytes(b"")
            yield temporary
            _flush(temporary)
            os.replace(temporary, final)
            _flush(final.parent)
        finally:
            temporary.unlink(missing_ok=True)


@contextmanager
def _written_by_one_run(final: Path, kind: str) -> Iterator[None]:
    """Hold ``.NAME.lock`` beside a file or folder while it is written; an OSError becomes a TronError."""
    lock = filelock.FileLock(final.with_name(f".{final.name}.lock"))
    try:
        final.parent.mkdir(parents=True, exist_ok=True)
        lock.acquire(timeout=0)
        try:
            yield
        finally:
            # While it is held: whoever had opened the file before finds that its lock guards no name.
            Path(lock.lock_file).unlink(missing_ok=True)
            lock.release()
    except filelock.Timeout as error:
        raise TronError(f"{kind} is being written by another run", final, "wait for it") from error
    except OSError as error:
        raise TronError(f"cannot write: {error.strerror or error}", final) from error


def _flush(path: Path) -> None:
    if os.name == "nt" and path.is_dir():  # which Windows does not open
        return
    handle = os.open(path, os.O_RDWR if os.name == "nt" else os.O_RDONLY)  # Windows flushes what it may write
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_atomic(path: str | os.PathLike[str], data: bytes | str) -> None:
    """Write ``data`` (text as UTF-8) to ``path``, whole or not at all; TronError as in atomic_path."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data.encode() if isinstance(data, str) else data)


def write_if_changed(path: str | os.PathLike[str], data: bytes | str) -> None:
    """Write a file (text as UTF-8) unless it holds that already: a finished dataset is not touched."""
    path, data = Path(path), data.encode() if isinstance(data, str) else data
    if not path.is_file() or path.read_bytes() != data:
        write_atomic(path, data)


@contextmanager
def atomic_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give an empty folder beside ``path``; it becomes ``path`` when the block succeeds.

    What is at ``path`` by then is replaced: whether it may be is for the caller to ask beforehand. All files
    are flushed to disk at the end, at once, so that the block can write them plainly. On any exception the
    temporary folder is removed; what a killed process leaves is emptied by the next one, since its name is
    always the same. Parent folders are made.

    Raises:
        TronError: the folder cannot be made or written to, or another run is writing it.
    """
    final = Path(path).absolute()
    temporary, old = (final.with_name(f".{final.name}.{state}") for state in ("part", "old"))
    with _written_by_one_run(final, "folder"):
        try:
            _remove(temporary)
            temporary.mkdir()
            yield temporary
            for inner in (*temporary.rglob("*"), temporary):
                _flush(inner)
            _remove(old)
            if final.exists():
                os.replace(final, old)
            os.replace(temporary, final)
            _flush(final.parent)
            _remove(old)
        finally:
            _remove(temporary)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


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
    if folder.exists() and not folder.is_dir():
        raise TronError("a folder is wanted, and this is a file", folder, "choose another output_dir")
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
