"""The dataset format, shared by the data engine, training and evaluation.

`schema` names the members of a clip, `writer` makes byte-identical tar shards, `manifest` accounts for
them, `reader` opens them again without ever unpickling anything, `clip_store` reads single frames of them by
the `index` of a shard, `webdataset` gives them as a pipeline of tensors, `verify` finds damage.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from tron.shards.clip_store import ClipStore
from tron.shards.manifest import Manifest, ShardEntry
from tron.shards.reader import read_clips, verify
from tron.shards.schema import GUIDANCE, MEMBERS, SCHEMA_VERSION, Clip, ClipMeta, clip_members

if (
    TYPE_CHECKING
):  # they need webdataset, which who reads clips at random, or knows their members, need not have
    from tron.shards.streaming import webdataset
    from tron.shards.writer import ShardWriter

__all__ = [
    "GUIDANCE",
    "MEMBERS",
    "SCHEMA_VERSION",
    "Clip",
    "ClipMeta",
    "ClipStore",
    "Manifest",
    "ShardEntry",
    "ShardWriter",
    "clip_members",
    "read_clips",
    "verify",
    "webdataset",
]


def __getattr__(name: str) -> Any:
    homes = {"webdataset": "streaming", "ShardWriter": "writer"}
    if name not in homes:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{homes[name]}"), name)
