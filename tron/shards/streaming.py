"""Sequentially read shards: from a pipe, or from a server without range requests.

Such a place is a folder's URL, or shards by name: `http://host/data/train-{00000..00003}.tar`,
`pipe:ssh host cat data/train-{00000..00003}.tar`, a path alike. Braces are expanded by webdataset, and each
shard has tron-datagen's name, `SPLIT-NUMBER.tar`.
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from functools import partial
from itertools import islice
from typing import Any

from tron.errors import TronError
from tron.shards.clip_store import ClipStore
from tron.shards.dataset_folder import DatasetFolder, Place, gives_ranges, is_pipe, open_stream
from tron.shards.manifest import LARGEST_MANIFEST, MANIFEST_NAME, Manifest, ShardEntry
from tron.shards.reader import DAMAGED, decode_clip, group_clips, tar_files
from tron.shards.schema import SHARD_PATTERN, parse_name

log = logging.getLogger(__name__)

HELD = 16
"""Number of clips of a shard that are held in memory at a time, as files: the shuffle buffer."""
_SHARD = re.compile(rf"(?<![a-z0-9_])(?:{SHARD_PATTERN.pattern})")
_UNKNOWN = "0" * 64


def names_shards(place: Place) -> bool:
    """Return whether a place names shards instead of a folder."""
    return is_pipe(place) or str(place).endswith(".tar")


def is_stream(place: Place) -> bool:
    """Return whether a place can only be read sequentially."""
    return names_shards(place) or not gives_ranges(f"{str(place).rstrip('/')}/{MANIFEST_NAME}")


def shard_urls(place: Place) -> list[str]:
    """Return the shards that a place names, in order, with braces expanded."""
    from webdataset.shardlists import expand_urls  # loads torch

    return list(expand_urls(str(place)))


def webdataset(url: Place, buffers: Iterable[str] | None = None, split: str = "train") -> Any:
    """Return clips as a webdataset pipeline of decoded tensors, to shuffle, map and batch.

    Shards are shared among the processes of torch.distributed and the workers of a DataLoader.

    Args:
        url: a dataset's folder or URL, or shards by name: with braces, as `http://...`, `pipe:COMMAND`.
        buffers: members of the clips (`tron.shards.MEMBERS`); None: all that they hold.
        split: of a folder; shards by name are read as they are named.

    Returns:
        webdataset.compat.FluidWrapper of dicts {"__key__": key, "__url__": shard, "meta": ClipMeta, buffer:
        (K, H, W, C) float32 tensor}, the values of :func:`tron.shards.read_clips`.

    Raises:
        TronError: while it is read: a shard is missing, damaged or hostile.
    """
    from webdataset.compat import FluidWrapper
    from webdataset.shardlists import SimpleShardList, split_by_node, split_by_worker

    if names_shards(url):
        urls = shard_urls(url)
    else:
        urls = [f"{str(url).rstrip('/')}/{entry.name}" for entry in load_manifest(url).of_split(split)]
    decoded = partial(_decoded, buffers=None if buffers is None else tuple(buffers))
    return FluidWrapper(SimpleShardList(urls)).compose(split_by_node, split_by_worker, decoded)


def _decoded(shards: Iterable[dict[str, str]], buffers: tuple[str, ...] | None) -> Iterator[dict[str, Any]]:
    import torch

    for shard in shards:
        for key, files in group_clips(tar_files(shard["url"], buffers)):
            clip = decode_clip(files, buffers)
            tensors = {name: torch.from_numpy(images) for name, images in clip.frames.items()}
            yield {"__key__": key, "__url__": shard["url"], "meta": clip.meta, **tensors}


def load_manifest(place: Place) -> Manifest:
    """Load the manifest of a dataset; for shards by name, read them once and make one without hashes.

    Raises:
        TronError: there is none, or the shards are not named as tron-datagen names them.
    """
    if not names_shards(place):
        return Manifest.parse(manifest_bytes(place), str(place)) if is_stream(place) else Manifest.load(place)
    log.info("Reading %s once, to count its clips", place)
    entries = []
    for name, url in _named_shards(place).items():
        keys = [key for key, _ in group_clips(tar_files(url, ()))]
        split = name.rpartition("-")[0]
        entries.append(
            ShardEntry(split=split, name=name, samples=len(keys), keys=keys, bytes=0, sha256=_UNKNOWN)
        )
    return Manifest(shards=entries)


def manifest_bytes(place: Place) -> bytes:
    """Return a folder's manifest.json as bytes; for shards by name, their names."""
    if names_shards(place):
        return str(place).encode()
    if not is_stream(place):
        return DatasetFolder(place).read(MANIFEST_NAME)
    with open_stream(f"{str(place).rstrip('/')}/{MANIFEST_NAME}") as file:
        return file.read(LARGEST_MANIFEST)


