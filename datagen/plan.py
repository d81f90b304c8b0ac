"""The plan of a dataset: the list of scenes, the space they take, and which of them are there already.

One scene is one piece of work. Its shards are its own and numbered by its index, so where a clip lands
depends on the plan alone: not on who makes it, in which order, or what failed. A scene is finished when its
record exists, which is written last.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from datagen.assets import Asset, Refused, find_environments, find_models
from datagen.captured_folder import find_captures, split_by_name, split_of
from datagen.captured_photos import starts
from datagen.captured_relit import find_relit
from datagen.clip_preview import preview_bytes
from datagen.clip_rows import ClipRow
from datagen.clusters import worker_count
from datagen.lights import HdriSpec
from datagen.scene import scene_name
from datagen.scratch import scratch_bytes
from datagen.settings import SPLITS, Settings
from datagen.texture_sets import TextureSet, find_texture_sets
from datagen.variety import Histograms
from tron.claim import CHOOSE_ANOTHER, read_recipe, require_same
from tron.cli.recipes import model_defaults
from tron.errors import TronError
from tron.shards.manifest import ShardEntry
from tron.shards.schema import MEMBERS, SCHEMA_VERSION, clip_members, require_schema
from tron.storage import write_if_changed

RECORD_NAME = "record.json"
CONFIG_NAME = "config.yaml"
SURFEL_BYTES = 320
NOTHING: Mapping[str, int] = MappingProxyType({})


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

    def clips(self, settings: Settings) -> int:
        """Clips that it gives: one a light, or as many as its photos and relit views are cut into, about."""
        if self.capture:
            return self.photo_clips(settings) + self.relit // settings.captured.relit_frames
        return len(settings.split(self.split).lights)

    def photo_clips(self, settings: Settings) -> int:
        """Clips that a capture's photos are cut into: what is held out breaks their row."""
        frames, every, clips = settings.captured.frames, settings.captured.photos.test_every, 0
        last = self.photos
        if every:
            rows, rest = divmod(self.photos, every)
            clips, last = rows * len(starts(every - 1, frames)), rest - 1
        return max(clips + len(starts(last, frames)), 1)

    def frames(self, settings: Settings) -> int:
        """Frames of all its clips, about."""
        if self.capture:
            return self.photo_clips(settings) * settings.captured.frames + self.relit
        return self.clips(settings) * settings.split(self.split).frames


@dataclass(frozen=True)
class Sources:
    """The user's files that scenes draw from; empty where everything is procedural.

    Attributes:
        assets: models.
        maps: files of the environments.
        environments: the same maps as lights.
        refused: models that were left out because they cannot be used.
    """

    assets: tuple[Asset, ...] = ()
    maps: tuple[Asset, ...] = ()
    environments: tuple[HdriSpec, ...] = ()
    textures: tuple[TextureSet, ...] = ()
    refused: tuple[Refused, ...] = ()


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
            known, and in records of older versions. See ``datagen.albedo_scale``.
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
        clips: a row each; empty in records of older versions.
        variety: histograms of the scene (``datagen.variety``); likewise.
    """

    model_config = ConfigDict(extra="forbid")

    name: str
    capture: str | None = None
    shards: list[ShardEntry]
    quarantined: list[Quarantined]
    refinement: Refinement | None = None
    reconstruction: ReconstructedFigures | None = None
    clips: list[ClipRow] = Field(default_factory=list)
    variety: Histograms = Field(default_factory=dict)


CAPTURE_SHARDS = 100
"""Numbers of shards that a capture has to itself: how many clips it gives is known only when it is read."""

LARGEST_SHARD = 999_999


def plan(settings: Settings) -> list[Work]:
    """Every scene of the dataset, in order of split and index."""
    if settings.source == "captured":
        return _plan_captured(settings)
    items = []
    for split in settings.used_splits():
        recipe = settings.split(split)
        shards = -(-len(recipe.lights) // settings.clips_per_shard)
        items += [Work(split, i, scene_name(split, i), i * shards) for i in range(recipe.scenes)]
    if not items:
        raise TronError("the dataset would have no scenes", "give a split scenes, e.g. train.scenes=16")
    return items


def _plan_captured(settings: Settings) -> list[Work]:
    photos = {each.name: each.photos for each in find_captures(settings)}
    if settings.captured.split_by_name:
        splits = split_by_name(list(photos))
    else:
        splits = split_of(list(photos), settings.captured.shares, settings.seed)
    frames = settings.captured.relit_frames
    relit = {
        name: sum(len(starts(truth.views, frames)) * frames for truth in find_relit(settings, name))
        for name in photos
    }
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


def chosen(items: list[Work], only: Iterable[str]) -> list[Work]:
    """The scenes named by ``only``, all if it is empty; TronError names one that lacks.

    A name that no scene has may be a capture's: pseudo-captures are named as scenes are.
    """
    names = list(only)
    scenes = {item.name for item in items}
    captures = {item.capture for item in items if item.capture} - scenes
    for name in names:
        if name not in scenes | captures:
            raise TronError(
                "no such scene in this dataset", name, f"scenes are {items[0].name} to {items[-1].name}"
            )
    return [
        item
        for item in items
        if not names or item.name in names or (item.capture in captures and item.capture in names)
    ]


def find_sources(settings: Settings) -> Sources:
    """Catalogue the user's assets and environments; raises as ``datagen.assets`` does, before any render."""
    allowed = settings.allow_unlicensed
    assets, refused = (
        find_models(settings.assets, settings.catalogue, allowed, settings.asset_names)
        if settings.assets
        else ([], [])
    )
    maps, environments = (
        find_environments(settings.environments, settings.catalogue, allowed)
        if settings.environments
        else ([], [])
    )
    textures = find_texture_sets(settings.textures, settings.catalogue, allowed) if settings.textures else []
    return Sources(
        assets=tuple(assets),
        maps=tuple(maps),
        environments=tuple(environments),
        textures=tuple(textures),
        refused=tuple(refused),
    )


