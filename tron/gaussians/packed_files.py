"""Packed splats, read and written through plain 3DGS PLYs by gaussforge (https://pypi.org/project/gaussforge).

It runs in a process of its own (:mod:`tron.gaussians.packed_process`) with a limit on memory: it was seen to
crash on damaged .sog files. Of gaussforge 0.6 some things are not used, since they go wrong in silence: files
of .ksplat as their own maker compresses them come back with splats elsewhere, harmonics of those that it
writes are in another order than two other readers take them in, and compressed PLYs that it writes have none.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from shlex import quote
from typing import NamedTuple

import numpy as np

from tron.errors import TronError


class Packing(NamedTuple):
    """A packed format.

    Attributes:
        name: gaussforge's.
        title: a noun phrase, such as "Niantic's .spz".
        starts: what a file begins with, one of these; none where the format does not say.
        half_turned: whether y and z point the other way than in a 3DGS PLY of the same splats. gaussforge
            leaves them as they are in the file.
    """

    name: str
    title: str
    starts: tuple[bytes, ...] = ()
    half_turned: bool = False

    def begins(self, path: Path) -> bool:
        """Whether a file is there and begins as the format says."""
        try:
            with path.open("rb") as stream:
                return stream.read(8).startswith(self.starts or b"")
        except OSError:
            return False


PACKED_SPLATS = {
    ".splat": Packing("splat", "antimatter15's .splat"),
    ".spz": Packing("spz", "Niantic's .spz", (b"\x1f\x8b", b"NGSP"), half_turned=True),
    ".sog": Packing("sog", "PlayCanvas's .sog", (b"PK\x03\x04",)),
}
COMPRESSED_PLY = Packing("compressed.ply", "PlayCanvas's compressed PLY")
HALF_TURN = np.diag([1.0, -1.0, -1.0])
"""Between the frames of .spz (y up, https://github.com/nianticlabs/spz) and of 3DGS (y down)."""
_MARK = b"packed_position"

_MOST_EXPANDED = 100
"""Times a file's size that it may expand to: .sog and .spz expand 5 to 20 times."""
_ALWAYS_ALLOWED = 1 << 30


def packing(path: Path, head: bytes) -> Packing | None:
    """The packed format of a file; None of any other.

    Args:
        path: by whose suffix packed files are known.
        head: its first bytes, by which compressed PLYs are.

    Raises:
        TronError: the file does not begin as its suffix says.
    """
    if head.startswith(b"ply"):
        return COMPRESSED_PLY if _MARK in head.partition(b"end_header")[0] else None
    found = PACKED_SPLATS.get(path.suffix.lower())
    if found and not head.startswith(found.starts or b""):
        raise TronError(f"not {found.title}, by what it begins with", path, "copy or export it again")
    return found


def conversion(path: Path) -> str:
    """Command that makes a plain PLY of packed splats by another program."""
    plain = path.name.removesuffix(path.suffix).removesuffix(".compressed") + ".ply"
    return f"npx @playcanvas/splat-transform {quote(path.name)} {quote(plain)}"


def unpacked(path: Path, kind: Packing) -> bytes:
    """A plain 3DGS PLY of packed splats.

    Raises:
        TronError: the file is damaged, of another version, or expands without limit.
    """
    try:
        return plain_ply(path.read_bytes(), kind, path)
    except OSError as error:
        raise TronError(f"cannot read: {error.strerror or error}", path) from error


def plain_ply(content: bytes, kind: Packing, path: Path) -> bytes:
    """A plain 3DGS PLY of packed splats that were read from ``path``; TronError as :func:`unpacked`."""
    memory = max(_ALWAYS_ALLOWED, _MOST_EXPANDED * len(content))
    done = _converted(content, kind.name, "ply", memory)
    if isinstance(done, str):
        mend = f"it is damaged or of another version; {conversion(path)} may read it"
        raise TronError(f"cannot be read as {kind.title}: {done}", path, mend)
    return done


def packed(ply: bytes, kind: Packing) -> bytes:
    """Packed splats of a plain 3DGS PLY.

    Raises:
        TronError: they could not be packed.
    """
    done = _converted(ply, "ply", kind.name, max(_ALWAYS_ALLOWED, _MOST_EXPANDED * len(ply)))
    if isinstance(done, str):
        raise TronError(f"cannot be packed as {kind.title}: {done}")
    return done


def _converted(content: bytes, source: str, target: str, memory: int) -> bytes | str:
    """The file in the other format, or what went wrong."""
    import gaussforge

    site = Path(gaussforge.__file__).parents[1]
    process = Path(__file__).with_name("packed_process.py")
    words = [sys.executable, "-I", str(process), str(site), source, target, str(memory)]
    done = subprocess.run(words, input=content, capture_output=True)
    if done.returncode == 0 and done.stdout:
        return done.stdout
    said = done.stderr.decode("utf-8", "replace").strip().splitlines()
    if done.returncode < 0 or not said:
        return f"the reader ended with signal {-done.returncode}" if done.returncode else "it holds nothing"
    return said[-1]
