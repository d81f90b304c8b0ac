"""Check of a dataset folder: whether its shards still hold what its manifest says."""

from __future__ import annotations

from collections import Counter

from tron.dataset_folder import DatasetFolder, Place
from tron.errors import TronError
from tron.shards.manifest import Manifest, ShardEntry
from tron.shards.reader import decode_clip, tar_files


def verify(folder: Place) -> list[str]:
    """Problems of a dataset folder (path or URL), one line each, with shard and clip; empty when it is whole.

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
