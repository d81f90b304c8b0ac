"""Captures as scenes of a dataset: find surfels and light, then make clips, and last the record."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from datagen.clock import stage
from datagen.dataset.records import (
    CAPTURE_SHARDS,
    RECORD_NAME,
    Record,
    Work,
    clear_work,
    scene_folder,
    starts,
)
from datagen.dataset.spool import Frame, SceneFiles, write_clips
from datagen.files.sources import Sources
from datagen.settings.command import RELIT, Settings
from datagen.sources.captured_clips import CapturedSurfels, made_clips, usable_rows
from datagen.sources.captured_folder import find_captures, find_relit, named_by_split, split_by_name, split_of
from datagen.sources.captured_reconstruction import (
    find,
    kept,
    load,
    require_prior,
    require_reusable,
    take_over,
    tell,
)
from datagen.sources.captured_relit_clips import relit_clips, require_own_truth
from datagen.sources.source import CHECKPOINT_BYTES, SceneCost, Source, spooled_bytes
from datagen.world.scene import scene_name
from tron.errors import TronError
from tron.run_folder import RunFolder
from tron.runtime import activate, set_torch_threads
from tron.shards.schema import ClipMeta
from tron.storage import write_atomic

log = logging.getLogger(__name__)

LARGEST_SHARD = 999_999
# 16 pseudo-captures of 40 to 53 photos of 160 x 120 took 7.6 minutes each (2026-11-23).
CAPTURE_STEP, CAPTURE_PIXEL = 0.12, 4e-5
"""Seconds of one core: an optimisation step, guidance of a pixel of a photo's frame."""


class CapturedSource(Source):
    """Source of scenes from folders of photos: the reconstruction is lit, and the photos are the truth."""

    def plan(self, settings: Settings) -> list[Work]:
        """Return one scene per capture, in a split by its name or by a draw."""
        photos = find_captures(settings)
        if settings.captured.split_by_name:
            splits = split_by_name(list(photos))
        else:
            splits = split_of(list(photos), settings.captured.shares, settings.seed)
        relit = {name: sum(truth.views for truth in find_relit(settings, name)) for name in photos}
        items = [
            Work(split, i, scene_name(split, i), i * CAPTURE_SHARDS, name, photos[name], relit[name])
            for split, names in splits.items()
            for i, name in enumerate(names)
        ]
        if max(item.first_shard for item in items) + CAPTURE_SHARDS - 1 > LARGEST_SHARD:
            most = (LARGEST_SHARD + 1) // CAPTURE_SHARDS
            raise TronError(
                f"a split has more than {most} captures", settings.captures, "make several datasets of them"
            )
        return items

    def planned(self, settings: Settings) -> dict[str, Any]:
        """Return split -> names of its captures."""
        found: dict[str, list[str]] = {}
        for item in self.plan(settings):
            found.setdefault(item.split, []).append(item.capture)
        return found

    def require_same(
        self, run: RunFolder, before: dict[str, Any], scenes: Mapping[str, Any], settings: Settings
    ) -> None:
        """Refuse other captures too: adding one would move others between splits."""
        run.require(settings.recipe(), before)
        planned = self.planned(settings)
        if scenes != planned:
            then, now = ({name for names in each.values() for name in names} for each in (scenes, planned))
            changed = ", ".join(sorted(then ^ now)[:3]) or "in other splits"
            raise TronError(
                f"output_dir holds a dataset of other captures: {changed}",
                settings.output_dir,
                "choose another output_dir, or name the ones to use: captured.names=[...]",
            )

    def ready(self, settings: Settings) -> None:
        """Refuse a prior that cannot be made, and reconstructions that cannot be reused."""
        if named_by_split(settings):
            log.warning(
                "captures are named by split, and the shares put them elsewhere: "
                "captured.split_by_name=true keeps test captures out of train"
            )
        require_prior(settings)
        require_reusable(settings)

    def make(self, item: Work, settings: Settings, sources: Sources) -> Record:  # noqa: ARG002 as all sources
        """See :func:`make_capture`."""
        return make_capture(item, settings)

    def clips(self, item: Work, settings: Settings) -> int:
        """Return the approximate number of clips of its photos and relit views."""
        return photo_clips(item, settings) + item.relit

    def frames(self, item: Work, settings: Settings) -> int:
        """Return the number of frames of these clips."""
        return photo_clips(item, settings) * settings.captured.frames + item.relit

    def surfels(self, item: Work, settings: Settings) -> int:  # noqa: ARG002 as all sources
        """Return the maximum number of surfels of the reconstruction."""
        return settings.captured.reconstruction.radiance.density.most

    def cost(self, item: Work, settings: Settings) -> SceneCost:
        """Return the cost of steps (none for a reused reconstruction) and of guidance at the photos' size."""
        captured = settings.captured
        how = captured.reconstruction
        steps = how.steps_scaler * (how.radiance.steps + how.materials.steps)
        if captured.reconstructed is not None:
            steps = 0
        pixels = (item.photos + item.relit) * captured.width * captured.height
        seconds = CAPTURE_STEP * steps + CAPTURE_PIXEL * pixels
        return SceneCost(seconds, self.kept_bytes(settings, [item]), 0.0)

    def scratch_bytes(self, item: Work, settings: Settings) -> int:
        """Return the bytes of its checkpoint, and of frames of all photos until the clips are written."""
        frame = settings.captured.width * settings.captured.height * spooled_bytes(settings, item.split)
        return self.surfels(item, settings) * CHECKPOINT_BYTES + item.photos * frame


