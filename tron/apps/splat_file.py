"""``scene=`` as people give it: a file of splats, or the folder or archive that holds one."""

from __future__ import annotations

import logging
import tarfile
import zipfile
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import IO, Annotated

from pydantic import AfterValidator

from tron.errors import TronError
from tron.storage import atomic_path

log = logging.getLogger(__name__)

_OURS = (".proxy.ply", ".materials.ply")
"""Files that TRON keeps beside a scan."""
_ARCHIVES = (".zip", ".tar", ".tgz", ".tar.gz", ".tar.bz2", ".tar.xz", ".tbz2", ".txz")
_MOST_EXPANDED = 100
"""Times an archive's size that a file in it may have."""
_ALWAYS_ALLOWED = 1 << 30
_CHUNK = 1 << 20
_SHOWN = 4
_MOST_NAMES = 100_000


def splat_file(path: Path) -> Path:
    """The file of splats that a path is or holds; of other folders and archives the path itself.

    A folder is one of SOG, or holds one file of splats. An archive holds one; it is unpacked into a folder
    beside it, once. A line says what is taken.

    Raises:
        TronError: there are several, or an archive is damaged, too large or cannot be unpacked.
    """
    if path.is_dir():
        from tron.gaussians.formats.sog import sog_file

        found = sog_file(path) or _only(path, [str(each) for each in _splats_in(path)])
        return path if found is None else Path(found)
    if path.is_file() and path.name.lower().endswith(_ARCHIVES):
        return _unpacked(path)
    return path


SPLATS = (".ply", ".splat", ".spz", ".sog", ".glb", ".usd", ".usda", ".usdc", ".usdz")
"""Suffixes of files that are written: those of the registry of formats, which help does not wait for."""
SceneFile = Annotated[Path, AfterValidator(splat_file)]
"""Setting of a scene's file."""


def _named(name: str) -> bool:
    from tron.gaussians.formats.registry import named_as_splats

    return named_as_splats(name) and not name.startswith(".") and not name.lower().endswith(_OURS)


def _splats_in(folder: Path) -> list[Path]:
    """Files of splats in a folder, or where there are none, in the folders in it."""
    for pattern in ("*", "*/*"):
        files = sorted(each for each in folder.glob(pattern) if _named(each.name) and each.is_file())
        if found := [each for each in files if _is_splats(each)]:
            return found
    return []


def _is_splats(path: Path) -> bool:
    """Whether a file that is named as one holds splats: meshes and points do not."""
    try:
        from tron.gaussians.formats.registry import check_header

        check_header(path)
    except TronError:
        return False
    return True


def _only(path: Path, names: Sequence[str]) -> str | None:
    if len(names) > 1:
        shown = ", ".join(names[:_SHOWN]) + (
            f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
        )
        raise TronError(f"holds {len(names)} files of splats", path, f"give one of them: {shown}")
    if names:
        log.info("%s: its one file of splats is taken, %s", path, names[0])
    return names[0] if names else None


def _unpacked(path: Path) -> Path:
    """The one file of splats of an archive, unpacked beside it; the archive itself where there is none."""
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                sizes = {each.filename: each.file_size for each in archive.infolist() if not each.is_dir()}
                name = _chosen(path, sizes)
                return path if name is None else _kept(path, name, sizes[name], archive.open(name))
        if tarfile.is_tarfile(path):
            with tarfile.open(path) as archive:
                members = {}
                for each in archive:
                    if len(members) > _MOST_NAMES:
                        raise TronError("an archive of too many files", path, "unpack it")
                    if each.isfile():
                        members[each.name] = each
                name = _chosen(path, {each: member.size for each, member in members.items()})
                stream = None if name is None else archive.extractfile(members[name])
                return (
                    path if name is None or stream is None else _kept(path, name, members[name].size, stream)
                )
    except (OSError, EOFError, zipfile.BadZipFile, tarfile.TarError, RuntimeError, ValueError) as error:
        raise TronError(f"cannot be unpacked: {error}", path, "unpack it, and give the file in it") from error
    except (NotImplementedError, zipfile.LargeZipFile) as error:
        raise TronError("is compressed in a way that is not read", path, "unpack it") from error
    return path


def _chosen(path: Path, sizes: dict[str, int]) -> str | None:
    names = [name for name in sizes if _named(PurePosixPath(name).name) and "__MACOSX" not in name]
    name = _only(path, sorted(name for name in names if not name.lower().endswith(".json")))
    if name is None:
        if names:
            raise TronError("an archive of SOG in many files", path, "unpack it, and give its folder")
        return None
    if sizes[name] > max(_ALWAYS_ALLOWED, _MOST_EXPANDED * path.stat().st_size):
        raise TronError(f"'{name[:60]}' in it claims {sizes[name]:,} bytes", path, "unpack it yourself")
    return name


def _kept(path: Path, name: str, size: int, stream: IO[bytes]) -> Path:
    """The file's content in a folder beside the archive, under the last part of its name alone."""
    target = path.with_name(f"{path.name}.unpacked") / PurePosixPath(name.replace("\\", "/")).name
    with stream:
        if (
            target.is_file()
            and target.stat().st_size == size
            and target.stat().st_mtime > path.stat().st_mtime
        ):
            return target
        target.parent.mkdir(exist_ok=True)
        log.info("%s: unpacking to %s", path, target)
        with atomic_path(target) as temporary, open(temporary, "wb") as out:
            while chunk := stream.read(_CHUNK):
                size -= len(chunk)
                if size < 0:
                    raise TronError("expands to more than it claims", path, "unpack it yourself")
                out.write(chunk)
    return target
