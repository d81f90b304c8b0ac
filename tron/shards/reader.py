"""Read shards back: an explicit table of decoders, nothing is ever unpickled or extracted to disk."""

from __future__ import annotations

import tarfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import IO

import numpy as np
from pydantic import ValidationError

from tron.dataset_folder import DatasetFolder, Place, is_url
from tron.errors import TronError
from tron.images import decode_exr, decode_png
from tron.shards.manifest import Manifest
from tron.shards.schema import (
    MEMBERS,
    META_SUFFIX,
    Clip,
    ClipMeta,
    clip_members,
    parse_name,
    require_schema,
)
from tron.shards.tar_headers import BoundedTarInfo

LARGEST_MEMBER = 256 * 2**20
LARGEST_META = 16 * 2**20
MOST_FILES = 200_000  # of one shard: 64 clips of 93 frames x 12 members are 71,424
DAMAGED = "make the shard again with tron-datagen"
_DECODERS: dict[str, Callable[[bytes], np.ndarray]] = {"exr": decode_exr, "png": decode_png}


def tar_files(path: Place, members: Collection[str] | None = None) -> Iterator[tuple[str, str, bytes]]:
    """Files of one shard in order: (key, name within the clip such as "f00.pbr.exr", bytes).

    path: of the shard, or its URL: that is read as it comes, a few megabytes at a time.
    members: only these members and the metadata; the bytes of others are skipped (default: all). Refuses
    with TronError links, devices, folders, names outside the schema (so also absolute paths and `..`),
    compressed or damaged tars and files beyond the size limit; such a file's bytes are not read.
    """
    try:
        # "r:" reads plain tars only: no decompression bombs
        with _opened(path) as opened, tarfile.open(fileobj=opened, mode="r:", tarinfo=BoundedTarInfo) as tar:
            for count, info in enumerate(tar):
                key, member = require_plain(info, count, str(path))
                if members is not None and member != "meta" and member not in members:
                    continue
                file = tar.extractfile(info)
                data = file.read() if file else b""
                if len(data) != info.size:
                    raise TronError(f"shard ends within member {info.name!r}", str(path), DAMAGED)
                yield key, info.name[len(key) + 1 :], data
    except _DAMAGED as error:
        raise TronError(f"shard is damaged: {error}", str(path), DAMAGED) from error


@contextmanager
def _opened(path: Place) -> Iterator[IO[bytes]]:
    """A shard to read, on a disk or in a store."""
    if not is_url(path):
        with open(path, "rb") as file:
            yield file
        return
    folder, _, name = str(path).rpartition("/")
    with DatasetFolder(folder).open(name) as file:
        try:
            yield file
        except (TronError, *_DAMAGED):
            raise
        except Exception as error:  # stores raise whatever their package does
            raise TronError(f"cannot read: {type(error).__name__}: {error}", str(path)) from error


_DAMAGED = (tarfile.TarError, OSError, EOFError, UnicodeError, ValueError)


def require_plain(info: tarfile.TarInfo, count: int, where: str) -> tuple[str, str]:
    """Key and member of a tar's entry number ``count``; TronError unless it is a file of a clip."""
    if not info.isreg() or info.issparse():
        raise TronError(f"member {info.name[:80]!r} is not a plain file", where)
    if info.size > LARGEST_MEMBER or count >= MOST_FILES:
        raise TronError(f"member {info.name[:80]!r} goes beyond the size limits", where)
    key, _, member = parse_name(info.name)
    return key, member


def decode_member(name: str, data: bytes) -> np.ndarray:
    """Decode one member's file, "f00.pbr.exr", to (H, W, C) float32, by the schema's table alone."""
    _, _, member = parse_name(f"x.{name}")
    if member == "meta":
        raise TronError(f"{name} is metadata, not an image")
    image = _DECODERS[MEMBERS[member].extension](data)
    if image.ndim == 2:
        image = image[..., None]
    channels = MEMBERS[member].channels
    if image.shape[-1] != channels:
        image = image[..., :channels]  # a PNG decoder may hand back grey as RGB
    return np.ascontiguousarray(image, np.float32)


