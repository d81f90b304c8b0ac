"""The one error that users see: what is wrong, where, and how to mend it, on a single line."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache


class TronError(Exception):
    """A mistake in the input or the environment that its owner can mend.

    Commands print it as one line and exit with code 2; a defect of TRON itself is never raised as this type.

    Args:
        what: what is wrong, without a final full stop, e.g. ``"file not found"``.
        where: the file, key or value it was found at, if there is one.
        mend: what to do about it, if that is known.
    """

    def __init__(self, what: str, where: str | os.PathLike[str] | None = None, mend: str | None = None):
        self.what = what
        self.where = None if where is None else os.fspath(where)
        self.mend = mend
        super().__init__(what, where, mend)  # all three, so that the error survives pickling between workers

    def __str__(self) -> str:
        text = self.what
        if self.where:
            text += f" ({self.where})"
        if self.mend:
            text += f": {self.mend}"
        return " ".join(text.split())


@contextmanager
def located(where: str | os.PathLike[str] | None) -> Iterator[None]:
    """Errors of the block that do not say where were found in ``where``."""
    try:
        yield
    except TronError as error:
        raise TronError(error.what, error.where or where, error.mend) from error


@lru_cache(maxsize=4096)
def say_once(logger: str, line: str, level: int = logging.INFO) -> None:
    """Log a line under this logger's name, the first time that it is asked for."""
    logging.getLogger(logger).log(level, "%s", line)
