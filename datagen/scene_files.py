"""Files that a scene's clips become: shards, previews, sheets, and what is set aside."""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from datagen.clip_preview import thumbnail_name, write_preview
from datagen.clip_rows import ClipRow, clip_row
from datagen.clock import stage
from datagen.plan import Quarantined, Work
from datagen.preview import contact_row, sheet_name, write_sheet
from datagen.spool import Frame
from datagen.variety import COUNTED_MEMBERS
from tron.shards.manifest import ShardEntry
from tron.shards.schema import ClipMeta
from tron.shards.writer import ShardWriter
from tron.storage import write_atomic


@dataclass
class SceneFiles:
    """Findings of :func:`write_clips`.

    Attributes:
        shards: that were written.
        quarantined: clips that are not fit for one.
        made: the others, each with its first frame's members that are counted.
    """

    shards: list[ShardEntry] = field(default_factory=list)
    quarantined: list[Quarantined] = field(default_factory=list)
    made: list[tuple[ClipMeta, Frame]] = field(default_factory=list)

    def rows(self) -> list[ClipRow]:
        """A row a clip."""
        shards = {key: entry.name for entry in self.shards for key in entry.keys}
        return [clip_row(meta, shards[meta.key], thumbnail_name(meta.key)) for meta, _ in self.made]


def write_clips(
    output: Path, item: Work, clips: Iterable[tuple[ClipMeta, Sequence[Frame]]], clips_per_shard: int
) -> SceneFiles:
    """Write a scene's clips under final names, each file whole or not at all.

    A clip with a value that is not finite is set aside in ``quarantine/``.
    """
    found = SceneFiles()
    rows: dict[str, np.ndarray] = {}
    with ShardWriter(output, item.split, clips_per_shard, item.first_shard) as writer:
        for meta, frames in clips:
            problem = first_bad_value(frames)
            if problem is not None:
                found.quarantined.append(Quarantined(key=meta.key, reason=problem))
                _set_aside(output / "quarantine" / f"{meta.key}.npz", frames)
                continue
            with stage("write"):
                writer.write(meta, frames)
                write_preview(output, meta, frames)
                rows[meta.key] = contact_row(meta, frames[0])
            counted = {name: frames[0][name] for name in COUNTED_MEMBERS if name in frames[0]}
            found.made.append((meta, counted))
    found.shards = writer.entries
    for entry in writer.entries:
        write_sheet(output / sheet_name(entry.name), [rows[key] for key in entry.keys])
    return found


def first_bad_value(frames: Sequence[Frame]) -> str | None:
    """First place where a clip is not finite, in words, or None: such a clip must not reach a shard."""
    for i, frame in enumerate(frames):
        for member, image in frame.items():
            bad = int((~np.isfinite(image)).sum())
            if bad:
                return f"frame {i}: {member} has {bad} values that are not finite"
    return None


def _set_aside(path: Path, frames: Sequence[Frame]) -> None:
    buffer = io.BytesIO()
    arrays = {member: np.stack([frame[member] for frame in frames]) for member in frames[0]}
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    write_atomic(path, buffer.getvalue())
