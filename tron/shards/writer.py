"""Write clips into tar shards by webdataset's TarWriter; the bytes depend only on the clips."""

from __future__ import annotations

import hashlib
import io
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from tarfile import BLOCKSIZE
from types import TracebackType
from typing import IO, Any, BinaryIO, cast

import numpy as np

from tron.errors import TronError
from tron.io.images import encode_exr, encode_png
from tron.shards.index import Entry, index_name, index_text, padded
from tron.shards.manifest import ShardEntry
from tron.shards.reader import file_name
from tron.shards.schema import (
    MEMBERS,
    META_SUFFIX,
    SPLIT_PATTERN,
    ClipMeta,
    clip_members,
    shard_name,
)
from tron.storage import atomic_path, write_atomic


class ShardWriter:
    """Context manager that fills `folder/{split}-00000.tar`, `-00001.tar`, ... with clips.

    A shard appears under its final name only when it is whole; if the block ends by an exception, the shard
    in hand is dropped and earlier ones stay. Its index (`tron.shards.index`) follows it: a run that is killed
    between the two leaves a shard without one, which is read as well. `entries` lists the finished shards for
    the manifest. `first_index` numbers the first shard (a resumed run goes on where the last whole shard
    ended).
    """

    def __init__(self, folder: str | Path, split: str, samples_per_shard: int = 64, first_index: int = 0):
        if not SPLIT_PATTERN.fullmatch(split):
            raise TronError(f"split name {split!r}", mend="use lower-case letters, digits and '_'")
        if samples_per_shard < 1:
            raise TronError(f"samples_per_shard is {samples_per_shard}", mend="give at least 1")
        self.folder = Path(folder)
        self.split = split
        self.samples_per_shard = samples_per_shard
        self.entries: list[ShardEntry] = []
        self._index = first_index
        self._keys: list[str] = []
        self._files: list[Entry] = []
        self._stack = ExitStack()
        self._end = 0
        self._tar: Any = None
        self._file: _HashingFile | None = None

    def __enter__(self) -> ShardWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self._stack.__exit__(kind, error, trace)
            return
        try:
            self._finish_shard()
        except BaseException:
            self._stack.__exit__(*sys.exc_info())  # a full disk here must not leave the temporary file behind
            raise

    def write(self, meta: ClipMeta, frames: Sequence[dict[str, np.ndarray]]) -> None:
        """Add one clip: frames[i][member] is (H, W, C) or, for one channel, (H, W).

        Values beyond half precision's largest (65504, a sun seen directly) are stored as that value. Raises
        TronError, and writes nothing of the clip, where a member is missing, unknown, of the wrong size, or
        holds a NaN or an infinity: the caller decides what becomes of the sample.
        """
        if meta.split != self.split:
            raise TronError(f"clip {meta.key} says split {meta.split!r}, the shard is {self.split!r}")
        if len(frames) != meta.frames or len(meta.cameras) != meta.frames:
            raise TronError(
                f"clip {meta.key} says {meta.frames} frames: {len(frames)} with {len(meta.cameras)} cameras"
            )
        if meta.key in self._keys or any(meta.key in entry.keys for entry in self.entries):
            raise TronError(f"clip {meta.key} is written twice")
        files = [
            (file_name(index, member), _encode(meta, index, member, frame[member]))
            for index, frame in enumerate(frames)
            for member in _members_of(meta, index, frame)
        ]
        files.append((META_SUFFIX, (meta.model_dump_json() + "\n").encode()))
        tar = self._open_shard()
        for name, data in files:
            tar.write({"__key__": meta.key, name: data})  # one by one: it sorts what it is given at once
            self._files.append((f"{meta.key}.{name}", self._end + BLOCKSIZE, len(data)))
            self._end += BLOCKSIZE + padded(len(data))
        self._keys.append(meta.key)
        if len(self._keys) == self.samples_per_shard:
            self._finish_shard()

    def _open_shard(self) -> Any:
        if self._tar is None:
            from webdataset.writer import TarWriter  # loads torch, which who only reads clips need not have

            path = self._stack.enter_context(atomic_path(self.folder / shard_name(self.split, self._index)))
            self._file = _HashingFile(self._stack.enter_context(path.open("wb")))
            # No clock and no user in the bytes.
            self._tar = TarWriter(cast(BinaryIO, self._file), "", "", mode=0o644, mtime=0, encoder=False)
            self._end = 0
        return self._tar

    def _finish_shard(self) -> None:
        if self._tar is None or self._file is None:
            return
        self._tar.close()
        entry = ShardEntry(
            split=self.split,
            name=shard_name(self.split, self._index),
            samples=len(self._keys),
            keys=self._keys,
            bytes=self._file.size,
            sha256=self._file.hash.hexdigest(),
        )
        self._stack.close()  # renames the temporary file: only now does the shard exist
        write_atomic(self.folder / index_name(entry.name), index_text(self._files))
        self.entries.append(entry)
        self._index += 1
        self._keys, self._files, self._tar, self._file = [], [], None, None


class _HashingFile(io.RawIOBase):
    """Hash what is written on its way to the file."""

    def __init__(self, file: IO[bytes]):
        super().__init__()
        self.file, self.hash, self.size = file, hashlib.sha256(), 0

    def writable(self) -> bool:
        return True

    def write(self, data) -> int:
        if self.file.closed:  # after a failure: Python flushes the tar that was left when it is collected
            return len(data)
        self.file.write(data)
        self.hash.update(data)
        self.size += len(data)
        return len(data)


def _members_of(meta: ClipMeta, index: int, frame: dict[str, np.ndarray]) -> tuple[str, ...]:
    """The frame's members in the schema's order; every reference member or none."""
    every = clip_members(reference=False)
    wanted = clip_members(reference=not set(frame).isdisjoint(set(MEMBERS).difference(every)))
    if wrong := sorted(set(frame).symmetric_difference(wanted)):
        raise TronError(f"clip {meta.key} frame {index}: missing or unknown members {', '.join(wrong)}")
    return wanted


def _encode(meta: ClipMeta, index: int, member: str, image: np.ndarray) -> bytes:
    kind = MEMBERS[member]
    image = np.asarray(image, np.float32)
    if image.ndim == 2:
        image = image[..., None]
    where = f"clip {meta.key} frame {index} {member}"
    if image.shape != (meta.height, meta.width, kind.channels):
        raise TronError(f"{where} has shape {image.shape}, not {(meta.height, meta.width, kind.channels)}")
    if not np.isfinite(image).all():
        raise TronError(f"{where} holds {int((~np.isfinite(image)).sum())} values that are not finite")
    if kind.extension == "png":
        return encode_png(image, color=kind.color_space is not None)
    return encode_exr(image, half=kind.bytes == 2, color=kind.color_space is not None)