def decode_meta(data: bytes) -> ClipMeta:
    """Parse and validate a clip's meta.json."""
    if len(data) > LARGEST_META:
        raise TronError("a clip's meta.json is too large to be one")
    try:
        meta = ClipMeta.model_validate_json(data)
    except ValidationError as error:
        first = error.errors()[0]
        raise TronError(f"meta.json is damaged at {first['loc']}: {first['msg']}") from error
    require_schema(meta.schema_version, f"clip {meta.key}")
    return meta


def decode_clip(
    files: Mapping[str, bytes],
    members: Iterable[str] | None = None,
    frames: Sequence[int] | None = None,
) -> Clip:
    """Decode a clip from its files, {"f00.pbr.exr": bytes, ..., "meta.json": bytes}.

    members: only these (default: all present); frames: only these indices, in this order (default: all).
    Raises TronError where a file is missing, does not decode, has another size than the metadata say, or
    holds values that are not finite.
    """
    if META_SUFFIX not in files:
        raise TronError("clip has no meta.json")
    meta = decode_meta(files[META_SUFFIX])
    indices = range(meta.frames) if frames is None else frames
    return decode_frames(meta, files, present_members(files) if members is None else members, indices)


def present_members(files: Collection[str]) -> tuple[str, ...]:
    """Members that a clip of these files holds: all, or all but those for reference."""
    every = clip_members(reference=False)
    return clip_members(reference=any(file_name(0, m) in files for m in MEMBERS if m not in every))


def decode_frames(
    meta: ClipMeta, files: Mapping[str, bytes], members: Iterable[str], indices: Sequence[int]
) -> Clip:
    """Decode frames of a clip whose metadata are known; TronError as decode_clip."""
    decoded: dict[str, np.ndarray] = {}
    for member in members:
        images = []
        for index in indices:
            name = file_name(index, member)
            if name not in files:
                optional = MEMBERS[member].clips == "reference"
                mend = "its split was made without reference_buffers" if optional else None
                raise TronError(f"clip {meta.key} has no member {name}", mend=mend)
            image = decode_member(name, files[name])
            if image.shape[:2] != (meta.height, meta.width):
                raise TronError(f"clip {meta.key} {name} has size {image.shape[1::-1]}, not the clip's")
            if not np.isfinite(image).all():
                raise TronError(f"clip {meta.key} {name} holds values that are not finite")
            images.append(image)
        decoded[member] = np.stack(images)
    return Clip(meta, decoded)


def file_name(frame: int, member: str) -> str:
    """Name within a clip of a member's file, "f00.pbr.exr"; TronError where no member is called so."""
    if member not in MEMBERS:
        raise TronError(f"no member is called {member!r}", mend=f"they are {', '.join(MEMBERS)}")
    return f"f{frame:02d}.{member}.{MEMBERS[member].extension}"


def read_clips(folder: Place, split: str, members: Iterable[str] | None = None) -> Iterator[Clip]:
    """All clips of a split in the manifest's order, (K, H, W, C) float32 a member; folder: path or URL.

    Raises TronError where the folder is no dataset, lacks the split, or a shard does not hold the clips
    that its manifest names.
    """
    wanted = None if members is None else list(members)
    place = DatasetFolder(folder)
    for entry in Manifest.load(folder).of_split(split):
        seen: list[str] = []
        for key, files in group_clips(tar_files(place.where(entry.name), wanted)):
            seen.append(key)
            yield decode_clip(files, wanted)
        if seen != entry.keys:
            raise TronError(
                f"shard holds {len(seen)} clips, the manifest names {len(entry.keys)}",
                place.where(entry.name),
                "check the dataset with tron-datagen's validate, then make the shard again",
            )


def group_clips(files: Iterable[tuple[str, str, bytes]]) -> Iterator[tuple[str, dict[str, bytes]]]:
    """Gather consecutive files of one key into {name: bytes}."""
    current: str | None = None
    gathered: dict[str, bytes] = {}
    for key, name, data in files:
        if key != current and current is not None:
            yield current, gathered
            gathered = {}
        if name in gathered:
            raise TronError(f"clip {key} has member {name} twice")
        current = key
        gathered[name] = data
    if current is not None:
        yield current, gathered
