"""Scenes of a dataset as data: work items, and the record of a finished scene.

This module locates all files of a scene's folder; it makes none of them.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from datagen.dataset.variety import Histograms
from tron.shards.manifest import ShardEntry
from tron.shards.schema import ClipMeta

RECORD_NAME = "record.json"
CONFIG_NAME = "config.yaml"
NOTHING: Mapping[str, int] = MappingProxyType({})

TRACEBACKS = "failures"
"""Folder of the tracebacks of what failed, beside their list."""

WORK = "work"
"""Folder within a scene's that is there until it is finished, and that a run goes on from."""

CAPTURE_SHARDS = 100
"""Numbers of shards that a capture has to itself: how many clips it gives is known only when it is read."""


@dataclass(frozen=True)
class Work:
    """One scene to make: its split, index and name, and the number of its first shard.

    Attributes:
        capture: name of the capture; empty for a synthetic scene.
        photos: approximate number of its photos.
        relit: number of frames of its clips under other lights, over all lights.
    """

    split: str
    index: int
    name: str
    first_shard: int
    capture: str = ""
    photos: int = 0
    relit: int = 0


def starts(count: int, frames: int) -> list[int]:
    """Return the first photos of clips in a row of ``count``; the last clip ends the row and may overlap.

    >>> starts(12, 5), starts(4, 5)
    ([0, 5, 7], [])
    """
    if count < frames:
        return []
    found = list(range(0, count - frames + 1, frames))
    return found if found[-1] + frames == count else [*found, count - frames]


class ClipRow(BaseModel):
    """Row of a clip in the dataset's tables.

    Attributes:
        light_family: family of its light.
        contrast: contrast class of its light. contrast_share: its measure, the share of the light from the
            brightest hundredth of the sphere; None if unknown.
        capture: folder of its photos; empty for synthetic scenes.
        exposure: factor on linear values before AgX.
        width, height: size of its frames, pixels.
        shard: its shard file; thumbnail: its picture beside the shards, None without one.
    """

    model_config = ConfigDict(extra="forbid")

    key: str
    scene: str
    split: str
    style: str
    light_family: str
    contrast: str
    contrast_share: float | None
    capture: str = ""
    exposure: float
    frames: int
    width: int
    height: int
    shard: str
    thumbnail: str | None


class Quarantined(BaseModel):
    """A finished clip that must not go into a shard."""

    model_config = ConfigDict(extra="forbid")

    key: str
    reason: str


class Figures(BaseModel):
    """Errors of surfels against true G-buffers of held-out views.

    Attributes:
        base_color_psnr: dB, linear, each view and channel scaled by least squares.
        normal_mae_deg: mean angle in degrees.
        silhouette_error: mean of |opacity - mask|.
    """

    model_config = ConfigDict(extra="forbid")

    base_color_psnr: float
    normal_mae_deg: float
    silhouette_error: float


class ReconstructedFigures(Figures):
    """Errors of reconstructed surfels against true G-buffers of held-out views.

    Attributes:
        albedo_scale: factors per channel that scale base color to the truth; None if the light was known.
            See ``datagen.sources.reconstructed``.
    """

    albedo_scale: tuple[float, float, float] | None = None


class Refinement(BaseModel):
    """Errors of a scene's surfels before and after optimisation steps."""

    model_config = ConfigDict(extra="forbid")

    steps: int
    before: Figures
    after: Figures


class Record(BaseModel):
    """scenes/NAME/record.json: results of a finished scene.

    Attributes:
        capture: name of the capture; None for a synthetic scene.
        refinement: errors of surfels made from G-buffers.
        reconstruction: errors of surfels reconstructed from pictures.
        clips: one row per clip.
        variety: histograms of the scene (``datagen.dataset.variety``); none for a capture.
    """

    model_config = ConfigDict(extra="forbid")

    name: str
    capture: str | None = None
    shards: list[ShardEntry]
    quarantined: list[Quarantined]
    refinement: Refinement | None = None
    reconstruction: ReconstructedFigures | None = None
    clips: list[ClipRow]
    variety: Histograms = Field(default_factory=dict)


def scene_folder(output: Path, name: str) -> Path:
    """Return the folder of a scene's specification, surfels and record."""
    return output / "scenes" / name


def clear_work(folder: Path) -> None:
    """Remove files that a finished scene no longer needs from its folder."""
    shutil.rmtree(folder / WORK, ignore_errors=True)


def read_record(output: Path, name: str, stored: Mapping[str, int] = NOTHING) -> Record | None:
    """Read the record of a finished scene; None if it has to be made (again).

    Args:
        output: folder of the dataset.
        name: name of the scene.
        stored: shard name -> bytes in the dataset's store; these need not be in the folder.
    """
    try:
        record = Record.model_validate_json((scene_folder(output, name) / RECORD_NAME).read_bytes())
    except (OSError, ValidationError):
        return None
    whole = all(
        entry.bytes in (_size(output / entry.name), stored.get(entry.name)) for entry in record.shards
    )
    return record if whole else None


def _size(path: Path) -> int | None:
    return path.stat().st_size if path.is_file() else None


def clip_row(meta: ClipMeta, shard: str, thumbnail: str | None) -> ClipRow:
    """Return the row of a clip from its metadata; missing style and contrast are "unknown"."""
    return ClipRow(
        key=meta.key,
        scene=meta.scene,
        split=meta.split,
        style=meta.extra.get("style", "unknown"),
        light_family=meta.light_family,
        contrast=meta.extra.get("contrast", "unknown"),
        contrast_share=meta.extra.get("contrast_share"),
        capture=meta.extra.get("capture", ""),
        exposure=meta.exposure,
        frames=meta.frames,
        width=meta.width,
        height=meta.height,
        shard=shard,
        thumbnail=thumbnail,
    )
