"""Index of a shard: the offset of each file of each clip in the tar, for random access.

It is found by walking the tar's headers, and kept beside the shard as `train-00000.idx` in the format of
NVIDIA DALI's `wds2idx`, version 1.2: a line `v1.2 CLIPS`, then a line for each clip with `EXTENSION OFFSET
SIZE NAME` of its files in order (bytes from the start of the tar, to the file's data). A kept index is a
hint: it counts only where it accounts for every byte of the shard, and who reads by it looks at each file's
header.
"""

from __future__ import annotations

import tarfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import IO

import numpy as np

from tron.errors import TronError
from tron.shards.dataset_folder import DAMAGE
from tron.shards.reader import DAMAGED, LARGEST_MEMBER, MOST_FILES, BoundedTarInfo, require_plain
from tron.shards.schema import META_SUFFIX, parse_name

INDEX_VERSION = "v1.2"
INDEX_SUFFIX = ".idx"
LARGEST_INDEX = 64 * 2**20
_LONGEST_NUMBER = 15  # digits: a petabyte, and no overflow of int64

Entry = tuple[str, int, int]
"""Name in the tar, offset and size of the data in bytes."""


@dataclass(frozen=True)
class ClipIndex:
    """Offsets and sizes of the files of one clip.

    Attributes:
        places: file's name within the clip, "f00.pbr.exr" -> its number; clips with the same files share it.
        offsets: (files,) int64, of their data from the start of the tar.
        sizes: (files,) int64, bytes.
    """

    places: Mapping[str, int]
    offsets: np.ndarray
    sizes: np.ndarray

    def __contains__(self, name: str) -> bool:
        return name in self.places

    def span(self, name: str) -> tuple[int, int]:
        """Return offset and size of a file's data, bytes."""
        place = self.places[name]
        return int(self.offsets[place]), int(self.sizes[place])


ShardIndex = dict[str, ClipIndex]
"""Key -> the clip, in the shard's order."""


def index_name(shard: str) -> str:
    """File name of a shard's index, e.g. `train-00000.idx`."""
    return shard.removesuffix(".tar") + INDEX_SUFFIX


def scan_index(file: IO[bytes], where: str) -> ShardIndex:
    """Build the index of an open shard from its headers; data are skipped.

    Args:
        file: the tar, which can seek.
        where: its path, for messages.

    Raises:
        TronError: damaged or compressed tar; links, devices, folders, names outside the schema, files beyond
            the size limits; a file that is there twice, a clip whose files do not follow each other.
    """
    return index_of(_scanned(file, where), where)


def _scanned(file: IO[bytes], where: str) -> Iterator[Entry]:
    try:
        with tarfile.open(fileobj=file, mode="r:", tarinfo=BoundedTarInfo) as tar:
            for count, info in enumerate(tar):
                require_plain(info, count, where)
                yield info.name, info.offset_data, info.size
    except DAMAGE as error:
        raise TronError(f"shard is damaged: {error}", where, DAMAGED) from error


def index_of(entries: Iterable[Entry], where: str) -> ShardIndex:
    """Build an index from entries in order; TronError if names repeat, are unknown or out of order."""
    clips: dict[str, list[Entry]] = {}
    last, names = None, set()
    for entry in entries:
        key, _, _ = parse_name(entry[0])
        if key != last:
            if key in clips:
                raise TronError(f"the files of clip {key} do not follow each other", where, DAMAGED)
            last, names, clips[key] = key, set(), []
        if entry[0] in names:
            raise TronError(f"clip {key} has member {entry[0][len(key) + 1 :]} twice", where)
        names.add(entry[0])
        clips[key].append(entry)
    layouts: dict[tuple[str, ...], dict[str, int]] = {}
    return {key: _clip_index(key, files, layouts) for key, files in clips.items()}


def _clip_index(
    key: str, files: Sequence[Entry], layouts: dict[tuple[str, ...], dict[str, int]]
) -> ClipIndex:
    names = tuple(name[len(key) + 1 :] for name, _, _ in files)
    places = layouts.setdefault(names, {name: place for place, name in enumerate(names)})
    numbers = np.array([entry[1:] for entry in files], np.int64)
    return ClipIndex(places, numbers[:, 0].copy(), numbers[:, 1].copy())


def index_text(entries: Iterable[Entry]) -> str:
    """A shard's index as wds2idx writes it."""
    clips: dict[str, list[str]] = {}
    for name, offset, size in entries:
        key, _, extension = name.partition(".")
        clips.setdefault(key, []).append(f"{extension} {offset} {size} {name}")
    return f"{INDEX_VERSION} {len(clips)}\n" + "".join(" ".join(files) + "\n" for files in clips.values())


def parse_index(data: bytes, shard_bytes: int, where: str) -> ShardIndex | None:
    """Parse a stored index; None unless it is valid and covers every byte of a shard of that size.

    Header, data and padding of each file must follow those of the one before, from the first byte of the tar
    to the zeros at its end: what `ShardWriter` and every tar writer without extended headers make.
    """
    # Counted first: text of tiny fields takes fifty times its size in memory once it is split.
    if len(data) > LARGEST_INDEX or data.count(b" ") + data.count(b"\n") > 4 * MOST_FILES + 1:
        return None
    try:
        entries = list(_parsed(data))
        return index_of(entries, where) if _tiles(entries, shard_bytes) else None
    except (TronError, ValueError):
        return None


def _parsed(data: bytes) -> Iterator[Entry]:
    head, *lines = data.decode("ascii").removesuffix("\n").split("\n")
    if head != f"{INDEX_VERSION} {len(lines)}":
        raise ValueError("another version, or a line too few")
    for line in lines:
        fields = line.split(" ")
        if len(fields) % 4 or not line.endswith(META_SUFFIX):
            raise ValueError("half a line")
        for extension, offset, size, name in zip(*(fields[part::4] for part in range(4))):
            if not name.endswith(f".{extension}") or max(len(offset), len(size)) > _LONGEST_NUMBER:
                raise ValueError("no entry")
            yield name, int(offset), int(size)


def _tiles(entries: Sequence[Entry], shard_bytes: int) -> bool:
    if not 0 < len(entries) <= MOST_FILES:
        return False
    end = 0
    for _, offset, size in entries:
        if not 0 <= size <= LARGEST_MEMBER or offset != end + tarfile.BLOCKSIZE:
            return False
        end = offset + padded(size)
    return 2 * tarfile.BLOCKSIZE <= shard_bytes - end <= 2 * tarfile.RECORDSIZE


def padded(size: int) -> int:
    """Return the bytes that data of a size take in a tar, with padding."""
    return -(-size // tarfile.BLOCKSIZE) * tarfile.BLOCKSIZE


def require_header(block: bytes, name: str, size: int, where: str) -> None:
    """TronError unless a block of 512 bytes is the tar header of that plain file."""
    try:
        info = tarfile.TarInfo.frombuf(block, "utf-8", "strict")
    except (tarfile.TarError, UnicodeError, ValueError) as error:
        raise TronError(f"shard has no header of {name}: {error}", where, DAMAGED) from error
    if not info.isreg() or (info.name, info.size) != (name, size):
        raise TronError(f"shard has another file in the place of {name}", where, DAMAGED)
