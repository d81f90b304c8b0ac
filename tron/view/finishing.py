"""The last step of a picture at rest: remove the noise that remains after all passes.

Either a network draws the picture from the passes' buffers, or a denoiser filters it. Both process the whole
picture and abandon it once it is out of date: a network between two of its layers; a denoiser, which cannot
be interrupted, by letting it finish in the background.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Protocol, TypeVar

import numpy as np

from tron.color import from_agx
from tron.denoising import DENOISERS, denoised
from tron.shards.schema import displayed

if TYPE_CHECKING:
    from tron.neural.protocols import Renderer

T = TypeVar("T")
POLL_SECONDS = 0.01


class Finish(Protocol):
    """How a picture is finished.

    Attributes:
        buffers: of light that it is given besides ``lit``.
        normals: whether it is given ``normal``, of unit length in the world.
    """

    buffers: tuple[str, ...]
    normals: bool

    def __call__(
        self, frame: Mapping[str, np.ndarray], exposure: float, watch: Callable[[], None]
    ) -> np.ndarray:
        """(H, W, 3) linear radiance.

        Args:
            frame: ``lit`` and :attr:`buffers`, linear, and what
                :func:`tron.shading.guidance.surface_maps` gives, by name.
            exposure: of the light, factor before AgX.
            watch: called in between; it raises where the picture is out of date.
        """
        ...


class Drawn:
    """By a network, of a single frame.

    Args:
        loaded: the network, or soon.
    """

    buffers: tuple[str, ...] = ("pbr", "irradiance")
    normals = False

    def __init__(self, loaded: Future[Renderer]) -> None:
        self._loaded = loaded

    def __call__(
        self, frame: Mapping[str, np.ndarray], exposure: float, watch: Callable[[], None]
    ) -> np.ndarray:
        """As :class:`Finish` says."""
        from tron.neural.renderer import render_clip  # torch

        renderer = _awaited(self._loaded, watch)
        shown = {name: displayed(name, frame[name], exposure)[None] for name in renderer.config.guidance}
        hooks = [part.register_forward_pre_hook(lambda *_: watch()) for part in renderer.modules()]
        try:
            (display,) = render_clip(renderer, shown, window=1)
        finally:
            for hook in hooks:
                hook.remove()
        return from_agx(display) / np.float32(exposure)


class Denoised:
    """By a denoiser (:mod:`tron.denoising`), given by its name."""

    buffers: tuple[str, ...] = ()

    def __init__(self, name: str) -> None:
        self._name, self.normals = name, "normal" in DENOISERS[name].wants
        self._thread = ThreadPoolExecutor(1, "denoiser")

    def __call__(
        self, frame: Mapping[str, np.ndarray], exposure: float, watch: Callable[[], None]
    ) -> np.ndarray:
        """As :class:`Finish` says; ``exposure`` plays no part."""
        del exposure
        return _awaited(self._thread.submit(denoised, self._name, frame["lit"], frame), watch)


def _awaited(soon: Future[T], watch: Callable[[], None]) -> T:
    while not soon.done():
        watch()
        time.sleep(POLL_SECONDS)
    return soon.result()
