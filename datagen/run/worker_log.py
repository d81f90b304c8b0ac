"""Log of a Dask worker: messages of its scenes, and stacks of crashes in native code."""

from __future__ import annotations

import faulthandler
import logging
import re
from pathlib import Path
from typing import Any

from dask.distributed import WorkerPlugin

from tron.cli.log import Level, configure_logging

FORMAT = "%(asctime)s %(levelname)s %(name)s: %(message)s"


class WorkerLog(WorkerPlugin):
    """Log file of each worker in a folder, named for the worker; its replacement continues the file.

    Args:
        folder: made if missing.
        level: log level of the command.
        ours: the worker ends with the command, so what Dask says in it, also while it ends, is for the log
            and not for the command's terminal.
    """

    def __init__(self, folder: Path, level: Level, ours: bool = True) -> None:
        self.name = f"log in {folder}"
        self._folder = folder
        self._level: Level = level
        self._ours = ours

    def setup(self, worker: Any) -> None:
        """Begin to write; Dask calls this in every present and future worker."""
        self._folder.mkdir(parents=True, exist_ok=True)
        path = self._folder / f"worker-{re.sub(r'[^0-9A-Za-z.-]+', '-', str(worker.name))}.log"
        self._stream = path.open("a")
        self._handler = logging.StreamHandler(self._stream)
        self._handler.setFormatter(logging.Formatter(FORMAT))
        logging.getLogger().addHandler(self._handler)
        if self._ours:
            dask = logging.getLogger("distributed")
            dask.handlers = [logging.NullHandler(), self._handler]
        configure_logging(self._level)  # the root has a handler now, so stderr gets none
        self._crashes = not faulthandler.is_enabled()
        if self._crashes:
            faulthandler.enable(self._stream)

    def teardown(self, worker: Any) -> None:  # noqa: ARG002
        """End the log; a worker of another's scheduler lives on without it."""
        if self._crashes:
            faulthandler.disable()
        logging.getLogger().removeHandler(self._handler)
        logging.getLogger("distributed").removeHandler(self._handler)
        self._handler.acquire()  # a thread of Dask's may be amid a line, or about to say its last one
        try:
            self._handler.emit = lambda record: None  # noqa: ARG005
            self._stream.close()
        finally:
            self._handler.release()
