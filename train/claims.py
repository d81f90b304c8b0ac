"""A run's settings in its output_dir: the folder holds one run, of these settings and these data."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from train.settings import Settings
from train.splits import manifest_hash, split_hashes
from tron.claim import read_recipe, require_same
from tron.cli.recipes import model_defaults
from tron.neural.shipped import checkpoint_file
from tron.storage import sha256, write_atomic

NAME = "config.yaml"
MAY_CHANGE = ("output_dir", "dataset", "splits", "start_from", "devices", "nodes", "logger")
"""A run may move, and be watched in other ways; data and first weights are known by their hash."""


def described_settings(settings: Settings, processes: int) -> dict[str, Any]:
    """Settings as plain values, with the hashes of what they name.

    Batches are as many as there are processes: the run remembers their number, not how they were spread.
    TronError where the dataset or `start_from` cannot be read.
    """
    described = yaml.safe_load(yaml.safe_dump(settings.model_dump(mode="json")))
    described["dataset_sha256"] = manifest_hash(settings.dataset)
    described["splits_sha256"] = split_hashes(settings.splits)
    described["start_from_sha256"] = (
        sha256(checkpoint_file(settings.start_from)) if settings.start_from else None
    )
    described["processes"] = processes
    return described


def require_own(folder: Path, described: dict[str, Any]) -> None:
    """TronError, naming the first key, where a folder holds a run of other settings, data or batches."""
    earlier = read_recipe(folder / NAME)
    if earlier is None:
        return
    kept = [key for key in described if key not in MAY_CHANGE]
    before, now = ({key: each[key] for key in kept if key in each} for each in (earlier, described))
    defaults = {**model_defaults(Settings), "processes": 1, "splits_sha256": {}, "start_from_sha256": None}
    require_same(before, now, folder, "a run", defaults=defaults)


def keep_settings(folder: Path, described: dict[str, Any]) -> None:
    """Write config.yaml, where it is not there yet."""
    if not (folder / NAME).is_file():
        write_atomic(folder / NAME, yaml.safe_dump(described, sort_keys=False))
