"""Files that are often given to TRON and that it does not read: what they are, and what to do about it."""

from __future__ import annotations

from pathlib import Path

from tron.errors import TronError

VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".mts", ".insv")
_PACKED_SPLATS = {
    ".splat": "antimatter15's .splat",
    ".ksplat": "mkkellogg's .ksplat",
    ".spz": "Niantic's .spz",
    ".sog": "PlayCanvas's .sog",
}
TO_PLAIN_PLY = "make a plain 3DGS PLY: npx @playcanvas/splat-transform {name} {stem}.ply, or with SuperSplat"


def refuse_foreign(path: Path) -> None:
    """Raise TronError if the name is that of a file that needs a step before TRON can use it."""
    suffix = path.suffix.lower()
    if suffix in VIDEOS:
        mend = (
            f"take pictures from it (ffmpeg -i {path.name} -vf fps=2 DIR/images/%04d.jpg; DIR/images must "
            "exist), then tron-reconstruct capture=DIR output_dir=OUT, whose scene.ply can be relit"
        )
        raise TronError("this is a video", path, mend)
    if suffix in _PACKED_SPLATS:
        raise packed_splats(path, _PACKED_SPLATS[suffix])


def packed_splats(path: Path, kind: str) -> TronError:
    """The error for Gaussians in a packed format, such as "Niantic's .spz"."""
    stem = path.name.removesuffix(path.suffix).removesuffix(".compressed")
    return TronError(
        f"Gaussians in a packed format, {kind}", path, TO_PLAIN_PLY.format(name=path.name, stem=stem)
    )