def scene_folder(output: Path, name: str) -> Path:
    """Folder of a scene's specification, surfels and record."""
    return output / "scenes" / name


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


def estimate_bytes(settings: Settings, items: Iterable[Work], shards: bool = True) -> int:
    """Bytes that making scenes may take on disk: what stays, and what waits in those under way at one time.

    Args:
        settings: the recipe.
        items: scenes to make.
        shards: count their shards too, or the rest alone.
    """
    items = list(items)
    waiting = max((scratch_bytes(settings, item.split, item.photos) for item in items), default=0)
    return kept_bytes(settings, items, shards) + waiting * worker_count(settings, len(items))[0]


def kept_bytes(settings: Settings, items: Iterable[Work], shards: bool = True) -> int:
    """Bytes that finished scenes keep, as if nothing compressed: shards if asked for, previews, surfels.

    Half-precision EXR hardly compresses noise.
    """
    total, surfels = 0, settings.surfels
    if settings.source == "captured":
        surfels = settings.captured.reconstruction.radiance.density.most
    for item in items:
        recipe = settings.split(item.split)
        members = [MEMBERS[name] for name in clip_members(recipe.reference_buffers)]
        pixel = sum(member.bytes * member.channels for member in members)
        frame = recipe.width * recipe.height * pixel + 16_384
        stored = item.frames(settings) * frame if shards else 0
        previews = preview_bytes(recipe.width, recipe.height, recipe.frames, len(members))
        total += stored + item.clips(settings) * previews + surfels * SURFEL_BYTES
    return total


def config_text(settings: Settings) -> str:
    """config.yaml of the dataset: schema, recipe and numbers of scenes, without where and by whom."""
    described = {"schema": SCHEMA_VERSION, "scenes": planned_scenes(settings), "recipe": settings.recipe()}
    if settings.shard is not None:
        described["shard"] = settings.shard
    return yaml.safe_dump(described, sort_keys=True, allow_unicode=True)


def planned_scenes(settings: Settings) -> dict[str, Any]:
    """Split -> number of its scenes, or the names of its captures."""
    if settings.source == "synthetic":
        return {split: settings.split(split).scenes for split in SPLITS}
    found: dict[str, Any] = {}
    for item in plan(settings):
        found.setdefault(item.split, []).append(item.capture)
    return found


