"""Functions whose kernels are recorded once and replayed, with no garbage collection in between.

A Mitsuba object that is freed while Dr.Jit records a function aborts the process, and Python's collector of
cycles may free one at any allocation: an integrator or a scene that nobody holds any more.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from functools import wraps
from typing import TypeVar

import drjit as dr

Function = TypeVar("Function", bound=Callable)


def recorded(function: Function) -> Function:
    """Freeze ``function``, which is recorded once for each kind of arguments; ``__wrapped__`` is Dr.Jit's."""
    frozen = dr.freeze(function, limit=64, warn_after=1000)

    @wraps(frozen)
    def call(*arguments: object) -> object:
        collects = gc.isenabled()
        gc.disable()
        try:
            return frozen(*arguments)
        finally:
            if collects:
                gc.enable()

    return call  # pyright: ignore[reportReturnType]