def photo_clips(item: Work, settings: Settings) -> int:
    """Return the number of clips of a capture's photos; held-out photos interrupt the row."""
    frames, every, clips = settings.captured.frames, settings.captured.photos.test_every, 0
    last = item.photos
    if every:
        rows, rest = divmod(item.photos, every)
        clips, last = rows * len(starts(every - 1, frames)), rest - 1
    return max(clips + len(starts(last, frames)), 1)


def make_capture(item: Work, settings: Settings) -> Record:
    """Make one capture: surfels, light, shards, contact sheets and at last its record.

    Runs in a worker. Everything is written under final names atomically; a second run writes the same bytes.

    Raises:
        TronError: the capture cannot be read, holds too few photos in a row or too small ones, or cannot be
            reconstructed or lit.
    """
    activate(settings.variant, threads=1)
    set_torch_threads(1)
    folder = scene_folder(settings.output_dir, item.name)
    tell(item, "read")
    with stage("read"):
        capture = load(item, settings, folder, reduced=True)
        photos = load(item, settings, folder, reduced=False)
        # Minutes of reconstruction later it would be too late to say so.
        usable_rows(item, settings, photos)
        require_own_truth(item, settings, photos)
    found = kept(folder, capture)
    if found is None:
        with stage("reconstruct"):
            if not take_over(item, settings, capture, folder):
                find(item, settings, capture, folder)
        found = kept(folder, capture)
        if found is None:
            raise TronError("surfels or light cannot be read back", folder, "look for a full or failing disk")
    tell(item, "guidance")
    with stage("guidance"):
        surfels = CapturedSurfels(item, settings, found, capture.train_cameras)
        with made_clips(item, settings, photos, found, surfels) as clips:
            tell(item, "write")
            made = [_written(item, settings, clips, len(clips))]
        if item.relit:
            relit = replace(item, split=f"{item.split}{RELIT}")
            made.append(_written(relit, settings, relit_clips(relit, settings, found), item.relit))
    record = Record(
        name=item.name,
        capture=item.capture,
        shards=[entry for files in made for entry in files.shards],
        quarantined=[clip for files in made for clip in files.quarantined],
        clips=[row for files in made for row in files.rows()],
    )
    write_atomic(folder / RECORD_NAME, record.model_dump_json(indent=1) + "\n")
    clear_work(folder)
    return record


def _written(
    item: Work, settings: Settings, clips: Iterable[tuple[ClipMeta, Sequence[Frame]]], most: int
) -> SceneFiles:
    """Shards of the clips of one split, at most ``most`` of them: as large as the capture's numbers ask."""
    per_shard = max(settings.clips_per_shard, -(-most // CAPTURE_SHARDS))
    return write_clips(settings.output_dir, item, clips, per_shard)
