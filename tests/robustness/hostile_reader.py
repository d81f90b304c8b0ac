"""Child process of test_hostile_files.py: reads files, and prints what each cost."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

from tron.errors import TronError


def _shard(path: Path) -> None:
    """Refused only if both ways of reading refuse it: clip after clip, and by number as training reads."""
    refusals = []
    for way in (_clip_after_clip, _by_number):
        try:
            way(path)
        except TronError as error:
            refusals.append(error)
    if len(refusals) == 2:
        raise refusals[0]


def _clip_after_clip(path: Path) -> None:
    from tron.shards.reader import read_clips

    for _ in read_clips(path, "train"):
        pass


def _by_number(path: Path) -> None:
    from tron.shards.clip_store import ClipStore

    clips = ClipStore(path, "train")
    for number in range(len(clips)):
        clips.read_frames(number)


def _picture(path: Path) -> None:
    from tron.io.images import read_image

    read_image(path)


def _surfels(path: Path) -> None:
    from tron.gaussians.scene import GaussianScene

    GaussianScene.load(path).validate()


def _capture(path: Path) -> None:
    from tron.captures import LoadSettings, load_capture

    for view in load_capture(path, LoadSettings()).views:
        view.read()


def _weights(path: Path) -> None:
    from tron.neural.weights import load_renderer

    load_renderer(path)


def _recipe(path: Path) -> None:
    from tron.run_folder import RunFolder

    RunFolder(path.parent, record=path.name).recipe()


READERS: dict[str, Callable[[Path], None]] = {
    "shard": _shard,
    "manifest": _shard,
    "picture": _picture,
    "surfels": _surfels,
    "capture": _capture,
    "weights": _weights,
    "recipe": _recipe,
}


def peak() -> int:
    """Greatest resident memory since it was last counted anew, kB."""
    text = Path("/proc/self/status").read_text()
    return int(text.split("VmHWM:")[1].split()[0])


def main(canary: str, files: list[str]) -> None:
    """Print a line of JSON for each KIND=PATH, after an @: libraries print as well."""
    for kind, _, name in (each.partition("=") for each in files):
        path = Path(name)
        os.chdir(path if path.is_dir() else path.parent)  # where a program in it would leave its mark
        Path("/proc/self/clear_refs").write_text("5")
        before, start = peak(), time.process_time()
        said = None
        try:
            READERS[kind](path)
        except TronError as error:
            said = str(error)
        except Exception as error:  # a reader that falls over has not refused
            said = f"not refused:\n{type(error).__name__}: {error}"
        seconds, grown = time.process_time() - start, (peak() - before) / 1024
        line = {"said": said, "seconds": seconds, "megabytes": grown, "executed": Path(canary).exists()}
        print(f"\n@{json.dumps(line)}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
