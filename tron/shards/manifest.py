"""The account of a dataset folder: which shards it has, what is in them, and whether they still hold it."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from tron.errors import TronError
from tron.shards.schema import MEMBERS, SCHEMA_VERSION, SHARD_PATTERN, require_schema
from tron.storage import sha256, write_atomic

MANIFEST_NAME = "manifest.json"
LARGEST_MANIFEST = 256 * 2**20


class ShardEntry(BaseModel):
    """One shard: its split, file name, clips (keys in order), size in bytes and sha256 (hex)."""

    model_config = ConfigDict(extra="forbid")

    split: str
    name: str = Field(pattern=f"^{SHARD_PATTERN.pattern}$")
    samples: int = Field(ge=0)
    keys: list[str]
    bytes: int = Field(ge=0)
    sha256: str = Field(pattern="^[0-9a-f]{64}$")


class Manifest(BaseModel):
    """manifest.json of a dataset folder; config_sha256 hashes the resolved configuration that made it."""

    model_config = ConfigDict(extra="forbid")

    schema_version: int = SCHEMA_VERSION
    config_sha256: str = ""
    shards: list[ShardEntry] = Field(default_factory=list)
    failures: int = Field(default=0, ge=0)

    @classmethod
    def load(cls, folder: str | Path) -> Manifest:
        """Read folder/manifest.json; TronError where it is missing, unreadable or of another version."""
        path = Path(folder) / MANIFEST_NAME
        mend = "give the folder that tron-datagen wrote"
        if not path.is_file():
            raise TronError("no manifest.json, so this is no dataset folder", str(folder), mend)
        if path.stat().st_size > LARGEST_MANIFEST:
            raise TronError("manifest.json is too large to be one", str(path), mend)
        try:
            manifest = cls.model_validate_json(path.read_bytes())
        except ValidationError as error:
            first = error.errors()[0]
            field = ".".join(str(part) for part in first["loc"])
            raise TronError(f"manifest is damaged at '{field}': {first['msg']}", str(path), mend) from error
        require_schema(manifest.schema_version, folder)
        return manifest

    def save(self, folder: str | Path) -> None:
        """Write folder/manifest.json atomically, the shards in order of name."""
        ordered = self.model_copy(update={"shards": sorted(self.shards, key=lambda entry: entry.name)})
        write_atomic(Path(folder) / MANIFEST_NAME, ordered.model_dump_json(indent=1) + "\n")

    def splits(self) -> list[str]:
        """Names of the splits, in order."""
        return sorted({entry.split for entry in self.shards})

    def of_split(self, split: str) -> list[ShardEntry]:
        """Shards of one split in order of name; TronError, naming the splits there are, if it has none."""
        entries = sorted((e for e in self.shards if e.split == split), key=lambda entry: entry.name)
        if not any(entry.samples for entry in entries):
            have = ", ".join(self.splits()) or "none"
            raise TronError(f"the dataset has no split '{split}'", mend=f"it has: {have}")
        return entries


def verify(folder: str | Path) -> list[str]:
    """Every problem of a dataset folder, one line each, naming shard and clip; empty when it is whole.

    Finds missing, stray and truncated shards (a tar cut at a member's end reads without an error: only the
    count shows it), flipped bytes, missing, repeated and unknown members, and files that do not decode.
    """
    from tron.shards.reader import decode_clip, tar_files  # the reader needs Manifest

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
                    problems += _clip_problems(entry, key, files, decode_clip)
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


def _clip_problems(entry: ShardEntry, key: str, files: dict[str, bytes], decode_clip) -> list[str]:
    try:
        clip = decode_clip(files)
    except TronError as error:
        return [f"{entry.name}: {key}: {error}"]
    problems = []
    if clip.meta.key != key or clip.meta.split != entry.split:
        problems.append(f"{entry.name}: {key}: its metadata say {clip.meta.key} of {clip.meta.split}")
    missing = [member for member in MEMBERS if member not in clip.frames]
    if missing:
        problems.append(f"{entry.name}: {key}: has no {', '.join(missing)}")
    return problems