def _named_shards(place: Place) -> dict[str, str]:
    """Name of each shard -> where it is read."""
    urls: dict[str, str] = {}
    for url in shard_urls(place):
        found = list(_SHARD.finditer(url))
        if not found:
            raise TronError("shard has no name like train-00000.tar, which says its split", url)
        if urls.setdefault(found[-1][0], url) != url:
            raise TronError(f"shard {found[-1][0]} is named twice", str(place))
    return urls


def open_clips(place: Place, splits: str | Sequence[str], manifest: Manifest) -> ClipStore:
    """Open clips of splits: with random access if the place supports it, else sequentially."""
    return (StreamedClips if is_stream(place) else ClipStore)(place, splits, manifest=manifest)


class StreamedClips(ClipStore):
    """Clips of a split that can only be read sequentially: cheap in order, in blocks of HELD clips.

    A clip of a block in hand costs nothing; one that lies ahead in the shard costs the bytes up to it, any
    other those from its shard's beginning. Members that nobody has asked for are not held. What is read is
    what `ClipStore` gives, bit by bit; it takes the arguments of `ClipStore`, a manifest at least.
    """

    def __init__(
        self,
        place: Place,
        split: str | Sequence[str],
        members: Iterable[str] | None = None,
        manifest: Manifest | None = None,
    ) -> None:
        super().__init__(".", split, members, load_manifest(place) if manifest is None else manifest)
        self._place = str(place)
        self._urls = _named_shards(place) if names_shards(place) else {}
        self._kept: frozenset[str] | None = frozenset()
        self._forget()

    def blocks(self) -> list[list[range]]:
        """Return the clip numbers of each block of each shard, in order."""
        starts = [0, *self._ends[:-1]]
        return [
            [range(first, min(first + HELD, end)) for first in range(start, end, HELD)]
            for start, end in zip(starts, self._ends)
        ]

    def close(self) -> None:
        """Close the open shard."""
        self._forget()

    def __getstate__(self) -> dict[str, Any]:
        """What another process needs: it opens streams of its own."""
        return self.__dict__ | {"_stream": None, "_shard": "", "_block": -1, "_held": []}

    def _forget(self) -> None:
        self._process = os.getpid()
        self._stream: Iterator[tuple[str, dict[str, bytes]]] | None = None
        self._shard, self._block = "", -1
        self._held: list[tuple[str, dict[str, bytes]]] = []

    def _where(self, number: int) -> str:
        name = self._find(number)[0].name
        return self._urls.get(name, f"{self._place.rstrip('/')}/{name}")

    def _names(self, number: int) -> Collection[str]:
        return self._clip(number, None).keys()

    def _files(self, number: int, names: Iterable[str]) -> dict[str, bytes]:
        names = list(names)
        members = frozenset(parse_name(f"x.{name}")[2] for name in names) - {"meta"}
        files = self._clip(number, members)
        return {name: files[name] for name in names if name in files}

    def _clip(self, number: int, members: frozenset[str] | None) -> dict[str, bytes]:
        """Files of a clip, of these members at least."""
        entry, place = self._find(number)
        block, kept = place // HELD, self._kept
        if os.getpid() != self._process:  # a fork shares the parent's stream: it is the parent's
            self._forget()
        if kept is not None and (members is None or not members <= kept):
            self._kept = None if members is None else kept | members
            self._forget()
        failure = None
        if (self._shard, self._block) != (entry.name, block):
            failure = self._advance(self._where(number), entry.name, block)
        key, files = self._held[place % HELD] if place % HELD < len(self._held) else ("", {})
        if key != entry.keys[place]:
            what = f"shard has no clip {entry.keys[place]} where it should be"
            raise failure or TronError(what, self._where(number), DAMAGED)
        return files

    def _advance(self, url: str, shard: str, block: int) -> TronError | None:
        """Hold a block of a shard; what is wrong with it, where it is damaged: what lies before is held."""
        if self._stream is None or self._shard != shard or self._block > block:
            self._forget()
            self._stream, self._shard = group_clips(tar_files(url, self._kept)), shard
        first, self._block = self._block + 1, block
        for _ in range(first, block + 1):
            self._held = []
            try:
                for each in islice(self._stream, HELD):
                    self._held.append(each)
            except TronError as error:
                self._stream = None  # opened again for the next block: it may have healed
                return error
        return None
