"""What a clip is on disk: members, their files, and the metadata that travels with them.

A clip is L consecutive frames of one scene, light and trajectory. In a tar shard frame i's members are
`KEY.f00.pbr.exr`, `KEY.f00.irradiance.exr`, ... and the clip ends with `KEY.meta.json`; the key holds no
dot, so webdataset groups a clip's files by it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator

from tron.errors import TronError

SCHEMA_VERSION = 2

LightFamily = Literal["sun", "studio", "overcast", "hdri", "capture"]


class Member(NamedTuple):
    """How one buffer of a frame is stored.

    extension: "exr" or "png"; channels: 3 or 1; half: 16-bit EXR, else 32-bit (unit normals need it).
    """

    extension: str
    channels: int
    half: bool


MEMBERS: dict[str, Member] = {
    "pbr": Member("exr", 3, True),  # split-sum shading of the surfels, linear
    "irradiance": Member("exr", 3, True),  # shadowed irradiance / pi, linear
    "rgb": Member("exr", 3, True),  # what the network must produce: path-traced radiance, linear
    "unshadowed": Member("exr", 3, True),  # irradiance / pi without visibility, linear
    "shadowed": Member("exr", 3, True),  # base_color (1 - metallic) irradiance + split-sum specular, linear
    "mask": Member("exr", 1, True),  # the surfels' opacity in [0, 1]
    "foreground": Member("png", 1, False),  # 1 where the pixel-centre ray meets true geometry
}
"""Members that every frame has."""

REFERENCE_MEMBERS: dict[str, Member] = {
    "irradiance_ref": Member("exr", 3, True),  # Mitsuba's direct irradiance / pi, linear
    "unshadowed_ref": Member("exr", 3, True),  # the same with nothing in the way
    "base_color_ref": Member("exr", 3, True),  # true base color, linear
    "normal_ref": Member("exr", 3, False),  # true unit normals, world (x, y, z)
    "base_color": Member("exr", 3, True),  # the surfels' base color, linear
    "normal": Member("exr", 3, False),  # the surfels' unit normals, world (x, y, z)
    "depth_ref": Member("exr", 1, False),  # true distance from the camera, world units, 0 where there is none
    "depth": Member("exr", 1, False),  # the surfels' median distance, likewise
}
"""Members of splits made with reference buffers (test splits).

All of them or none are written. Datasets made before one of them was added lack it, and are read without.
"""

ALL_MEMBERS: dict[str, Member] = MEMBERS | REFERENCE_MEMBERS
META_SUFFIX = "meta.json"

KEY_PATTERN = re.compile(r"[A-Za-z0-9_-]{1,60}")
SPLIT_PATTERN = re.compile(r"[a-z][a-z0-9_]{0,30}")
SHARD_PATTERN = re.compile(r"([a-z][a-z0-9_]{0,30})-(\d{5,6})\.tar")
_MEMBER_PATTERN = re.compile(r"([A-Za-z0-9_-]{1,60})\.f(\d{2,4})\.([a-z_]+)\.([a-z]+)")
_META_PATTERN = re.compile(r"([A-Za-z0-9_-]{1,60})\.meta\.json")


class ClipMeta(BaseModel):
    """A clip's metadata (meta.json).

    exposure: the scalar that multiplies linear values before AgX, one per light (facts 4b).
    color_space: "linear" or "display" for each member that holds colour.
    cameras: `Camera.to_dict()` of each frame, OpenCV, pixels, world-to-camera.
    """

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    schema_version: int = SCHEMA_VERSION
    key: str
    scene: str
    light: str
    light_family: LightFamily
    split: str
    frames: int = Field(ge=1, le=10_000)
    width: int = Field(ge=1, le=16_384)
    height: int = Field(ge=1, le=16_384)
    cameras: list[dict[str, Any]]
    exposure: float = Field(gt=0)
    color_space: dict[str, Literal["linear", "display"]]
    seeds: dict[str, int] = Field(default_factory=dict)
    spp: dict[str, int] = Field(default_factory=dict)
    extra: dict[str, Any] = Field(default_factory=dict)

    @field_validator("key")
    @classmethod
    def _key_without_dots(cls, value: str) -> str:
        if not KEY_PATTERN.fullmatch(value):
            raise ValueError("a key is 1-60 letters, digits, '-' and '_'")
        return value

    @field_validator("split")
    @classmethod
    def _split_name(cls, value: str) -> str:
        if not SPLIT_PATTERN.fullmatch(value):
            raise ValueError("a split is lower-case letters, digits and '_'")
        return value


@dataclass
class Clip:
    """A clip in memory: its metadata and `frames[member]`, (K, H, W, C) float32."""

    meta: ClipMeta
    frames: dict[str, np.ndarray]


def require_schema(version: int, where: str | Path) -> None:
    """TronError unless this program reads datasets of that schema version."""
    if version != SCHEMA_VERSION:
        raise TronError(
            f"dataset of schema {version}, this program reads schema {SCHEMA_VERSION}",
            str(where),
            "make it again in a new folder with the tron-datagen command of its card.md",
        )


def member_name(key: str, frame: int, member: str) -> str:
    """The tar member that holds one buffer of one frame, e.g. `s000012-l2.f00.pbr.exr`."""
    return f"{key}.f{frame:02d}.{member}.{ALL_MEMBERS[member].extension}"


def meta_name(key: str) -> str:
    """The tar member that holds a clip's metadata."""
    return f"{key}.{META_SUFFIX}"


def parse_name(name: str) -> tuple[str, int | None, str]:
    """Split a tar member's name into (key, frame, member); metadata is (key, None, "meta").

    Anything this schema does not name is refused with TronError: paths, `..`, pickles, unknown buffers.
    """
    if meta := _META_PATTERN.fullmatch(name):
        return meta[1], None, "meta"
    found = _MEMBER_PATTERN.fullmatch(name)
    if found and found[3] in ALL_MEMBERS and found[4] == ALL_MEMBERS[found[3]].extension:
        return found[1], int(found[2]), found[3]
    raise TronError(f"shard member {name[:80]!r} is none this schema knows", mend="make the dataset again")


def shard_name(split: str, index: int) -> str:
    """The file name of a split's shard, e.g. `train-00000.tar`."""
    return f"{split}-{index:05d}.tar"
