"""The dataset format, shared by the data engine, training and evaluation.

`schema` names the members of a clip, `writer` makes byte-identical tar shards, `manifest` accounts for
them, `reader` opens them again without ever unpickling anything, `clip_store` reads single frames of them by
the `index` of a shard, `webdataset` gives them as a pipeline of tensors, `verify` finds damage.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from tron.shards.schema import GUIDANCE, MEMBERS, SCHEMA_VERSION, Clip, ClipMeta, clip_members

if TYPE_CHECKING:  # tron-relight knows the members and reads no clip; who reads clips may lack webdataset
    from tron.shards.clip_store import ClipStore
    from tron.shards.manifest import Manifest, ShardEntry
    from tron.shards.reader import read_clips, verify
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

_HOMES = {
    "ClipStore": "clip_store",
    **dict.fromkeys(("Manifest", "ShardEntry"), "manifest"),
    **dict.fromkeys(("read_clips", "verify"), "reader"),
    "webdataset": "streaming",
    "ShardWriter": "writer",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
