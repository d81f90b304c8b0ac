"""Files that are given for a scene and are not read: what they are, and what to do about it."""

from __future__ import annotations

from pathlib import Path

from tron.errors import TronError

VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".mts", ".insv")
PACKED_SPLATS = {
    ".splat": "antimatter15's .splat",
    ".ksplat": "mkkellogg's .ksplat",
    ".spz": "Niantic's .spz",
    ".sog": "PlayCanvas's .sog",
}


def refuse_foreign(path: Path) -> None:
    """Raise TronError if the name is that of a file that needs a step before it is a scene."""
    suffix = path.suffix.lower()
    if suffix in VIDEOS:
        mend = f"tron-reconstruct capture={path.name} output_dir=OUT makes a scene of its frames"
        raise TronError("a video is no scene", path, mend)
    if suffix in PACKED_SPLATS:
        raise packed_splats(path, PACKED_SPLATS[suffix])


def packed_splats(path: Path, kind: str) -> TronError:
    """The error for Gaussians in a packed format, such as "Niantic's .spz"."""
    plain = path.name.removesuffix(path.suffix).removesuffix(".compressed") + ".ply"
    mend = (
        f"make a plain 3DGS PLY: npx @playcanvas/splat-transform {path.name} {plain}, or superspl.at/convert"
    )
    return TronError(f"Gaussians in a packed format, {kind}", path, mend)
