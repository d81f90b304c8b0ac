"""Formats of splats, a row each: how a file is known, read and written, or the line that refuses it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np

from tron.errors import TronError
from tron.gaussians import ply
from tron.gaussians.formats import checkpoints, gltf, packed, sog, spz, usd
from tron.gaussians.formats.splats import Splats
from tron.gaussians.ply import Stored
from tron.io.recognised import VIDEOS, refuse_by_sight, refuse_placeholder

_MARK = b"packed_position"
"""Property of PlayCanvas's compressed PLY."""


@dataclass(frozen=True)
class Format:
    """A format.

    Attributes:
        title: a noun phrase, such as "Niantic's .spz".
        suffixes: of its files, with the dot, in lower case.
        read: what a file holds; None where none is read.
        starts: what a file begins with, one of these; none where the format does not say.
        check: raises TronError, before long work, unless a file looks as the format says.
        write: a file's bytes, of a suffix and what a scene of kernel degree 2 holds, as ``write_ply`` takes
            it; None where none is written.
        y_up: whether what is written is y up; else it stays in the scene's frame, but for ``turn``.
        turn: (3, 3) from the frame of 3DGS' PLYs into that of the format.
        packed: whether a file is made smaller than its numbers are, by gaussforge.
        refusal: the error for a file that is not read, and what to do with it.
    """

    title: str
    suffixes: tuple[str, ...]
    read: Callable[[Path], Stored | Splats] | None = None
    starts: tuple[bytes, ...] = ()
    check: Callable[[Path], None] | None = None
    write: Callable[[Mapping[str, Any], str], bytes] | None = None
    y_up: bool = False
    turn: np.ndarray | None = None
    packed: bool = False
    refusal: Callable[[Path], TronError] | None = None

    def begins(self, path: Path) -> bool:
        """Whether a file is there and begins as the format says."""
        try:
            with path.open("rb") as stream:
                return not self.starts or stream.read(8).lstrip().startswith(self.starts)
        except OSError:
            return False

    def splats(self, path: Path) -> Stored:
        """What a file holds; TronError where it is damaged."""
        assert self.read is not None
        found = self.read(path)
        return found.stored() if isinstance(found, Splats) else found


def _video(path: Path) -> TronError:
    mend = f"tron-reconstruct capture={quote(path.name)} output_dir=OUT makes a scene of its frames"
    return TronError("a video is no scene", path, mend)


def _ksplat(path: Path) -> TronError:
    return TronError("mkkellogg's .ksplat is not read", path, f"{packed.conversion(path)} makes a PLY of it")


PLY = Format("a PLY", (".ply",), ply.read, (b"ply",), write=lambda scene, _: packed.plain(scene))
_COMPRESSED = Format(packed.TITLES["compressed.ply"], (), partial(packed.read, name="compressed.ply"))
FORMATS = (
    PLY,
    Format(
        packed.TITLES["splat"], (".splat",), partial(packed.read, name="splat"),
        write=lambda scene, _: packed.write(scene, "splat"), packed=True,
    ),
    Format(
        packed.TITLES["spz"], (".spz",), spz.read, (b"\x1f\x8b", b"NGSP"),
        write=lambda scene, _: spz.write(scene), turn=spz.HALF_TURN, packed=True,
    ),
    Format(
        packed.TITLES["sog"], (".sog",), partial(packed.read, name="sog"), (b"PK\x03\x04",),
        write=lambda scene, _: packed.write(scene, "sog"), packed=True,
    ),
    Format(
        "glTF", (".glb",), gltf.read, (b"glTF",), gltf.check,
        lambda scene, _: gltf.write(Splats.of(scene)), y_up=True,
    ),
    Format("glTF", (".gltf",), gltf.read, (b"{",), gltf.check),
    Format(
        "USD", (".usd", ".usda", ".usdc", ".usdz"), usd.read, (b"PXR-USDC", b"#usda", b"PK\x03\x04"),
        usd.check, lambda scene, suffix: usd.write(Splats.of(scene), suffix), y_up=True,
    ),
    Format("SOG, a folder", (".json",), sog.read, (b"{",), sog.check),
    Format("a checkpoint", (".ckpt", ".pt", ".pth"), checkpoints.read, (b"PK\x03\x04",), checkpoints.check),
    Format("mkkellogg's .ksplat", (".ksplat",), refusal=_ksplat),
    Format("a video", VIDEOS, refusal=_video),
)  # fmt: skip
BY_SUFFIX = {suffix: each for each in FORMATS for suffix in each.suffixes}
READ = tuple(suffix for suffix, each in BY_SUFFIX.items() if each.read)
WRITTEN = tuple(suffix for suffix, each in BY_SUFFIX.items() if each.write)
PACKED = tuple(suffix for suffix, each in BY_SUFFIX.items() if each.packed)
"""Suffixes of files that are read, written, packed."""


def named_as_splats(name: str) -> bool:
    """Whether a file of this name may hold splats; meshes and points share some suffixes."""
    lower = name.lower()
    if lower.endswith(".json"):
        return lower in (sog.META, sog.LEVELS)
    return lower.endswith((".ply.gz", *READ))


def refuse_foreign(path: Path) -> None:
    """Raise TronError if a file, by its name or what it begins with, needs a step before it is a scene."""
    refuse_placeholder(path)
    known = BY_SUFFIX.get(path.suffix.lower())
    if known is not None and known.refusal is not None:
        raise known.refusal(path)
    if known is None or not known.begins(path):  # .spz, .sog, .usdz and checkpoints begin as archives do
        refuse_by_sight(path, "a scene is a file of splats")


def check_header(path: Path) -> Format:
    """The format of a scene's file, by its first bytes: a wrong one is found before anything is loaded.

    Raises:
        TronError: it cannot be opened, is no file of Gaussians as far as its header tells, or is shorter than
            the header says.
    """
    refuse_placeholder(path)
    known = BY_SUFFIX.get(path.suffix.lower(), PLY)
    if known.check is not None:
        refuse_foreign(path)
        known.check(path)
        return known
    try:
        with open(path, "rb") as stream:
            head = stream.read(ply.HEADER_LIMIT)
    except OSError as error:
        raise TronError(f"cannot read: {error.strerror or error}", path) from error
    if known.packed and not head.startswith(b"ply"):
        if known.starts and not head.startswith(known.starts):
            raise TronError(f"not {known.title}, by what it begins with", path, "copy or export it again")
        return known
    is_packed = head.startswith(b"ply") and _MARK in head.partition(b"end_header")[0]
    head, size = ply.beginning(path)
    if not head.startswith(b"ply"):
        refuse_foreign(path)
        raise TronError("not a PLY file", path, ply.EXPORT)
    ply.check_sizes(head, size, path)
    return _COMPRESSED if is_packed else PLY
