"""Views on disk while a scene's surfels are made from them and fitted to them.

290 G-buffers of 800 x 800 pixels are nine gigabytes; one at a time is read back. The file has no name, so
that nothing is left of it however the process ends.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from datagen.spool import Frame, Spool
from tron.cameras import Camera
from tron.captures import View
from tron.color import linear_to_srgb
from tron.gaussians.initialize import GBufferView

MAPS = {"normal": 3, "base_color": 3, "roughness": 1, "metallic": 1, "mask": 1}
"""Maps of a view that are written, and their channels, float32."""


def view_bytes(count: int, width: int, height: int) -> int:
    """Bytes of so many views on disk."""
    return count * width * height * 4 * sum(MAPS.values())


class ViewSpool:
    """Context manager that holds what a reconstruction learns from true G-buffers.

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
        """The same views, each written down on its way.

        Raises:
            TronError: the disk is full.
        """
        for view in views:
            self._spool.add(0, _maps(view))
            self._cameras.append(view.camera)
            yield view

    def views(self) -> Sequence[View]:
        """All that was written, each map read when it is asked for; not beyond this block.

        No light is on in a G-buffer, so its picture is base color.
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
    return View(
        name=f"{number:04d}",
        camera=camera,
        image=lambda: linear_to_srgb(read("base_color")),
        space="display",
        normal=partial(read, "normal"),
        base_color=partial(read, "base_color"),
        roughness=partial(read, "roughness"),
        metallic=partial(read, "metallic"),
        mask=partial(read, "mask"),
    )
