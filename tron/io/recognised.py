"""Files and folders that are known by sight and not read, and the way from each to one that is.

A name tells them, or the first bytes, or what lies in a folder. Sources of the layouts: nerfstudio's
``ns-process-data`` (Polycam, Record3D, Metashape, RealityCapture) and the 3DGS reference code.
"""

from __future__ import annotations

import os
from pathlib import Path
from shlex import quote
from typing import NamedTuple

from tron.errors import TronError

VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".mts")


class Sight(NamedTuple):
    """Something that is known by sight.

    Attributes:
        what: a noun phrase, such as "an archive".
        mend: what to do about it.
        poses: whether it tells where photos were taken.
    """

    what: str
    mend: str
    poses: bool = False


_EMPTY = Sight("an empty file", "copy or download it again")
_ARCHIVE = Sight("an archive", "unpack it and give what is in it")
_CHECKPOINT = Sight(
    "a checkpoint of another program",
    "give the PLY of splats that it exports: point_cloud/iteration_N/point_cloud.ply of 3DGS, "
    "`ns-export gaussian-splat` of nerfstudio; or reconstruct the photos, tron-reconstruct capture=FOLDER",
)
_METASHAPE = Sight(
    "Metashape's cameras", "tron-reconstruct capture=CAMERAS.xml reads them, beside the photos", poses=True
)
_PROJECT = Sight("Metashape's project", "export its cameras there (Export Cameras, .xml) beside the photos")
_EXPORTED = "export Internal/External camera parameters (CSV) beside the photos"
_REALITY = Sight(
    "RealityCapture's cameras",
    f"{_EXPORTED}; tron-reconstruct capture=CAMERAS.csv reads them",
    poses=True,
)
_REALITY_PROJECT = Sight("RealityCapture's project", f"there, {_EXPORTED}")
_RECORD3D_FILE = Sight(
    "Record3D's recording",
    "export it in Record3D as EXR + RGB and give the folder of that",
)
_LFS = Sight("a pointer of Git LFS, not the file itself", "git lfs pull brings the file")
_PAGE = Sight("a web page, not the file itself", "download the file, not the page that shows it")

_LCC = Sight(
    "XGRIDS' .lcc",
    "npx @playcanvas/splat-transform FILE.lcc scene.ply makes a PLY of it, or export one there",
)
_RAD = Sight("Spark's .rad", "give the .ply or .spz that it was built from")
_POSTSHOT = Sight("Postshot's project", "export its splats there as PLY")


def _raw_360(whose: str, program: str) -> Sight:
    return Sight(
        f"{whose} raw 360 format, two fisheye pictures",
        f"stitch it to equirectangular (2:1) first, with {program}, and give that as .mp4 or .jpg",
    )


_SUFFIXES = {
    **dict.fromkeys((".zip", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".zst", ".7z", ".rar"), _ARCHIVE),
    **dict.fromkeys((".ckpt", ".pth", ".pt", ".safetensors", ".pkl"), _CHECKPOINT),
    **dict.fromkeys((".psx", ".psz"), _PROJECT),
    **dict.fromkeys((".rcproj", ".rsproj"), _REALITY_PROJECT),
    ".r3d": _RECORD3D_FILE,
    **dict.fromkeys((".lcc", ".lcc2"), _LCC),
    **dict.fromkeys((".rad", ".radc"), _RAD),
    ".psht": _POSTSHOT,
    **dict.fromkeys((".insv", ".insp", ".lrv"), _raw_360("Insta360's", "Insta360 Studio")),
    ".360": _raw_360("GoPro's", "GoPro Player"),
}
_ARCHIVE_STARTS = (b"PK\x03\x04", b"7z\xbc\xaf\x27\x1c", b"Rar!", b"\x1f\x8b", b"\xfd7zXZ", b"BZh")
_HEAD = 1024


def recognised(path: Path) -> Sight | None:
    """Kind of a file or folder that is known by sight; None of anything else, also of what is not there.

    A PLY in gzip (``.ply.gz``) is nobody else's.
    """
    if path.is_dir():
        return _folder(path)
    try:
        with path.open("rb") as file:
            head, size = file.read(_HEAD), os.fstat(file.fileno()).st_size
    except OSError:
        return None
    if not size:
        return _EMPTY
    suffixes = [each.lower() for each in path.suffixes]
    if suffixes[-2:] == [".ply", ".gz"]:
        return None
    return _of_content(head) or _SUFFIXES.get(suffixes[-1] if suffixes else "") or _of_start(head)


