"""One row a clip: what the index, the tables and the sheet of a dataset say of it."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict

from datagen.clip_preview import thumbnail_name
from tron.shards.manifest import ShardEntry
from tron.shards.reader import decode_meta, tar_files
from tron.shards.schema import META_SUFFIX, ClipMeta


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


def rows_of_shard(folder: Path, entry: ShardEntry) -> list[ClipRow]:
    """Rows of a shard's clips by the metadata in it, for scenes whose records hold none."""
    metas = [
        decode_meta(data)
        for _, name, data in tar_files(folder / entry.name, members=())
        if name == META_SUFFIX
    ]
    return [
        clip_row(meta, entry.name, name if (folder / (name := thumbnail_name(meta.key))).is_file() else None)
        for meta in metas
    ]
