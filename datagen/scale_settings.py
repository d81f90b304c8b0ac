"""The settings that spread one dataset over several commands and folders, and send it to an object store."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

from pydantic import Field, field_validator

from datagen.settings_model import SettingsModel
from tron.errors import TronError

SHARD = re.compile(r"([1-9][0-9]{0,8})/([1-9][0-9]{0,8})")
SCALING = ("shard", "merge", "merge_incomplete", "store")
"""Keys that decide where parts of a dataset are made and kept, and nothing of what is in it."""

Item = TypeVar("Item")


class ScaleSettings(SettingsModel):
    """Parts of a dataset, and where its shards go."""

    shard: str | None = Field(
        None,
        description="Make one of n disjoint parts, i/n with 1 <= i <= n: every n-th scene of the plan, with "
        "the names and bytes of a run of all. Each part has an output_dir of its own; mode=merge joins them.",
        examples=["2/8"],
    )
    merge: list[Path] = Field(
        default_factory=list, description="Folders of the parts that mode=merge joins in output_dir."
    )
    merge_incomplete: bool = Field(
        False, description="Join parts although scenes of the dataset are in none of them."
    )
    store: str | None = Field(
        None,
        description="URL that fsspec writes to, such as s3://bucket/dataset: finished shards are sent there "
        "and leave output_dir; the other files follow at the end. mode=validate checks what is there. "
        "Credentials are the environment's.",
        examples=["s3://bucket/dataset"],
    )

    @field_validator("shard")
    @classmethod
    def _one_of_n(cls, value: str | None) -> str | None:
        if value is not None:
            found = SHARD.fullmatch(value)
            if found is None or int(found[1]) > int(found[2]):
                raise ValueError("give i/n with 1 <= i <= n, such as 2/8")
        return value

    @field_validator("store")
    @classmethod
    def _a_url(cls, value: str | None) -> str | None:
        if value is not None and "://" not in value:
            raise ValueError("give a URL, such as s3://bucket/dataset")
        return value if value is None else value.rstrip("/")


def part_of(items: Sequence[Item], shard: str | None) -> list[Item]:
    """The items that ``shard=i/n`` makes: i - 1, i - 1 + n, ...; all of them without it.

    Raises:
        TronError: there are fewer items than parts, so that some would be empty.
    """
    if shard is None:
        return list(items)
    number, count = map(int, shard.split("/"))
    if count > len(items):
        raise TronError(
            f"shard={shard} asks for more parts than there are scenes, {len(items)}",
            mend=f"give shard=i/n with n of at most {len(items)}",
        )
    return list(items[number - 1 :: count])
