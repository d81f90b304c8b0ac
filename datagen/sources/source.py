"""Interface of all sources of clips: plan scenes, make one, estimate its cost."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from datagen.dataset.clip_preview import preview_bytes
from datagen.dataset.records import Record, Work
from datagen.files.sources import Sources
from datagen.settings.command import Settings
from tron.run_folder import RunFolder
from tron.shards.schema import MEMBERS, clip_members

SURFEL_BYTES = 320
"""Bytes on disk of a surfel."""
CHECKPOINT_BYTES = 1200
"""Bytes of a surfel in a reconstruction's checkpoint: parameters, two moments of Adam, a copy."""


@dataclass(frozen=True)
class SceneCost:
    """Cost of one scene.

    Attributes:
        seconds: of one core, kernels compiled; within a factor of two.
        bytes: on disk, with previews.
        memory: of the worker at its largest, bytes; 0 where it is not known.
    """

    seconds: float
    bytes: float
    memory: float


class Source(Protocol):
    """Source of a dataset's clips; all methods except :meth:`make` are quick and write nothing."""

    def plan(self, settings: Settings) -> list[Work]:
        """Return every scene of the dataset, in order of split and index; TronError if there are none."""
        ...

    def planned(self, settings: Settings) -> dict[str, Any]:
        """Return split -> entry in config.yaml: number or names of its scenes."""
        ...

    def require_same(
        self, run: RunFolder, before: dict[str, Any], scenes: Mapping[str, Any], settings: Settings
    ) -> None:
        """Require that a folder's dataset is this one, or can grow into it.

        Args:
            run: the folder.
            before: recipe of what it holds.
            scenes: what was planned of it.
            settings: of what is asked for.

        Raises:
            TronError: names the first key that differs, or the scenes that lack.
        """

    def ready(self, settings: Settings) -> None:
        """Raise TronError before the first scene if an input of scenes is missing."""

    def make(self, item: Work, settings: Settings, sources: Sources) -> Record:
        """Make one scene: its files, its shards and at last its record. Runs in a worker.

        Everything is written under final names atomically; a second run writes the same bytes.

        Raises:
            TronError: it cannot be made.
        """
        ...

    def clips(self, item: Work, settings: Settings) -> int:
        """Return the approximate number of clips of a scene."""
        ...

    def frames(self, item: Work, settings: Settings) -> int:
        """Return the approximate number of frames of all its clips."""
        ...

    def surfels(self, item: Work, settings: Settings) -> int:
        """Return the maximum number of surfels of a scene."""
        ...

    def cost(self, item: Work, settings: Settings) -> SceneCost:
        """Return the cost of an unmade scene."""
        ...

    def scratch_bytes(self, item: Work, settings: Settings) -> int:
        """Return the maximum bytes of temporary files while a scene is made."""
        ...

    def kept_bytes(self, settings: Settings, items: Iterable[Work], shards: bool = True) -> int:
        """Return uncompressed bytes of finished scenes: optionally shards, previews, surfels.

        Half-precision EXR hardly compresses noise.
        """
        total = 0
        for item in items:
            recipe = settings.split(item.split)
            members = [MEMBERS[name] for name in clip_members(recipe.reference_buffers)]
            pixel = sum(member.bytes * member.channels for member in members)
            frame = recipe.width * recipe.height * pixel + 16_384
            stored = self.frames(item, settings) * frame if shards else 0
            previews = preview_bytes(recipe.width, recipe.height, recipe.frames, len(members))
            surfels = self.surfels(item, settings) * SURFEL_BYTES
            total += stored + self.clips(item, settings) * previews + surfels
        return total


def spooled_bytes(settings: Settings, split: str) -> int:
    """Return bytes per pixel of a spooled frame."""
    members = (MEMBERS[name] for name in clip_members(settings.split(split).reference_buffers))
    return sum(max(member.bytes, 2) * member.channels for member in members)
