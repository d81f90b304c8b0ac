"""Read shards by a table of decoders, without unpickling or extracting files, and verify datasets."""

from __future__ import annotations

import tarfile
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Self

import numpy as np
from pydantic import ValidationError

from tron.errors import TronError
from tron.io.images import decode_exr, decode_png
from tron.shards.dataset_folder import DAMAGE, DatasetFolder, Place, is_url, open_stream
from tron.shards.manifest import Manifest, ShardEntry
from tron.shards.schema import (
    MEMBERS,
    META_SUFFIX,
    Clip,
    ClipMeta,
    clip_members,
    parse_name,
    require_schema,
)

LARGEST_MEMBER = 256 * 2**20
LARGEST_META = 16 * 2**20
LARGEST_EXTENSION = 2**16
MOST_FILES = 200_000  # of one shard: 64 clips of 93 frames x 12 members are 71,424
DAMAGED = "make the shard again with tron-datagen"
_EXTENSIONS = {
    tarfile.GNUTYPE_LONGNAME,
    tarfile.GNUTYPE_LONGLINK,
    tarfile.XHDTYPE,
    tarfile.XGLTYPE,
    tarfile.SOLARIS_XHDTYPE,
}
_DECODERS: dict[str, Callable[[bytes], np.ndarray]] = {"exr": decode_exr, "png": decode_png}


class BoundedTarInfo(tarfile.TarInfo):
    """Header of a tar's member, for the ``tarinfo`` of :func:`tarfile.open`.

    Python's own reads an extended header (a long name, PAX attributes; our shards have none) of any size into
    memory before it gives a member. Raises tarfile.ReadError where one is larger than LARGEST_EXTENSION.
    """

    @classmethod
    def frombuf(cls, buf: bytes | bytearray, encoding: str, errors: str) -> Self:
        """Header of a block of 512 bytes."""
        info = super().frombuf(buf, encoding, errors)
        if info.type in _EXTENSIONS and info.size > LARGEST_EXTENSION:
            raise tarfile.ReadError(f"extended header of {info.size} bytes")
        return info


def tar_files(place: Place, members: Collection[str] | None = None) -> Iterator[tuple[str, str, bytes]]:
    """Iterate over the files of a shard: (key, name within the clip such as "f00.pbr.exr", bytes).

    place: path of the shard, its URL, or `pipe:COMMAND` that prints it; all but paths are read as they come.
    members: only these members and the metadata; the bytes of others are skipped (default: all). Refuses
    with TronError links, devices, folders, names outside the schema (so also absolute paths and `..`),
    compressed or damaged tars and files beyond the size limit; such a file's bytes are not read.
    """
    # Plain tars only ("r:", and "r|" without seeking): no decompression bombs.
    mode = "r|" if is_url(place) else "r:"
    try:
        with open_stream(place) as opened, tarfile.open(None, mode, opened, tarinfo=BoundedTarInfo) as tar:
            for count, info in enumerate(tar):
                key, member = require_plain(info, count, str(place))
                if members is not None and member != "meta" and member not in members:
                    continue
                file = tar.extractfile(info)
                data = file.read() if file else b""
                if len(data) != info.size:
                    raise TronError(f"shard ends within member {info.name!r}", str(place), DAMAGED)
                yield key, info.name[len(key) + 1 :], data
    except DAMAGE as error:
        raise TronError(f"shard is damaged: {error}", str(place), DAMAGED) from error


def require_plain(info: tarfile.TarInfo, count: int, where: str) -> tuple[str, str]:
    """Return key and file name of the tar's entry ``count``; TronError unless it is a file of a clip."""
    if not info.isreg() or info.issparse():
        raise TronError(f"member {info.name[:80]!r} is not a plain file", where)
    if info.size > LARGEST_MEMBER or count >= MOST_FILES:
        raise TronError(f"member {info.name[:80]!r} goes beyond the size limits", where)
    key, _, member = parse_name(info.name)
    return key, member


