"""The log of a command, on stderr; its workers configure theirs by the same function."""

from __future__ import annotations

import logging
import os
import sys
from typing import Literal, get_args

Level = Literal["debug", "info", "warning", "error"]
LEVELS: tuple[Level, ...] = get_args(Level)
VARIABLE = "TRON_LOG_LEVEL"
"""Environment variable with the level."""
OWN_PACKAGES = ("tron", "datagen", "train", "eval")


def configure_logging(level: Level | None = None) -> None:
    """Send the log to stderr: coloured on a terminal, plain unwrapped lines into a file or a pipe.

    The level goes into the environment for processes that this one starts, which take it by calling this
    without one; workers elsewhere are told, by ``client.run(configure_logging, log_level())``. At debug only
    our own packages speak: some libraries report every file they open.
    """
    if level is not None:
        os.environ[VARIABLE] = level
    level = log_level()
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.logging import RichHandler

        handler: logging.Handler = RichHandler(console=Console(stderr=True), show_path=False)
        handler.setFormatter(logging.Formatter("%(message)s", datefmt="%X"))
    else:
        handler = logging.StreamHandler()
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s", datefmt="%X"))
    logging.basicConfig(handlers=[handler])
    logging.getLogger().setLevel("INFO" if level == "debug" else level.upper())
    for name in OWN_PACKAGES:
        logging.getLogger(name).setLevel("DEBUG" if level == "debug" else logging.NOTSET)
    logging.captureWarnings(True)


def log_level() -> Level:
    """Level that commands of this process log at."""
    levels: dict[str, Level] = {level: level for level in LEVELS}
    return levels.get(os.environ.get(VARIABLE, ""), "info")
