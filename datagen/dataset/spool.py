"""Frames of several clips on disk: written frame by frame under every light, read clip by clip.

93 frames under 20 lights at 512 x 512 are tens of gigabytes; they are stored as in a shard. True G-buffers
are spooled too while surfels are made from them: 290 of 800 x 800 pixels are nine gigabytes. The file has no
name, so nothing remains of it however the process ends.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, overload

import numpy as np

from tron.cameras import Camera
from tron.captures import View
from tron.color import linear_to_srgb
from tron.errors import TronError
from tron.gaussians.initialize import GBufferView
from tron.shards.schema import MEMBERS

if TYPE_CHECKING:
    from tron.shading.guidance import Guidance
import io
from dataclasses import dataclass, field

from datagen.clock import stage
from datagen.dataset.clip_preview import contact_row, sheet_name, thumbnail_name, write_preview
from datagen.dataset.records import ClipRow, Quarantined, Work, clip_row
from datagen.dataset.variety import COUNTED_MEMBERS
from tron.io.images import write_image
from tron.report.contact_sheet import contact_sheet
from tron.shards.manifest import ShardEntry
from tron.shards.schema import ClipMeta
from tron.shards.writer import ShardWriter
from tron.storage import write_atomic

Frame = dict[str, np.ndarray]
LARGEST = float(np.finfo(np.float16).max)


class _Place(NamedTuple):
    offset: int
    dtype: np.dtype
    shape: tuple[int, ...]


class Spool:
    """Context manager that holds the frames of ``clips`` clips.

    Args:
        folder: folder of the file, made if missing.
        clips: number of clips.
        store: name and image -> image to write; by default as in a shard.
    """

    def __init__(
        self, folder: Path, clips: int, store: Callable[[str, np.ndarray], np.ndarray] | None = None
    ) -> None:
        self._store = store or stored
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 closed by __exit__
        self._places: list[list[dict[str, _Place]]] = [[] for _ in range(clips)]

    def __enter__(self) -> Spool:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError):  # what did not fit is written once more, for nobody
            self._file.close()

    def add(self, clip: int, frame: Frame) -> None:
        """Append a frame to clip number ``clip``; half floats are rounded as a shard rounds them.

        Raises:
            TronError: the disk is full.
        """
        places = {}
        for name, image in frame.items():
            image = np.ascontiguousarray(self._store(name, image))
            places[name] = _Place(self._file.tell(), image.dtype, image.shape)
            try:
                self._file.write(image.data)
                self._file.flush()  # else a full disk is found out when frames are read
            except OSError as error:
                mend = "free some space, or choose another output_dir"
                raise TronError(f"frames cannot be held: {error.strerror}", self._folder, mend) from error
        self._places[clip].append(places)

    def clip(self, number: int) -> Clip:
        """Return the frames of one clip, read on demand, within this block only."""
        return Clip(self, self._places[number])

    def read(self, place: _Place) -> np.ndarray:
        """Read one image, float32."""
        here = self._file.tell()
        self._file.seek(place.offset)
        count = int(np.prod(place.shape))
        image = np.frombuffer(self._file.read(count * place.dtype.itemsize), place.dtype)
        self._file.seek(here)
        return image.reshape(place.shape).astype(np.float32)


class Clip(Sequence[Frame]):
    """Frames of one clip in a :class:`Spool`."""

    def __init__(self, spool: Spool, places: Sequence[dict[str, _Place]]) -> None:
        self._spool, self._places = spool, places

    def __len__(self) -> int:
        return len(self._places)

    @overload
    def __getitem__(self, index: int) -> Frame: ...
    @overload
    def __getitem__(self, index: slice) -> Clip: ...
    def __getitem__(self, index: int | slice) -> Frame | Clip:
        if isinstance(index, slice):
            return Clip(self._spool, self._places[index])
        return {name: self._spool.read(place) for name, place in self._places[index].items()}

    def image(self, index: int, name: str) -> np.ndarray:
        """Read one member of one frame, float32."""
        return self._spool.read(self._places[index][name])

    def __iter__(self) -> Iterator[Frame]:
        return (self[k] for k in range(len(self)))


def stored(name: str, image: np.ndarray) -> np.ndarray:
    """Return a member's image in a shard's precision; non-finite values stay, to be found later."""
    if MEMBERS[name].bytes != 2:
        return np.asarray(image, np.float32)
    bounded = np.where(np.isfinite(image), np.clip(image, -LARGEST, LARGEST), image)
    return bounded.astype(np.float16)


def stored_guidance(guidance: Guidance) -> Frame:
    """Return the members of a frame from its guidance."""
    return {name: guidance[name] for name in guidance.BUFFERS if name in MEMBERS}


MAPS = {"normal": 3, "base_color": 3, "roughness": 1, "metallic": 1, "mask": 1}
"""Maps of a view that are written, and their channels, float32."""


def view_bytes(count: int, width: int, height: int) -> int:
    """Return the bytes of so many views on disk."""
    return count * width * height * 4 * sum(MAPS.values())


class ViewSpool:
    """Context manager that holds views of true G-buffers for a reconstruction.

    Args:
        folder: where; made if it is missing.
    """

    def __init__(self, folder: Path) -> None:
        self._spool = Spool(folder, clips=1, store=_whole)
        self._cameras: list[Camera] = []

    def __enter__(self) -> ViewSpool:
        self._spool.__enter__()
        return self

    def __exit__(self, *raised: object) -> None:
        self._spool.__exit__(*raised)

    def passing(self, views: Iterable[GBufferView]) -> Iterator[GBufferView]:
        """Pass views through, and write each one to disk.

        Raises:
            TronError: the disk is full.
        """
        for view in views:
            self._spool.add(0, _maps(view))
            self._cameras.append(view.camera)
            yield view

    def views(self) -> Sequence[View]:
        """Return all written views, with maps read on demand, within this block only.

        A G-buffer has no light, so its picture is base color.
        """
        clip = self._spool.clip(0)
        return [
            _as_view(number, camera, partial(clip.image, number))
            for number, camera in enumerate(self._cameras)
        ]


def _whole(_: str, image: np.ndarray) -> np.ndarray:
    return np.asarray(image, np.float32)


def _maps(seen: GBufferView) -> Frame:
    inside = seen.valid[..., None]
    return {
        "normal": np.where(inside, seen.normal, 0),
        "base_color": np.where(inside, seen.base_color, 0),
        "roughness": np.where(seen.valid, seen.roughness, 0),
        "metallic": np.where(seen.valid, seen.metallic, 0),
        "mask": seen.valid,
    }


def _as_view(number: int, camera: Camera, read: Callable[[str], np.ndarray]) -> View:
    maps = {name: partial(read, name) for name in MAPS}
    return View(f"{number:04d}", camera, lambda: linear_to_srgb(read("base_color")), "display", **maps)


@dataclass
class SceneFiles:
    """Result of :func:`write_clips`: shards, and clips in and out of them.

    Attributes:
        shards: written shards.
        quarantined: clips that must not go into a shard.
        made: the other clips, each with members of its first frame for the histograms.
    """

    shards: list[ShardEntry] = field(default_factory=list)
    quarantined: list[Quarantined] = field(default_factory=list)
    made: list[tuple[ClipMeta, Frame]] = field(default_factory=list)

    def rows(self) -> list[ClipRow]:
        """One row per clip."""
        shards = {key: entry.name for entry in self.shards for key in entry.keys}
        return [clip_row(meta, shards[meta.key], thumbnail_name(meta.key)) for meta, _ in self.made]


def write_clips(
    output: Path, item: Work, clips: Iterable[tuple[ClipMeta, Sequence[Frame]]], clips_per_shard: int
) -> SceneFiles:
    """Write a scene's clips under final names, each file whole or not at all.

    A clip with a value that is not finite is set aside in ``quarantine/``.
    """
    found = SceneFiles()
    rows: dict[str, list[np.ndarray]] = {}
    with ShardWriter(output, item.split, clips_per_shard, item.first_shard) as writer:
        for meta, frames in clips:
            problem = first_bad_value(frames)
            if problem is not None:
                found.quarantined.append(Quarantined(key=meta.key, reason=problem))
                _set_aside(output / "quarantine" / f"{meta.key}.npz", frames)
                continue
            with stage("write"):
                writer.write(meta, frames)
                write_preview(output, meta, frames)
                rows[meta.key] = contact_row(meta, frames[0])
            counted = {name: frames[0][name] for name in COUNTED_MEMBERS if name in frames[0]}
            found.made.append((meta, counted))
    found.shards = writer.entries
    for entry in writer.entries:
        write_image(output / sheet_name(entry.name), contact_sheet([rows[key] for key in entry.keys]))
    return found


def first_bad_value(frames: Sequence[Frame]) -> str | None:
    """Describe the first non-finite value of a clip, which must not reach a shard; None if all are finite."""
    for i, frame in enumerate(frames):
        for member, image in frame.items():
            bad = int((~np.isfinite(image)).sum())
            if bad:
                return f"frame {i}: {member} has {bad} values that are not finite"
    return None


def _set_aside(path: Path, frames: Sequence[Frame]) -> None:
    buffer = io.BytesIO()
    arrays = {member: np.stack([frame[member] for frame in frames]) for member in frames[0]}
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    write_atomic(path, buffer.getvalue())
