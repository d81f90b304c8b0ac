"""A clip on disk: members, their files, and the metadata that travels with them.

A clip is L consecutive frames of one scene, light and trajectory. In a tar shard frame i's members are
`KEY.f00.pbr.exr`, `KEY.f00.irradiance.exr`, ... and the clip ends with `KEY.meta.json`; the key holds no
dot, so webdataset groups a clip's files by it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from tron.camera_record import CameraRecord, Side
from tron.color import agx, linear_to_srgb
from tron.errors import TronError

SCHEMA_VERSION = 5

ColorSpace = Literal["linear", "display", "reflectance"]
"""linear: light; display: values in [0, 1]; reflectance: linear base color in [0, 1]."""

GUIDANCE = ("pbr", "irradiance", "lit")
"""Members that the neural renderer is conditioned on, unless its configuration names others.

The paper's are pbr and irradiance.
"""
TARGET = "rgb"
"""Member that the neural renderer must produce."""


@dataclass(frozen=True)
class Member:
    """One buffer of a frame.

    Attributes:
        extension: of its files; EXR holds linear floats, PNG 8 bits.
        channels: 3 or 1.
        bytes: of one value on disk: 4 (unit normals need them), 2 or 1.
        color_space: of colours, unless a clip's metadata say otherwise; None: these are no colours.
        clips: which clips hold it; those with references are of splits with reference_buffers (test splits).
        meaning: one line for docs/guides/datasets.md.
    """

    extension: Literal["exr", "png"]
    channels: int
    bytes: int
    color_space: ColorSpace | None
    clips: Literal["all", "reference"]
    meaning: str


def _light(meaning: str, clips: Literal["all", "reference"] = "all") -> Member:
    return Member("exr", 3, 2, "linear", clips, meaning)


def _vector(meaning: str) -> Member:
    return Member("exr", 3, 4, None, "reference", meaning)


def _depth(meaning: str) -> Member:
    return Member("exr", 1, 4, None, "reference", meaning)


def _scalar(meaning: str, clips: Literal["all", "reference"] = "reference") -> Member:
    return Member("exr", 1, 2, None, clips, meaning)


MEMBERS: dict[str, Member] = {
    "pbr": _light("split-sum shading of the surfels, without shadows"),
    "irradiance": _light("irradiance / pi at the surfels, with shadows"),
    "rgb": _light("path-traced radiance, which the network must produce"),
    "unshadowed": _light("irradiance / pi at the surfels, without visibility"),
    "shadowed": _light("direct light: diffuse with shadows, plus the split sum's specular part"),
    "lit": _light("shadowed, and light that bounced between the surfels: the picture without a network"),
    "albedo": Member(
        "exr", 3, 2, "reflectance", "all", "base color of the surfels times opacity, mean of 2 x 2 sub-pixels"
    ),
    "surface": Member(
        "exr", 3, 2, None, "all", "cosine of normal and view, roughness, metallic of the surfels, likewise"
    ),
    "sampling": Member(
        "exr", 3, 2, None, "all", "filtered and sub-pixels, rays, footprint of a pixel over surfel spacing"
    ),
    "mask": _scalar("opacity of the surfels in [0, 1]", "all"),
    "foreground": Member("png", 1, 1, None, "all", "1 where the pixel-centre ray meets true geometry"),
    "lit_supersampled": _light("lit, on 2 x 2 sub-pixels", "reference"),
    "lit_reflections": _light("the same with rays to what surfaces mirror", "reference"),
    "irradiance_ref": _light("direct irradiance / pi by Mitsuba, with shadows", "reference"),
    "unshadowed_ref": _light("the same with nothing in the way", "reference"),
    "base_color_ref": _light("true base color", "reference"),
    "normal_ref": _vector("true unit normal, world (x, y, z)"),
    "base_color": _light("base color of the surfels", "reference"),
    "normal": _vector("unit normal of the surfels, world (x, y, z)"),
    "depth_ref": _depth("true distance from the camera, world units; 0 where there is none"),
    "depth": _depth("median distance of the surfels, likewise"),
    "roughness_ref": _scalar("true roughness in [0, 1]"),
    "metallic_ref": _scalar("true metallic in [0, 1]"),
    "roughness": _scalar("roughness of the surfels"),
    "metallic": _scalar("metallic of the surfels"),
}
"""All buffers of a frame, in the order they are stored; a clip holds all reference members or none."""


def clip_members(reference: bool) -> tuple[str, ...]:
    """Names of a clip's members, in the order they are stored."""
    return tuple(name for name, member in MEMBERS.items() if reference or member.clips == "all")


