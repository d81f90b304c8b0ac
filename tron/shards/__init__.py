"""The dataset format, shared by the data engine, training and evaluation.

`schema` names the members of a clip, `writer` makes byte-identical tar shards, `manifest` accounts for
them, `reader` opens them again without ever unpickling anything, `clip_store` reads single frames of them by
the `index` of a shard, `webdataset` gives them as a pipeline of tensors, `verify` finds damage.
"""

from typing import TYPE_CHECKING

from tron.lazily import lazily

if TYPE_CHECKING:
    from tron.shards.clip_store import ClipStore
    from tron.shards.manifest import Manifest, ShardEntry
    from tron.shards.reader import read_clips, verify
    from tron.shards.schema import GUIDANCE, MEMBERS, SCHEMA_VERSION, Clip, ClipMeta, clip_members
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

__getattr__ = lazily(
    __name__,
    {
        "clip_store": "ClipStore",
        "manifest": "Manifest ShardEntry",
        "writer": "ShardWriter",
        "reader": "read_clips verify",
        "streaming": "webdataset",
        "schema": "GUIDANCE MEMBERS SCHEMA_VERSION Clip ClipMeta clip_members",
    },
)
