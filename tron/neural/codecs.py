"""The codecs there are, by the name that a renderer's configuration gives."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from tron.neural.block_dct import BlockDCT
from tron.neural.pixels import Pixels
from tron.neural.protocols import Codec
from tron.neural.wan import load_wan

CODECS: dict[str, Callable[[str | Path | None], Codec]] = {
    "block_dct": lambda _weights: BlockDCT(),
    "wan": load_wan,
    "pixels": lambda _weights: Pixels(),
}
"""Name -> the codec, given the path of its weights where it has any."""
