"""Random access to the clips of a split: reads only the requested frames and members."""

from __future__ import annotations

import os
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Collection, Iterable, Iterator, Sequence
from itertools import accumulate
from tarfile import BLOCKSIZE
from typing import Any

from tron.errors import TronError
from tron.shards.dataset_folder import DatasetFolder, Place
from tron.shards.index import LARGEST_INDEX, ShardIndex, index_name, parse_index, require_header, scan_index
from tron.shards.manifest import Manifest, ShardEntry
from tron.shards.reader import DAMAGED, LARGEST_META, decode_frames, decode_meta, file_name, present_members
from tron.shards.schema import META_SUFFIX, Clip, ClipMeta

MOST_METAS = 256
"""Number of clips whose metadata are cached."""
MOST_INDEXED = 12_000_000
"""Number of files whose offsets are cached, 16 bytes each; least recently used shards are dropped."""
MOST_OPEN = 64
"""Number of local files that are kept open."""
LARGEST_READ = 64 * 2**20
"""Bytes up to which neighbouring ranges are read at once."""
_LOCAL_GAP = 4096
_REMOTE_GAP = 2**20  # a request costs more than a megabyte that nobody wants
Range = tuple[int, int]
"""First byte, and the byte after the last."""


class ClipStore:
    """Clips of a split in the manifest's order, read by number.

    A shard's index lies beside it, or is found by walking its headers. What is read is what `read_clips`
    gives, bit by bit; a shard may be read by several processes, and by one thread of each.

    Args:
        place: the dataset's folder, or its URL.
        split: of it, or several, one after another.
        members: that are read, unless a call says others; None: all that a clip holds.
        manifest: of the folder, where it has been loaded already.

    Raises:
        TronError: this is no dataset, or it has no such split.
    """

    def __init__(
        self,
        place: Place,
        split: str | Sequence[str],
        members: Iterable[str] | None = None,
        manifest: Manifest | None = None,
    ) -> None:
        manifest = Manifest.load(place) if manifest is None else manifest
        splits = [split] if isinstance(split, str) else split
        self.split, self.members = "+".join(splits), None if members is None else tuple(members)
        entries = [entry for name in splits for entry in manifest.of_split(name)]
        self._entries = [entry for entry in entries if entry.keys]
        if not self._entries:
            raise TronError(f"manifest names no clip of the split '{split}'", str(place), DAMAGED)
        self._ends = list(accumulate(len(entry.keys) for entry in self._entries))
        self._ranges = ByteRanges(place)
        self._indexes: OrderedDict[str, ShardIndex] = OrderedDict()
        self._scanned: set[str] = set()
        self._metas: OrderedDict[int, ClipMeta] = OrderedDict()

    def __len__(self) -> int:
        return self._ends[-1]

    def key(self, number: int) -> str:
        """Return the key of a clip; IndexError if there is no such number."""
        entry, place = self._find(number)
        return entry.keys[place]

    def split_of(self, number: int) -> str:
        """Return the split of a clip; IndexError if there is no such number."""
        return self._find(number)[0].split

    def first_of_splits(self) -> list[int]:
        """Return the number of the first clip of each split."""
        starts = [0, *self._ends[:-1]]
        return [
            start
            for k, (start, entry) in enumerate(zip(starts, self._entries))
            if k == 0 or entry.split != self._entries[k - 1].split
        ]

    def meta(self, number: int) -> ClipMeta:
        """Read the metadata of a clip; TronError if they are missing, damaged or of another clip."""
        if number not in self._metas:
            key = self.key(number)
            files = self._files(number, [META_SUFFIX])
            if META_SUFFIX not in files:  # the shard ends within the clip
                raise TronError(f"clip {key} has no {META_SUFFIX}", self._where(number), DAMAGED)
            meta = decode_meta(files[META_SUFFIX])
            if meta.key != key:
                raise TronError(f"clip {key} has the metadata of {meta.key}", self._where(number))
            while len(self._metas) >= MOST_METAS:
                self._metas.popitem(last=False)
            self._metas[number] = meta
        self._metas.move_to_end(number)
        return self._metas[number]

    def read_frames(
        self, number: int, frames: Sequence[int] | None = None, members: Iterable[str] | None = None
    ) -> Clip:
        """Read chosen frames of a clip, in that order, (K, H, W, C) float32 per member, and all metadata.

        Args:
            number: of the clip in the split, from 0.
            frames: indices; None: all.
            members: to read; None: the store's.

        Raises:
            TronError: shard or clip is damaged, or lacks a frame or member.
            IndexError: there is no such clip.
        """
        meta = self.meta(number)
        frames = range(meta.frames) if frames is None else frames
        if wrong := [frame for frame in frames if not 0 <= frame < meta.frames]:
            raise TronError(f"clip {meta.key} has no frame {wrong[0]}", self._where(number))
        if members is None:
            members = self.members or present_members(self._names(number))
        members = tuple(members)
        names = {file_name(frame, member) for frame in frames for member in members}
        return decode_frames(meta, self._files(number, names), members, frames)

    def close(self) -> None:
        """Close all open shards; they are opened again when read."""
        self._ranges.close()

    def _find(self, number: int) -> tuple[ShardEntry, int]:
        if not 0 <= number < len(self):
            raise IndexError(f"split '{self.split}' has {len(self)} clips, no number {number}")
        shard = bisect_right(self._ends, number)
        return self._entries[shard], number - (self._ends[shard] - len(self._entries[shard].keys))

    def _where(self, number: int) -> str:
        return self._ranges.folder.where(self._find(number)[0].name)

    def _names(self, number: int) -> Collection[str]:
        """Names of a clip's files."""
        return self._index(number)[self.key(number)].places.keys()

    def _files(self, number: int, names: Iterable[str]) -> dict[str, bytes]:
        """Those files of a clip that it has, by name; by a new index where the kept one leads astray."""
        shard, names = self._find(number)[0].name, list(names)
        if shard not in self._scanned:
            try:
                return self._indexed_files(number, names)
            except TronError:
                if shard in self._scanned:  # its headers have just been walked
                    raise
                self._scanned.add(shard)
                self._indexes.pop(shard, None)
        return self._indexed_files(number, names)

    def _indexed_files(self, number: int, names: Iterable[str]) -> dict[str, bytes]:
        entry, place = self._find(number)
        key, where = entry.keys[place], self._where(number)
        clip = self._index(number)[key]
        wanted = {}
        for name in names:
            if name in clip:
                offset, size = clip.span(name)
                if name == META_SUFFIX and size > LARGEST_META:
                    raise TronError("a clip's meta.json is too large to be one", where)
                wanted[offset - BLOCKSIZE, offset + size] = name
            elif name == META_SUFFIX:
                raise TronError(f"clip {key} has no meta.json", where)
        files = {}
        for span, data in self._ranges.read(entry.name, wanted):
            name = wanted[span]
            require_header(data[:BLOCKSIZE], f"{key}.{name}", len(data) - BLOCKSIZE, where)
            files[name] = data[BLOCKSIZE:]
        return files

    def _index(self, number: int) -> ShardIndex:
        entry, _ = self._find(number)
        if entry.name not in self._indexes:
            index = self._load(entry)
            held = sum(_files_of(each) for each in self._indexes.values()) + _files_of(index)
            while self._indexes and held > MOST_INDEXED:
                held -= _files_of(self._indexes.popitem(last=False)[1])
            self._indexes[entry.name] = index
        self._indexes.move_to_end(entry.name)
        return self._indexes[entry.name]

    def _load(self, entry: ShardEntry) -> ShardIndex:
        """A shard's kept index where that can be right, else that of its headers."""
        folder, name = self._ranges.folder, index_name(entry.name)
        where = folder.where(entry.name)
        shard_bytes = folder.size(entry.name)
        if shard_bytes is None:
            raise TronError("shard is missing", where, "make it again with tron-datagen")
        kept_bytes = None if entry.name in self._scanned else folder.size(name)
        if kept_bytes is not None and kept_bytes <= LARGEST_INDEX:
            index = parse_index(folder.read(name), shard_bytes, where)
            if index is not None and list(index) == entry.keys:
                return index
        self._scanned.add(entry.name)
        with folder.open(entry.name) as file:
            index = scan_index(file, where)
        if list(index) != entry.keys:
            raise TronError(
                f"shard holds {len(index)} clips, the manifest names {len(entry.keys)}",
                where,
                "check the dataset with tron-datagen's validate, then make the shard again",
            )
        return index