def light_members() -> tuple[str, ...]:
    """Return the names of guidance members that hold light."""
    return tuple(name for name in guidance_members() if MEMBERS[name].color_space == "linear")


def surface_members() -> tuple[str, ...]:
    """Return names of the guidance that no light changes (:func:`tron.shading.guidance.surface_maps`)."""
    return tuple(name for name in guidance_members() if MEMBERS[name].color_space != "linear")


def guidance_members() -> tuple[str, ...]:
    """Return the names of all members that networks may be given: light, and material of the surfaces."""
    return tuple(
        name for name in clip_members(reference=False) if MEMBERS[name].channels == 3 and name != TARGET
    )


def color_spaces(reference: bool) -> dict[str, ColorSpace]:
    """Return the colour space of each colour member of a clip, as in ``ClipMeta.color_space``."""
    return {
        name: space for name in clip_members(reference) if (space := MEMBERS[name].color_space) is not None
    }


META_SUFFIX = "meta.json"
META_SCHEMA_NAME = "meta.schema.json"
"""File of a dataset with the JSON Schema of its meta.json files."""

KEY_PATTERN = re.compile(r"[A-Za-z0-9_-]{1,60}")
SPLIT_PATTERN = re.compile(r"[a-z][a-z0-9_]{0,30}")
SHARD_PATTERN = re.compile(r"([a-z][a-z0-9_]{0,30})-(\d{5,6})\.tar")
_MEMBER_PATTERN = re.compile(r"([A-Za-z0-9_-]{1,60})\.f(\d{2,4})\.([a-z_]+)\.([a-z]+)")
_META_PATTERN = re.compile(r"([A-Za-z0-9_-]{1,60})\.meta\.json")


def members_table() -> str:
    """Return MEMBERS as the Markdown table of docs/guides/datasets.md."""
    rows = ["| member | file | values | colours | clips | meaning |", "|---|---|---|---|---|---|"]
    kinds = {1: "8 bits", 2: "half float", 4: "float"}
    for name, member in MEMBERS.items():
        values = f"{member.channels} x {kinds[member.bytes]}"
        space = member.color_space or "none"
        file = member.extension.upper()
        rows.append(f"| `{name}` | {file} | {values} | {space} | {member.clips} | {member.meaning} |")
    return "\n".join(rows) + "\n"


class ClipMeta(BaseModel):
    """Metadata of a clip: its meta.json."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    schema_version: int = Field(default=SCHEMA_VERSION, description="Version of this schema.")
    key: str = Field(
        pattern=rf"^{KEY_PATTERN.pattern}$", description="Name of the clip, with which its files begin."
    )
    scene: str = Field(description="Name of the scene; other clips show it under other lights.")
    light: str = Field(description="Name of the light.")
    light_family: str = Field(
        pattern=r"^[a-z][a-z0-9_]{0,30}$", description="Kind of the light, such as sun or studio."
    )
    split: str = Field(pattern=rf"^{SPLIT_PATTERN.pattern}$", description="Split that the clip is of.")
    frames: int = Field(ge=1, le=10_000, description="Number of frames.")
    width: Side = Field(description="Pixels of each frame.")
    height: Side = Field(description="Pixels of each frame.")
    cameras: list[CameraRecord] = Field(description="The camera of each frame, in order.")
    exposure: float = Field(
        gt=0, description="Factor on linear values before AgX, the same for all clips of a scene and light."
    )
    color_space: dict[str, ColorSpace] = Field(
        description="Of each member that holds colours: linear radiance; display, which photographs are; "
        "reflectance, linear base color."
    )
    seeds: dict[str, int] = Field(
        default_factory=dict, description="Root seed, and the first frame's seed of each kind of randomness."
    )
    spp: dict[str, int] = Field(default_factory=dict, description="Samples a pixel of each kind.")
    extra: dict[str, Any] = Field(
        default_factory=dict,
        description="Anything else: style, contrast, the light's specification, motion of an object.",
    )


def meta_schema() -> dict[str, Any]:
    """Return the JSON Schema of meta.json, which is stored in every dataset and agrees with `ClipMeta`."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **ClipMeta.model_json_schema()}


