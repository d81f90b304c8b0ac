"""Images by the names that files of poses give them."""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from tron.captures.masks import is_mask
from tron.captures.photos.photo_files import SUFFIXES
from tron.errors import TronError, located


class ImageFolder:
    """Finds images by the names that poses give them.

    An image is sought where its name says, below ``root``. If it names a folder that is absent, such as
    ``images``, the largest reduced copy of it is taken: ``images_2``, else ``images_4`` and so on, as DL3DV
    and nerfstudio ship them. A name without a suffix, or with another one than the file, is completed; so is
    one in other case, or whose accents are composed otherwise (macOS), where one file alone is meant.

    Args:
        root: the capture's folder.
        images: a folder to search instead, relative to ``root`` or absolute. A name is sought there as it
            stands, then without its first folder.

    Raises:
        TronError: ``images`` is not a folder.
    """

    def __init__(self, root: Path, images: str | Path | None = None):
        self.root = root
        self.images = None if images is None else root / images
        if self.images is not None and not self.images.is_dir():
            raise TronError("folder of images not found", self.images)
        self._stems: dict[Path, dict[str, list[Path]]] = {}
        self._substitutes: dict[str, str] = {}

    def find(self, name: str, where: str | Path) -> Path | None:
        """File of an image that ``where`` names, or None if it is absent.

        Raises:
            TronError: the name is absolute or leads out of the folder; it was found in ``where``.
        """
        with located(where):
            parts = relative_parts(name)
        if self.images is not None:
            return self._file(self.images, parts) or self._file(self.images, parts[1:])
        return self._file(self.root, (self._present(parts[0]), *parts[1:]))

    def _present(self, folder: str) -> str:
        """The folder of this name, or its largest reduced copy."""
        if folder not in self._substitutes:
            found = folder
            if not (self.root / folder).exists():
                pattern = re.compile(re.escape(folder) + r"_(\d{1,3})")
                matches = [pattern.fullmatch(each.name) for each in _subfolders(self.root)]
                reduced = sorted((int(match[1]), match[0]) for match in matches if match)
                found = reduced[0][1] if reduced else folder
            self._substitutes[folder] = found
        return self._substitutes[folder]

    def _file(self, folder: Path, parts: Sequence[str]) -> Path | None:
        if not parts:
            return None
        path = folder.joinpath(*parts)
        if path.is_file():
            return path
        if path.parent not in self._stems:
            stems: dict[str, list[Path]] = {}
            for each in photos_in(path.parent):
                for name in {each.stem, each.name, _plain(each.stem), _plain(each.name)}:
                    stems.setdefault(name, []).append(each)
            self._stems[path.parent] = stems
        stem = path.stem if path.suffix.lower() in SUFFIXES else path.name
        names = (name for each in (path.name, stem) for name in (each, _plain(each)))
        found = (self._stems[path.parent].get(name, []) for name in names)
        return next((same[0] for same in found if len(same) == 1), None)


def _plain(name: str) -> str:
    """A name as systems that heed neither case nor composition see it; NUL keeps it apart from others."""
    return "\0" + unicodedata.normalize("NFC", name).casefold()


def relative_parts(name: str) -> tuple[str, ...]:
    """The parts of an image's name below the capture's folder; ``./`` and inner ``..`` are resolved.

    Raises:
        TronError: the name is empty, absolute or leads out of the folder.
    """
    plain = name.replace("\\", "/")
    if PurePosixPath(plain).is_absolute() or re.match(r"[A-Za-z]:", plain) or "\0" in plain:
        raise TronError(
            f"image name {name!r} is absolute", mend="name images relative to the capture's folder"
        )
    parts: list[str] = []
    for part in PurePosixPath(plain).parts:
        if part != "..":
            parts.append(part)
        elif parts:
            parts.pop()
        else:
            raise TronError(f"image name {name!r} leads out of the capture's folder")
    if not parts:
        raise TronError("image name is empty")
    return tuple(parts)


def photos_in(folder: Path) -> list[Path]:
    """Image files that lie directly in a folder, sorted by name; none if there is no such folder.

    ``NAME_mask.png`` beside a photo is its mask and no photo.
    """
    if not folder.is_dir():
        return []
    found = [each for each in folder.iterdir() if each.suffix.lower() in SUFFIXES and each.is_file()]
    stems = {each.stem for each in found}
    return sorted(each for each in found if not (each.name.startswith(".") or is_mask(each, stems)))


def view_names(names: Sequence[str]) -> list[str]:
    """Names for views: the images' below the deepest folder that holds them all, without suffix.

    The suffix stays where two images would be called the same.
    """
    parts = [relative_parts(name) for name in names]
    shared = 0
    shortest = min(len(each) for each in parts)
    while shared < shortest - 1 and len({each[: shared + 1] for each in parts}) == 1:
        shared += 1
    full = ["/".join(each[shared:]) for each in parts]
    short = [_without_suffix(each) for each in full]
    claims = Counter(zip(short, full))
    owners = Counter(stem for stem, _ in claims)
    return [stem if owners[stem] == 1 else name for stem, name in zip(short, full)]


def _without_suffix(name: str) -> str:
    stem, dot, suffix = name.rpartition(".")
    return stem if dot and f".{suffix.lower()}" in SUFFIXES and stem else name


def _subfolders(folder: Path) -> list[Path]:
    return [each for each in folder.iterdir() if each.is_dir()] if folder.is_dir() else []