def _files_of(index: ShardIndex) -> int:
    return sum(len(clip.sizes) for clip in index.values())


class ByteRanges:
    """Reads ranges of a folder's files; may be sent to another process, or forked with one."""

    def __init__(self, place: Place) -> None:
        self._folder, self._process = DatasetFolder(place), os.getpid()
        self._open: OrderedDict[str, int] = OrderedDict()

    @property
    def folder(self) -> DatasetFolder:
        """The folder, opened anew in a forked process: connections to stores do not outlive a fork."""
        if self._process != os.getpid():
            self._folder, self._process = DatasetFolder(self._folder.place), os.getpid()
        return self._folder

    def read(self, name: str, ranges: Iterable[Range]) -> Iterator[tuple[Range, bytes]]:
        """Return ranges with their bytes, in file order; TronError if the file ends within a range."""
        gap = _LOCAL_GAP if self.folder.local is not None else _REMOTE_GAP
        for start, end, group in _neighbours(sorted(ranges), gap):
            data = self._read(name, start, end - start)
            if len(data) != end - start:
                raise TronError(f"file ends before byte {end}", self.folder.where(name))
            for first, behind in group:
                yield (first, behind), data[first - start : behind - start]

    def close(self) -> None:
        """Close what is open; it opens again when it is read."""
        while self._open:
            os.close(self._open.popitem()[1])

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_open": OrderedDict()}

    def __del__(self) -> None:
        self.close()

    def _read(self, name: str, start: int, size: int) -> bytes:
        if self.folder.local is None:
            return self.folder.read(name, start, size)
        try:
            return os.pread(self._file(name), size, start)
        except OSError as error:
            raise TronError(f"cannot read: {error.strerror or error}", self.folder.where(name)) from error

    def _file(self, name: str) -> int:
        assert self.folder.local is not None
        if name not in self._open:
            if len(self._open) >= MOST_OPEN:
                os.close(self._open.popitem(last=False)[1])
            self._open[name] = os.open(self.folder.local / name, os.O_RDONLY)
        self._open.move_to_end(name)
        return self._open[name]


def _neighbours(ranges: list[Range], gap: int) -> Iterator[tuple[int, int, list[Range]]]:
    """Sorted ranges as (start, end, those within), joined where at most `gap` bytes lie between them."""
    group: list[Range] = []
    for each in ranges:
        if group and (each[0] > group[-1][1] + gap or each[1] - group[0][0] > LARGEST_READ):
            yield group[0][0], group[-1][1], group
            group = []
        group.append(each)
    if group:
        yield group[0][0], group[-1][1], group