def config_sha256(settings: Settings) -> str:
    """Hash of the resolved configuration, 64 hexadecimal digits; all parts of a dataset have its own."""
    whole = settings.model_copy(update={"shard": None})
    return hashlib.sha256(config_text(whole).encode()).hexdigest()


def adopt(settings: Settings) -> None:
    """Make output_dir this recipe's, or make sure that it is already; raises as :func:`require_adoptable`."""
    require_adoptable(settings)
    write_if_changed(settings.output_dir / CONFIG_NAME, config_text(settings))


def require_adoptable(settings: Settings) -> None:
    """Make sure that output_dir is this recipe's or nobody's.

    More scenes may be added to a dataset; any other change would mix two datasets in one folder.

    Raises:
        TronError: the folder holds a dataset of another schema or recipe (names the key), or more scenes
            than are asked for.
    """
    path = settings.output_dir / CONFIG_NAME
    old = read_recipe(path)
    if old is not None:
        try:
            before, scenes, schema = dict(old["recipe"]), dict(old["scenes"]), old.get("schema", 1)
        except (KeyError, TypeError, ValueError) as error:
            raise TronError("config.yaml is damaged", path, CHOOSE_ANOTHER) from error
        require_schema(schema, settings.output_dir)
        _require_same_part(old.get("shard"), scenes, settings)
        now = settings.recipe()
        then, asked = ({"source": each.get("source", "synthetic")} for each in (before, now))
        require_same(then, asked, settings.output_dir, "a dataset")
        if settings.source == "captured":
            _require_same_captures(before, scenes, settings)
            return
        for split in SPLITS:
            if not scenes.get(split):  # there is nothing of it yet, so it may be anything from now on
                before.pop(split, None)
                now.pop(split, None)
        for split in set(before) & set(SPLITS) - set(now):
            del before[split]  # fewer scenes than there are: that is told below
        require_same(before, now, settings.output_dir, "a dataset", defaults=model_defaults(Settings))
        for split in SPLITS:
            if scenes.get(split, 0) > settings.split(split).scenes:
                raise TronError(
                    f"output_dir holds {scenes[split]} scenes of {split}, more than {split}.scenes asks for",
                    settings.output_dir,
                    CHOOSE_ANOTHER,
                )
    elif any(settings.output_dir.glob("*.tar")):
        raise TronError(
            "output_dir holds shards of something else", settings.output_dir, "choose an empty folder"
        )


def _require_same_captures(before: dict[str, Any], scenes: dict[str, Any], settings: Settings) -> None:
    """Raise TronError unless a dataset has these captures: one more would move others between splits."""
    require_same(
        before, settings.recipe(), settings.output_dir, "a dataset", defaults=model_defaults(Settings)
    )
    if scenes != planned_scenes(settings):
        then, now = (
            {name for names in each.values() for name in names} for each in (scenes, planned_scenes(settings))
        )
        changed = sorted(then ^ now)
        raise TronError(
            f"output_dir holds a dataset of other captures: {', '.join(changed[:3]) or 'in other splits'}",
            settings.output_dir,
            "choose another output_dir, or name the ones to use: captured.names=[...]",
        )


def _require_same_part(part: str | None, scenes: Mapping[str, int], settings: Settings) -> None:
    """Refuse a folder that holds another part, or the same of another number of scenes."""
    if part != settings.shard:
        held = f"part {part}" if part else "a whole dataset"
        wanted = f"shard={settings.shard}" if settings.shard else "a whole dataset"
        raise TronError(f"output_dir holds {held}, not {wanted}", settings.output_dir, CHOOSE_ANOTHER)
    now = planned_scenes(settings)
    if part and any((scenes.get(split) or 0) != (now.get(split) or 0) for split in SPLITS):
        raise TronError(  # every n-th scene of a longer plan would be others
            f"output_dir holds part {part} of a dataset with other numbers of scenes",
            settings.output_dir,
            CHOOSE_ANOTHER,
        )


def clear_temporaries(output: Path) -> None:
    """Remove what a killed run left half-written; only under the folder's lock.

    Atomic writes go to hidden files beside their targets, in folders that are all ours.
    """
    for folder in (output, output / "previews", output / "quarantine", *output.glob("scenes/*")):
        for path in folder.glob(".*.*.*") if folder.is_dir() else ():
            path.unlink(missing_ok=True)
