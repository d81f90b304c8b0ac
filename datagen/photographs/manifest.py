"""Manifest of a folder of captures: the files of each with size and hash, for verification."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from datagen.dataset.records import TRACEBACKS
from datagen.photographs.pseudo_captures import read_blind_capture
from tron.captures.folder import is_capture_folder, read_capture_folder
from tron.errors import TronError
from tron.storage import sha256, write_if_changed

MANIFEST_NAME = "manifest.json"
NOT_PIXELS = ("name", "camera", "space")
"""Fields of a view beside its picture and its maps."""


class FileEntry(BaseModel):
    """One file: its size in bytes and its sha256 (hex)."""

    model_config = ConfigDict(extra="forbid")

    bytes: int = Field(ge=0)
    sha256: str = Field(pattern="^[0-9a-f]{64}$")


class CaptureManifest(BaseModel):
    """manifest.json of a folder of captures: capture -> path within it -> entry."""

    model_config = ConfigDict(extra="forbid")

    captures: dict[str, dict[str, FileEntry]] = Field(default_factory=dict)

    @classmethod
    def load(cls, folder: Path) -> CaptureManifest:
        """Read folder/manifest.json; return an empty manifest if there is none.

        Raises:
            TronError: it is damaged.
        """
        path = folder / MANIFEST_NAME
        try:
            return cls.model_validate_json(path.read_bytes())
        except FileNotFoundError:
            return cls()
        except (OSError, ValidationError) as error:
            raise TronError(
                "the manifest of the captures is damaged",
                path,
                "delete it and run the same again",
            ) from error

    def record(self, capture: Path) -> None:
        """Record every file of a finished capture."""
        self.captures[capture.name] = {
            name: FileEntry(bytes=path.stat().st_size, sha256=sha256(path)) for name, path in _files(capture)
        }

    def holds(self, capture: Path) -> bool:
        """Whether every recorded file of a capture exists with its recorded size."""
        sizes = {name: path.stat().st_size for name, path in _files(capture)}
        return sizes == {name: entry.bytes for name, entry in self.captures.get(capture.name, {}).items()}

    def save(self, folder: Path) -> None:
        """Write folder/manifest.json, captures and files in order of name."""
        ordered = CaptureManifest(
            captures={name: dict(sorted(files.items())) for name, files in sorted(self.captures.items())}
        )
        write_if_changed(folder / MANIFEST_NAME, ordered.model_dump_json(indent=1) + "\n")


def capture_names(folder: Path) -> list[str]:
    """Return the names of the captures in their folder, in order; hidden folders are half-written."""
    found = (path.name for path in folder.iterdir() if path.is_dir() and path.name != TRACEBACKS)
    return sorted(name for name in found if not name.startswith("."))


def _files(capture: Path) -> Iterator[tuple[str, Path]]:
    for path in sorted(capture.rglob("*")):
        if path.is_file():
            yield path.relative_to(capture).as_posix(), path


def verify_captures(folder: Path) -> list[str]:
    """Return every problem of a folder of captures, one line each; empty if there are none.

    It finds missing, stray, truncated, corrupted and undecodable files, and missing and stray captures.
    """
    try:
        manifest = CaptureManifest.load(folder)
    except TronError as error:
        return [str(error)]
    there = set(capture_names(folder))
    problems = []
    for name in sorted(there | manifest.captures.keys()):
        if name not in there:
            problems.append(f"{name}: missing")
            continue
        recorded = manifest.captures.get(name)
        if recorded is None:
            problems.append(f"{name}: not in the manifest: a run with the same settings records it")
        else:
            problems += [f"{name}/{problem}" for problem in _changes(folder / name, recorded)]
        problems += [f"{name}: {problem}" for problem in _unreadable(folder / name)]
    return problems


def _changes(capture: Path, recorded: dict[str, FileEntry]) -> Iterator[str]:
    there = dict(_files(capture))
    for name, entry in recorded.items():
        path = there.get(name)
        if path is None:
            yield f"{name}: missing"
        elif path.stat().st_size != entry.bytes:
            yield f"{name}: {path.stat().st_size} bytes, should be {entry.bytes}"
        elif sha256(path) != entry.sha256:
            yield f"{name}: sha256 differs: its bytes have changed"
    for name in sorted(there.keys() - recorded.keys()):
        yield f"{name}: not in the manifest"


def _unreadable(capture: Path) -> Iterator[str]:
    """Yield the problems of reading a capture, or a picture or map of a view."""
    try:
        ours = is_capture_folder(capture)
        views = (read_capture_folder(capture) if ours else read_blind_capture(capture)).views
    except TronError as error:
        yield str(error)
        return
    for view in views:
        for field in (field.name for field in fields(view) if field.name not in NOT_PIXELS):
            if not view.has(field):
                continue
            try:
                view.read(field)
            except TronError as error:
                yield str(error)
