"""The manifest of a dataset folder: its shards and their contents."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from tron.errors import TronError
from tron.estimation import MATERIAL
from tron.shards.dataset_folder import DatasetFolder, Place
from tron.shards.schema import SCHEMA_VERSION, SHARD_PATTERN, require_schema
from tron.storage import write_if_changed

MANIFEST_NAME = "manifest.json"
LARGEST_MANIFEST = 256 * 2**20


class ShardEntry(BaseModel):
    """One shard.

    Attributes:
        samples: number of its clips.
        keys: of its clips, in order.
        sha256: of the file, hexadecimal.
    """

    model_config = ConfigDict(extra="forbid")

    split: str
    name: str = Field(pattern=f"^{SHARD_PATTERN.pattern}$")
    samples: int = Field(ge=0)
    keys: list[str]
    bytes: int = Field(ge=0)
    sha256: str = Field(pattern="^[0-9a-f]{64}$")


class Manifest(BaseModel):
    """The manifest.json of a dataset folder.

    Attributes:
        config_sha256: of the resolved configuration that made it, hexadecimal.
        failures: scenes and clips that could not be made.
        material: that its pictures are path-traced with.
    """

    model_config = ConfigDict(extra="forbid")

    schema_version: int = SCHEMA_VERSION
    config_sha256: str = ""
    shards: list[ShardEntry] = Field(default_factory=list)
    failures: int = Field(default=0, ge=0)
    material: str = MATERIAL

    @classmethod
    def load(cls, folder: Place) -> Manifest:
        """Read folder/manifest.json; TronError where it is missing, unreadable or of another version.

        Args:
            folder: path, or URL such as ``s3://bucket/dataset``.
        """
        place = DatasetFolder(folder)
        path = place.where(MANIFEST_NAME)
        mend = "give the folder that tron-datagen wrote"
        size = place.size(MANIFEST_NAME)
        if size is None:
            raise TronError("no manifest.json, so this is no dataset folder", str(folder), mend)
        if size > LARGEST_MANIFEST:
            raise TronError("manifest.json is too large to be one", path, mend)
        return cls.parse(place.read(MANIFEST_NAME), str(folder))

    @classmethod
    def parse(cls, data: bytes, folder: str) -> Manifest:
        """Parse the bytes of a manifest; TronError names the folder if they are damaged."""
        try:
            manifest = cls.model_validate_json(data)
        except ValidationError as error:
            first = error.errors()[0]
            field = ".".join(str(part) for part in first["loc"])
            path, mend = f"{folder.rstrip('/')}/{MANIFEST_NAME}", "give the folder that tron-datagen wrote"
            raise TronError(f"manifest is damaged at '{field}': {first['msg']}", path, mend) from error
        require_schema(manifest.schema_version, folder)
        return manifest

    def save(self, folder: str | Path) -> None:
        """Write folder/manifest.json atomically, the shards in order of name, unless it is there already."""
        ordered = self.model_copy(update={"shards": sorted(self.shards, key=lambda entry: entry.name)})
        write_if_changed(Path(folder) / MANIFEST_NAME, ordered.model_dump_json(indent=1) + "\n")

    def splits(self) -> list[str]:
        """Names of the splits, in order."""
        return sorted({entry.split for entry in self.shards})

    def of_split(self, split: str) -> list[ShardEntry]:
        """Return the shards of a split in order of name; if there are none, TronError names the splits."""
        entries = sorted((e for e in self.shards if e.split == split), key=lambda entry: entry.name)
        if not any(entry.samples for entry in entries):
            have = ", ".join(self.splits()) or "none"
            raise TronError(f"the dataset has no split '{split}'", mend=f"it has: {have}")
        return entries
