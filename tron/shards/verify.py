"""Check of a dataset folder: whether its shards still hold what its manifest says."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from tron.errors import TronError
from tron.shards.manifest import Manifest, ShardEntry
from tron.shards.reader import decode_clip, tar_files
from tron.storage import sha256


def verify(folder: str | Path) -> list[str]:
    """Problems of a dataset folder, one line each, naming shard and clip; empty when it is whole.

    Finds missing, stray and truncated shards (a tar cut at a member's end reads without an error: only the
    count shows it), flipped bytes, missing, repeated and unknown members, and files that do not decode.
    """
    folder = Path(folder)
    manifest = Manifest.load(folder)
    problems: list[str] = []
    listed = Counter(entry.name for entry in manifest.shards)
    problems += [f"{name}: listed {count} times" for name, count in listed.items() if count > 1]
    problems += [
        f"{p.name}: not in the manifest" for p in sorted(folder.glob("*.tar")) if p.name not in listed
    ]
    owner: dict[str, str] = {}
    for entry in manifest.shards:
        path = folder / entry.name
        if not path.is_file():
            problems.append(f"{entry.name}: missing ({entry.samples} clips)")
            continue
        if path.stat().st_size != entry.bytes:
            problems.append(f"{entry.name}: {path.stat().st_size} bytes, should be {entry.bytes}")
        elif sha256(path) != entry.sha256:
            problems.append(f"{entry.name}: sha256 differs: its bytes have changed")
        clips: dict[str, dict[str, bytes]] = {}
        try:
            for key, name, data in tar_files(path):
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
