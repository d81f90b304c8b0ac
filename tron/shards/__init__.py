"""Neutral ground between the data engine, training and evaluation: what a dataset folder holds.

`schema` names the members of a clip, `writer` makes byte-identical tar shards, `manifest` accounts for
them, `reader` opens them again without ever unpickling anything, `clip_store` reads single frames of them by
the `index` of a shard, `verify` finds damage.
"""

from tron.shards.clip_store import ClipStore
from tron.shards.manifest import Manifest, ShardEntry
from tron.shards.reader import read_clips
from tron.shards.schema import GUIDANCE, MEMBERS, SCHEMA_VERSION, Clip, ClipMeta, clip_members
from tron.shards.verify import verify
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
]