@dataclass
class Clip:
    """A clip in memory.

    Attributes:
        meta: its metadata.
        frames: (K, H, W, C) float32 by member.
    """

    meta: ClipMeta
    frames: dict[str, np.ndarray]

    @property
    def has_reference(self) -> bool:
        """Whether the reference members are there."""
        return set(clip_members(reference=True)) <= self.frames.keys()

    def is_display(self, member: str) -> bool:
        """Return whether a member is already display-encoded, as photographs are."""
        return self.meta.color_space.get(member, MEMBERS[member].color_space) == "display"

    def space(self, member: str) -> ColorSpace | None:
        """Return the colour space of a member: from the metadata, else from the schema."""
        own = self.meta.color_space.get(member)
        return MEMBERS[member].color_space if own is None else own

    def exposed(self, member: str) -> np.ndarray:
        """Return a member (K, H, W, C), times the exposure if it is light, ready for :func:`encoded`."""
        image = self.frames[member]
        return image * np.float32(self.meta.exposure) if self.space(member) == "linear" else image

    def displayed(self, member: str) -> np.ndarray:
        """Return a member as display values (K, H, W, 3) in [0, 1]: exposure, then :func:`encoded`."""
        return encoded(self.exposed(member), self.space(member))


def encoded(image: Any, space: ColorSpace | None, axis: int = -1) -> Any:
    """Convert exposed values to display values in [0, 1], for arrays and tensors.

    Light by AgX, reflectance by the sRGB curve, the rest as it is.
    """
    if space == "linear":
        return agx(image, axis=axis)
    return linear_to_srgb(image.clip(0, 1)) if space == "reflectance" else image


def displayed(member: str, image: np.ndarray, exposure: float) -> np.ndarray:
    """Return a member of guidance as display values, (..., 3) in [0, 1]."""
    space = MEMBERS[member].color_space
    return encoded(exposure * image if space == "linear" else image, space)


def require_schema(version: int, where: str | Path) -> None:
    """Raise TronError unless this program reads datasets of this schema version."""
    if version != SCHEMA_VERSION:
        raise TronError(
            f"dataset of schema {version}, this program reads schema {SCHEMA_VERSION}",
            str(where),
            "make it again in a new folder with the tron-datagen command of its README.md or card.md",
        )


def parse_name(name: str) -> tuple[str, int | None, str]:
    """Split a tar member's name into (key, frame, member); metadata is (key, None, "meta").

    Anything this schema does not name is refused with TronError: paths, `..`, pickles, unknown buffers.
    """
    if meta := _META_PATTERN.fullmatch(name):
        return meta[1], None, "meta"
    found = _MEMBER_PATTERN.fullmatch(name)
    if found and found[3] in MEMBERS and found[4] == MEMBERS[found[3]].extension:
        return found[1], int(found[2]), found[3]
    raise TronError(f"shard member {name[:80]!r} is none this schema knows", mend="make the dataset again")


def shard_name(split: str, index: int) -> str:
    """The file name of a split's shard, e.g. `train-00000.tar`."""
    return f"{split}-{index:05d}.tar"