def decode_member(name: str, data: bytes) -> np.ndarray:
    """Decode a member's file, "f00.pbr.exr", to (H, W, C) float32, by the schema's table."""
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
    """Return the members in these files of a clip: all members, or all but the reference members."""
    every = clip_members(reference=False)
    return clip_members(reference=any(file_name(0, m) in files for m in MEMBERS if m not in every))


def decode_frames(
    meta: ClipMeta, files: Mapping[str, bytes], members: Iterable[str], indices: Sequence[int]
) -> Clip:
    """Decode frames of a clip whose metadata are known; raises TronError as decode_clip does."""
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
    """Return a member's file name within a clip, "f00.pbr.exr"; TronError if there is no such member."""
    if member not in MEMBERS:
        raise TronError(f"no member is called {member!r}", mend=f"they are {', '.join(MEMBERS)}")
    return f"f{frame:02d}.{member}.{MEMBERS[member].extension}"


def read_clips(folder: Place, split: str, members: Iterable[str] | None = None) -> Iterator[Clip]:
    """Iterate over the clips of a split in the manifest's order, (K, H, W, C) float32 per member.

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


def verify(folder: Place) -> list[str]:
    """Return problems of a dataset folder (path or URL), one line each, with shard and clip; empty if none.

    Finds missing, stray and truncated shards (a tar cut at a member's end reads without an error: only the
    count shows it), flipped bytes, missing, repeated and unknown members, and files that do not decode.
    """
    place = DatasetFolder(folder)
    manifest = Manifest.load(folder)
    sizes = place.sizes()
    problems: list[str] = []
    listed = Counter(entry.name for entry in manifest.shards)
    problems += [f"{name}: listed {count} times" for name, count in listed.items() if count > 1]
    problems += [
        f"{name}: not in the manifest"
        for name in sorted(sizes)
        if name.endswith(".tar") and name not in listed
    ]
    owner: dict[str, str] = {}
    for entry in manifest.shards:
        if entry.name not in sizes:
            problems.append(f"{entry.name}: missing ({entry.samples} clips)")
            continue
        if sizes[entry.name] != entry.bytes:
            problems.append(f"{entry.name}: {sizes[entry.name]} bytes, should be {entry.bytes}")
        elif place.sha256(entry.name) != entry.sha256:
            problems.append(f"{entry.name}: sha256 differs: its bytes have changed")
        clips: dict[str, dict[str, bytes]] = {}
        try:
            for key, name, data in tar_files(place.where(entry.name)):
                files = clips.setdefault(key, {})
                if name in files:
                    problems.append(f"{entry.name}: {key}: member {name} is there twice")
                files[name] = data
                if name == "meta.json":  # the last file of a clip: decode it now and let its bytes go
                    problems += _clip_problems(entry, key, files)
                    clips[key] = dict.fromkeys(files, b"")
        except TronError as error:
            problems.append(f"{entry.name}: {error}")
        problems += [
            f"{entry.name}: {k}: no meta.json" for k, files in clips.items() if "meta.json" not in files
        ]
        problems += [f"{entry.name}: {key}: clip is missing" for key in entry.keys if key not in clips]
        problems += [f"{entry.name}: {key}: not in the manifest" for key in clips if key not in entry.keys]
        if entry.samples != len(entry.keys):
            problems.append(f"{entry.name}: manifest says {entry.samples} clips and names {len(entry.keys)}")
        for key in entry.keys:
            if key in owner:
                problems.append(f"{entry.name}: {key}: also in {owner[key]}")
            owner[key] = entry.name
    return problems


def _clip_problems(entry: ShardEntry, key: str, files: dict[str, bytes]) -> list[str]:
    try:
        clip = decode_clip(files)
    except TronError as error:
        return [f"{entry.name}: {key}: {error}"]
    problems = []
    if clip.meta.key != key or clip.meta.split != entry.split:
        problems.append(f"{entry.name}: {key}: its metadata say {clip.meta.key} of {clip.meta.split}")
    return problems
