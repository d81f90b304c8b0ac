"""Ranges of bytes of a dataset's files: open files on a disk, requests to an object store."""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Iterable, Iterator
from typing import Any

from tron.dataset_folder import DatasetFolder, Place
from tron.errors import TronError

MOST_OPEN = 64
"""Files of a disk that are kept open."""
LARGEST_READ = 64 * 2**20
"""Bytes up to which neighbouring ranges are read at once."""
_LOCAL_GAP = 4096
_REMOTE_GAP = 2**20  # a request costs more than a megabyte that nobody wants

Range = tuple[int, int]
"""First byte and the byte behind the last."""


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
        """Ranges with their bytes, by their place in the file; TronError where it ends before one does."""
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
