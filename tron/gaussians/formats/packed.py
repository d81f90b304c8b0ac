"""Packed splats, read and written through plain 3DGS PLYs by gaussforge (https://pypi.org/project/gaussforge).

It runs in a process of its own (:mod:`tron.gaussians.formats.packed_process`) with a limit on memory: it was
seen to crash on damaged .sog files. Of gaussforge 0.6 some things are not used, since they go wrong in
silence: files of .ksplat as their own maker compresses them come back with splats elsewhere, harmonics of
those that it writes are in another order than two other readers take them in, and compressed PLYs that it
writes have none.
"""

from __future__ import annotations

import io
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np

from tron.errors import TronError
from tron.gaussians.ply import Stored, columns_in, write_ply

TITLES = {
    "splat": "antimatter15's .splat",
    "spz": "Niantic's .spz",
    "sog": "PlayCanvas's .sog",
    "compressed.ply": "PlayCanvas's compressed PLY",
}
"""By gaussforge's name of the format."""
_CHANGING = 1e-4
"""Coefficient beyond degree 0 from which packed files hold harmonics; 8 bits of display are 4e-3."""
_MOST_EXPANDED = 100
"""Times a file's size that it may expand to: .sog and .spz expand 5 to 20 times."""
_ALWAYS_ALLOWED = 1 << 30


def read(path: Path, name: str) -> Stored:
    """What a packed file holds.

    Args:
        path: the file.
        name: gaussforge's of its format.

    Raises:
        TronError: the file is damaged, of another version, or expands without limit.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise TronError(f"cannot read: {error.strerror or error}", path) from error
    columns, comments = columns_in(unpacked(content, name, path), path)
    return Stored(columns, comments)


def write(scene: Mapping[str, Any], name: str) -> bytes:
    """A packed file of what a scene of kernel degree 2 holds; TronError where it could not be packed."""
    return packed(plain(scene, changing(scene["sh"])), name)


def plain(scene: Mapping[str, Any], changing: bool = True) -> bytes:
    """A PLY of the properties of 3DGS alone, with harmonics beyond degree 0 or without."""
    target = io.BytesIO()
    write_ply(target, scene, plain=True, changing=changing)
    return target.getvalue()


def changing(sh: np.ndarray) -> bool:
    """Whether colours of (M, 16, 3) harmonics change with the view."""
    return bool(np.abs(sh[:, 1:]).max() > _CHANGING)


def conversion(path: Path) -> str:
    """Command that makes a plain PLY of packed splats by another program."""
    plain = path.name.removesuffix(path.suffix).removesuffix(".compressed") + ".ply"
    return f"npx @playcanvas/splat-transform {quote(path.name)} {quote(plain)}"


def unpacked(content: bytes, name: str, path: Path) -> bytes:
    """A plain 3DGS PLY of packed splats that were read from ``path``; TronError as :func:`read`."""
    memory = max(_ALWAYS_ALLOWED, _MOST_EXPANDED * len(content))
    done = _converted(content, name, "ply", memory)
    if isinstance(done, str):
        mend = f"it is damaged or of another version; {conversion(path)} may read it"
        raise TronError(f"cannot be read as {TITLES[name]}: {done}", path, mend)
    return done


def packed(ply: bytes, name: str) -> bytes:
    """Packed splats of a plain 3DGS PLY.

    Raises:
        TronError: they could not be packed.
    """
    done = _converted(ply, "ply", name, max(_ALWAYS_ALLOWED, _MOST_EXPANDED * len(ply)))
    if isinstance(done, str):
        raise TronError(f"cannot be packed as {TITLES[name]}: {done}")
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
