"""Which format a file of splats has: one row a suffix."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from tron.gaussians.formats import checkpoints, gltf, sog, usd
from tron.gaussians.formats.splats import Splats
from tron.gaussians.packed_files import PACKED_SPLATS


class Format(NamedTuple):
    """A format.

    Attributes:
        check: raises TronError, before long work, unless a file looks as the format says.
        read: of a file.
        write: a file's bytes, of splats of degree 3 that are y up; None where none is written.
        starts: what a file begins with, one of these.
    """

    check: Callable[[Path], None]
    read: Callable[[Path], Splats]
    write: Callable[[Splats, str], bytes] | None
    starts: tuple[bytes, ...]

    def begins(self, path: Path) -> bool:
        """Whether a file is there and begins as the format says."""
        try:
            with path.open("rb") as stream:
                return stream.read(8).lstrip().startswith(self.starts)
        except OSError:
            return False


_GLB = Format(gltf.check, gltf.read, lambda splats, _: gltf.write(splats), (b"glTF",))
_USD = Format(usd.check, usd.read, usd.write, (b"PXR-USDC", b"#usda", b"PK\x03\x04"))
_CHECKPOINT = Format(checkpoints.check, checkpoints.read, None, (b"PK\x03\x04",))

FORMATS = {
    ".glb": _GLB,
    ".gltf": _GLB._replace(write=None, starts=(b"{",)),
    **dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), _USD),
    ".json": Format(sog.check, sog.read, None, (b"{",)),
    **dict.fromkeys((".ckpt", ".pt", ".pth"), _CHECKPOINT),
}
"""By suffix; of ``.json`` SOG's alone are splats. PLYs and packed splats:
:mod:`tron.gaussians.ply`, :mod:`tron.gaussians.packed_files`."""


def named_as_splats(name: str) -> bool:
    """Whether a file of this name may hold splats; meshes and points share some suffixes."""
    lower = name.lower()
    if lower.endswith(".json"):
        return lower in (sog.META, sog.LEVELS)
    return lower.endswith((".ply", ".ply.gz", *PACKED_SPLATS, *FORMATS))
