"""Frames of several clips on disk: they come frame by frame under every light, and leave clip by clip.

93 frames under 20 lights at 512 x 512 are tens of gigabytes; what is read back is what a shard stores of it.
The file has no name, so that nothing is left of it however the process ends.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, overload

import numpy as np

from tron.errors import TronError
from tron.shards.schema import MEMBERS

if TYPE_CHECKING:
    from tron.shading.guidance import Guidance

Frame = dict[str, np.ndarray]
LARGEST = float(np.finfo(np.float16).max)


class _Place(NamedTuple):
    offset: int
    dtype: np.dtype
    shape: tuple[int, ...]


class Spool:
    """Context manager that holds the frames of ``clips`` clips.

    Args:
        folder: where; made if it is missing.
        clips: how many.
        store: name and image -> what is written of it; by default what a shard would store.
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
        """The frames of one clip, each read when it is asked for; not beyond this block."""
        return Clip(self, self._places[number])

    def read(self, place: _Place) -> np.ndarray:
        """One image, float32."""
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
        """One member of one frame, float32."""
        return self._spool.read(self._places[index][name])

    def __iter__(self) -> Iterator[Frame]:
        return (self[k] for k in range(len(self)))


def stored(name: str, image: np.ndarray) -> np.ndarray:
    """A member's image in the precision that a shard keeps; what is not finite stays so, and is found."""
    if MEMBERS[name].bytes != 2:
        return np.asarray(image, np.float32)
    bounded = np.where(np.isfinite(image), np.clip(image, -LARGEST, LARGEST), image)
    return bounded.astype(np.float16)


def stored_guidance(guidance: Guidance) -> Frame:
    """Members of a frame that guidance gives."""
    return {name: guidance[name] for name in guidance.BUFFERS if name in MEMBERS}
