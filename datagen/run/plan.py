"""The plan of a dataset: its scenes, their shard numbers, and the checks of its folder.

One scene is one piece of work. Its shards are its own and numbered by its index, so where a clip lands
depends on the plan alone: not on who makes it, in which order, or what failed. A scene is finished when its
record exists, which is written last.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from pathlib import Path

import yaml

from datagen.dataset.records import CONFIG_NAME, Work
from datagen.settings.command import SPLITS, Settings
from datagen.sources import source_of
from tron.errors import TronError
from tron.run_folder import CHOOSE_ANOTHER, RunFolder
from tron.shards.schema import SCHEMA_VERSION, require_schema
from tron.storage import write_if_changed


def plan(settings: Settings) -> list[Work]:
    """Return every scene of the dataset, in order of split and index."""
    return source_of(settings).plan(settings)


def chosen(items: list[Work], only: Iterable[str]) -> list[Work]:
    """Return the scenes named by ``only``, all if it is empty; TronError names an unknown one.

    An unknown name may be a capture's: pseudo-captures have names of scenes.
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


def config_text(settings: Settings) -> str:
    """Return config.yaml of the dataset: schema, recipe and numbers of scenes, without places and workers."""
    described = {
        "schema": SCHEMA_VERSION,
        "scenes": source_of(settings).planned(settings),
        "recipe": settings.recipe(),
    }
    if settings.shard is not None:
        described["shard"] = settings.shard
    return yaml.safe_dump(described, sort_keys=True, allow_unicode=True)


def config_sha256(settings: Settings) -> str:
    """Return the hash of the resolved configuration, 64 hexadecimal digits, the same in all parts."""
    whole = settings.model_copy(update={"shard": None})
    return hashlib.sha256(config_text(whole).encode()).hexdigest()


def adopt(settings: Settings) -> None:
    """Claim output_dir for this recipe, unless it is already; raises as :func:`require_adoptable`."""
    require_adoptable(settings)
    write_if_changed(settings.output_dir / CONFIG_NAME, config_text(settings))


def require_adoptable(settings: Settings) -> None:
    """Require that output_dir belongs to this recipe or to none.

    More scenes may be added to a dataset; any other change would mix two datasets in one folder.

    Raises:
        TronError: the folder holds a dataset of another schema or recipe (names the key), or more scenes
            than are asked for.
    """
    run = RunFolder(settings.output_dir, "a dataset", CONFIG_NAME)
    old = run.recipe()
    if old is not None:
        try:
            before, scenes, schema = dict(old["recipe"]), dict(old["scenes"]), old["schema"]
        except (KeyError, TypeError, ValueError) as error:
            raise TronError("config.yaml is damaged", run.record, CHOOSE_ANOTHER) from error
        require_schema(schema, settings.output_dir)
        _require_same_part(old.get("shard"), scenes, settings)
        then, asked = ({"source": each.get("source", "synthetic")} for each in (before, settings.recipe()))
        run.require(asked, then)
        source_of(settings).require_same(run, before, scenes, settings)
    elif any(settings.output_dir.glob("*.tar")):
        raise TronError(
            "output_dir holds shards of something else", settings.output_dir, "choose an empty folder"
        )


def _require_same_part(part: str | None, scenes: Mapping[str, int], settings: Settings) -> None:
    """Refuse a folder with another part, or with this part for another number of scenes."""
    if part != settings.shard:
        held = f"part {part}" if part else "a whole dataset"
        wanted = f"shard={settings.shard}" if settings.shard else "a whole dataset"
        raise TronError(f"output_dir holds {held}, not {wanted}", settings.output_dir, CHOOSE_ANOTHER)
    now = source_of(settings).planned(settings)
    if part and any((scenes.get(split) or 0) != (now.get(split) or 0) for split in SPLITS):
        raise TronError(  # every n-th scene of a longer plan would be others
            f"output_dir holds part {part} of a dataset with other numbers of scenes",
            settings.output_dir,
            CHOOSE_ANOTHER,
        )


def clear_temporaries(output: Path) -> None:
    """Remove half-written files of a killed run; only under the folder's lock.

    Atomic writes go to hidden files beside their targets, in folders that are all ours.
    """
    for folder in (output, output / "previews", output / "quarantine", *output.glob("scenes/*")):
        for path in folder.glob(".*.*.*") if folder.is_dir() else ():
            path.unlink(missing_ok=True)
