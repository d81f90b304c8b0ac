"""The account of what could not be made: a line of failures.jsonl each, and its traceback in a file."""

from __future__ import annotations

import json
import traceback
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from datagen.card import command_line
from datagen.plan import Quarantined, Work
from datagen.settings import Settings
from tron.errors import TronError
from tron.storage import write_if_changed

LIST_NAME = "failures.jsonl"
TRACEBACKS = "failures"
"""Folder of the tracebacks, beside the list."""


@dataclass(frozen=True)
class Failure:
    """The error that ended a task.

    Attributes:
        reason: one line.
        traceback: as Python prints it.
    """

    reason: str
    traceback: str

    @classmethod
    def of(cls, error: BaseException, lead: str = "") -> Failure:
        """The failure that an exception is; ``lead`` goes before its message."""
        text = str(error) if lead or isinstance(error, TronError) else f"{type(error).__name__}: {error}"
        return cls(" ".join(f"{lead}{text}".split()), "".join(traceback.format_exception(error)))


def record_failures(
    folder: Path,
    settings: Settings,
    items: Sequence[Work],
    failed: Mapping[str, Failure],
    finished: Mapping[str, Sequence[Quarantined]],
) -> int:
    """Write the list and the tracebacks of a folder; a scene made since leaves both.

    Args:
        folder: where the list lies.
        settings: of the run; a line's command repeats them.
        items: scenes to account for. One that neither failed now nor is finished keeps its line.
        failed: scenes that this run tried in vain, by name.
        finished: scenes that are there, by name, with the clips that were made and set aside.

    Returns:
        The number of failures, scenes and clips.
    """
    known = {line["scene"]: line for line in _read(folder / LIST_NAME)}
    lines: list[dict[str, Any]] = []
    for item in items:
        if item.name in finished:
            lines += [_line(settings, item, clip.reason, clip.key) for clip in finished[item.name]]
        elif item.name in failed:
            path = f"{TRACEBACKS}/{item.name}.txt"
            write_if_changed(folder / path, failed[item.name].traceback)
            lines.append(_line(settings, item, failed[item.name].reason, traceback=path))
        elif item.name in known:
            lines.append(known[item.name])
    kept = {line.get("traceback") for line in lines}
    for path in (folder / TRACEBACKS).glob("*.txt"):
        if path.relative_to(folder).as_posix() not in kept:
            path.unlink()
    with suppress(OSError):  # not there, or not empty
        (folder / TRACEBACKS).rmdir()
    if lines:
        write_if_changed(folder / LIST_NAME, "".join(json.dumps(line) + "\n" for line in lines))
    else:
        (folder / LIST_NAME).unlink(missing_ok=True)
    return len(lines)


def summary(count: int, folder: Path, logs: Path) -> str:
    """One line that says how many failures there are and where each can be looked into."""
    text = f"{count} failures, listed in {folder / LIST_NAME}"
    if (folder / TRACEBACKS).is_dir():
        text += f", tracebacks in {folder / TRACEBACKS}"
    return f"{text}, workers' logs in {logs}" if logs.is_dir() else text


def _line(
    settings: Settings, item: Work, reason: str, clip: str | None = None, traceback: str | None = None
) -> dict[str, Any]:
    """A scene, clip or capture with the command that tries it again."""
    return {
        "scene": item.name,
        **({"capture": item.capture} if item.capture else {}),
        "clip": clip,
        "split": item.split,
        "index": item.index,
        "seed": settings.seed,
        "reason": reason,
        "traceback": traceback,
        "command": command_line(settings, str(settings.output_dir), only=[item.name]),
    }


def _read(path: Path) -> list[dict[str, Any]]:
    try:
        return [json.loads(line) for line in path.read_text("utf-8").splitlines()]
    except (OSError, ValueError):
        return []