def refuse_by_sight(path: Path, wanted: str) -> None:
    """Raise TronError if a file or folder is known by sight.

    Args:
        path: what was given.
        wanted: what should have been, a clause such as "a scene is a PLY".
    """
    seen = recognised(path)
    if seen is not None:
        raise TronError(f"{wanted}, this is {seen.what}", path, seen.mend)


def refuse_placeholder(path: Path) -> None:
    """Raise TronError if a file, whatever its name, holds what stands for another: Git LFS, a web page."""
    try:
        with path.open("rb") as file:
            seen = _placeholder(file.read(_HEAD))
    except OSError:
        return
    if seen is not None:
        raise TronError(f"this is {seen.what}", path, seen.mend)


def foreign_poses(photos: Path) -> tuple[Path, Sight] | None:
    """File or folder of poses, not read, that belongs to a folder of photos or of their ``images``."""
    for folder in (photos, *(each for each in photos.glob("i*") if each.is_dir()), photos.parent):
        for each in (folder, *sorted(folder.glob("*.xml")), *sorted(folder.glob("*.csv"))):
            seen = recognised(each)
            if seen is not None and seen.poses:
                return each, seen
    return None


def _placeholder(head: bytes) -> Sight | None:
    if head.startswith(b"version https://git-lfs"):
        return _LFS
    return _PAGE if _text(head).startswith(("<!doctype html", "<html")) else None


def _text(head: bytes) -> str:
    return head.decode("utf-8", "replace").lstrip("\ufeff \t\r\n").lower()


def _of_content(head: bytes) -> Sight | None:
    """Kind that text tells, under any name."""
    if (seen := _placeholder(head)) is not None:
        return seen
    text = _text(head)
    if text.startswith(("<?xml", "<document")) and "<document" in text and "<chunk" in text:
        return _METASHAPE
    titles = [line for line in text.splitlines()[:2] if line.startswith("#")]  # the first may count cameras
    if any({"name", "x", "y"} <= {each.strip("# ") for each in line.split(",")} for line in titles):
        return _REALITY
    return None


def _of_start(head: bytes) -> Sight | None:
    return _ARCHIVE if head.startswith(_ARCHIVE_STARTS) else None


def _folder(path: Path) -> Sight | None:
    for frames in (path, path / "keyframes"):
        for corrected in ("corrected_", ""):
            photos, cameras = frames / f"{corrected}images", frames / f"{corrected}cameras"
            if photos.is_dir() and cameras.is_dir():
                return Sight("Polycam's raw export", _as_capture(path), poses=True)
    if (path / "rgb").is_dir() and any((path / name).is_file() for name in ("metadata.json", "metadata")):
        return Sight("Record3D's export", _as_capture(path), poses=True)
    if any(path.glob("point_cloud/iteration_*/point_cloud.ply")):
        newest = max(
            path.glob("point_cloud/iteration_*/point_cloud.ply"), key=lambda each: _number(each.parent)
        )
        return Sight("a model folder of 3DGS", f"tron-relight scene={quote(str(newest))} takes its splats")
    if (path / "lod-meta.json").is_file() or ((path / "meta.json").is_file() and any(path.glob("*.webp"))):
        return Sight("a folder of SOG, splats", f"tron-relight scene={quote(str(path))} takes it")
    if (path / "nerfstudio_models").is_dir():
        config = quote(str(path / "config.yml"))
        mend = (
            f"`ns-export gaussian-splat --load-config {config} --output-dir OUT` writes a PLY of its splats"
        )
        return Sight("a trained model of nerfstudio", mend)
    return None


def _as_capture(path: Path) -> str:
    return f"tron-reconstruct capture={quote(str(path))} reads its photos and poses"


def _number(folder: Path) -> int:
    digits = folder.name.rpartition("_")[2]
    return int(digits) if digits.isdecimal() else -1
