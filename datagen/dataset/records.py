"""Scenes of a dataset as data: what is to be made, and the record that says that one is finished.

Everything that is in a scene's folder is found from here; nothing here makes anything.
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
        capture: name of the capture that it is; empty where it is synthetic.
        photos: about how many that has.
        relit: frames of its clips under other lights, all lights together.
    """

    split: str
    index: int
    name: str
    first_shard: int
    capture: str = ""
    photos: int = 0
    relit: int = 0


def starts(count: int, frames: int) -> list[int]:
    """First photos of the clips of a row of ``count``; the last clip ends with the row, and may overlap.

    >>> starts(12, 5), starts(4, 5)
    ([0, 5, 7], [])
    """
    if count < frames:
        return []
    found = list(range(0, count - frames + 1, frames))
    return found if found[-1] + frames == count else [*found, count - frames]


class ClipRow(BaseModel):
    """A clip among the others.

    Attributes:
        light_family: of its light.
        contrast: class of its light. contrast_share: what that is by, the share of the light from the
            brightest hundredth of the sphere; None where a clip does not say.
        capture: folder of photos that it is made from; empty for synthetic scenes.
        exposure: factor on linear values before AgX.
        width, height: of its frames, pixels.
        shard: file that holds it; thumbnail: its picture beside the shards, None where there is none.
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
    """A clip that was made and is not fit for a shard."""

    model_config = ConfigDict(extra="forbid")

    key: str
    reason: str


class Figures(BaseModel):
    """Surfels against the true G-buffers of views that they were not fitted to.

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
    """The same of reconstructed surfels.

    Attributes:
        albedo_scale: factors a channel that brought base color to the truth's scale; None where light was
            known. See ``datagen.sources.reconstructed``.
    """

    albedo_scale: tuple[float, float, float] | None = None


class Refinement(BaseModel):
    """Gain of a scene's surfels by a number of optimisation steps."""

    model_config = ConfigDict(extra="forbid")

    steps: int
    before: Figures
    after: Figures


class Record(BaseModel):
    """scenes/NAME/record.json: the scene is finished, and this is what it gave.

    Attributes:
        capture: name of the capture that it is; None where it is synthetic.
        refinement: of surfels that were made from G-buffers.
        reconstruction: of surfels that were reconstructed from pictures.
        clips: a row each.
        variety: histograms of the scene (``datagen.dataset.variety``); none of a capture.
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
    """Folder of a scene's specification, surfels and record."""
    return output / "scenes" / name


def clear_work(folder: Path) -> None:
    """Remove what a finished scene needs no more from its folder."""
    shutil.rmtree(folder / WORK, ignore_errors=True)


def read_record(output: Path, name: str, stored: Mapping[str, int] = NOTHING) -> Record | None:
    """The record of a finished scene; None if it has to be made (again).

    Args:
        output: folder of the dataset.
        name: of the scene.
        stored: bytes of the shards in the dataset's store, by name: they need not be in the folder.
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
    """The row of a clip by its metadata; style and contrast are "unknown" where these do not say."""
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
