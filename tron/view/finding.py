"""Finding a scan's materials while its window shows guessed ones: by a process of its own, which gives way.

It is what tron-relight does before its first frame, and takes minutes. What it finds is kept beside the scan,
and the window opens the file once more.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tron.gaussians.scene import GaussianScene
from tron.runtime import activate
from tron.scans import GroundChoice
from tron.scans.scan import Scan

LEAST_PRIORITY = 19
"""Niceness of the search: pictures come first."""
SAID_SECONDS = 0.5
"""Between two words of how far it is."""
Told = Callable[[str, float], None]


@dataclass
class MaterialSearch:
    """A scan whose materials may be found.

    Attributes:
        file: of the scan.
        opened: arguments of :meth:`tron.scans.Scan.open`, but for its materials.
        ground: choice of what it stands on.
        variant: of Mitsuba. threads: of Dr.Jit; None: all.
    """

    file: Path
    opened: dict[str, Any]
    ground: GroundChoice = "auto"
    variant: str = "llvm_ad_rgb"
    threads: int | None = None
    _process: subprocess.Popen[str] | None = field(default=None, repr=False)

    def begin(self, told: Told, done: Callable[[str], None]) -> None:
        """Start it; both are called on a thread of its own.

        Args:
            told: what is being done, and the share of it that is done.
            done: called once, with why nothing was found; empty where materials are kept now.
        """
        given = {"file": self.file, "opened": self.opened, "variant": self.variant, "threads": self.threads}
        # No fork beside Dr.Jit's threads; and a spawned process would run a caller's script once more.
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", __name__, json.dumps(given, default=str)],
            stdout=subprocess.PIPE, text=True,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
        )  # fmt: skip
        threading.Thread(target=self._listen, args=(self._process, told, done), daemon=True).start()

    def reopened(self) -> tuple[GaussianScene, dict[str, Any]]:
        """The scene with the materials that are kept, in its file's frame, and what a stage is told of it.

        On the thread that draws, for it computes.
        """
        scan = Scan.open(self.file, **self.opened, materials="kept", key="")
        return scan.in_file, scan.about(self.ground)

    def close(self) -> None:
        """End what is under way."""
        if self._process is not None:
            self._process.terminate()
            self._process.wait()

    @staticmethod
    def _listen(process: subprocess.Popen[str], told: Told, done: Callable[[str], None]) -> None:
        why = "the search has ended without a word"
        with process:
            assert process.stdout is not None
            for line in process.stdout:
                try:
                    about, share = json.loads(line)
                except ValueError:  # what a library prints while it is imported
                    continue
                if share is None:
                    why = about
                else:
                    told(about, share)
        done(why)


def search(file: str, opened: dict[str, Any], variant: str, threads: int | None) -> None:
    """In the process: find, keep, and say how far it is; at last why nothing was found."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the window's, which ends this
    if hasattr(os, "nice"):
        os.nice(LEAST_PRIORITY)
    words = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what libraries print is no word of ours

    def say(about: str, share: float | None) -> None:
        print(json.dumps((about, share)), file=words, flush=True)

    def track(items: Iterable, label: str) -> Iterator:
        count, said = len(items) if isinstance(items, Sized) else 0, 0.0
        for number, item in enumerate(items):
            if time.monotonic() - said > SAID_SECONDS:
                say(label, number / count if count else 0.0)
                said = time.monotonic()
            yield item

    try:
        activate(variant, threads)
        scan = Scan.open(file, **opened, materials="auto", track=track, key="")
        why = ""
        if scan.scene.materials_guessed:
            why = "they cannot be told from this scan; the terminal says why"
        elif Scan.open(file, **opened, materials="kept", key="").scene.materials_guessed:
            why = "they cannot be kept, neither beside the scan nor in output_dir"
    except Exception as error:
        why = str(error) or type(error).__name__
    say(why, None)


if __name__ == "__main__":
    search(**json.loads(sys.argv[1]))
