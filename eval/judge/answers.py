"""Stored answers, one JSON line each, appended as they arrive; answered questions are not asked again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from eval.judge.prompt import PROMPT, Answer
from eval.judge.schedule import Question
from tron.errors import TronError

LONGEST_TEXT = 400
"""Characters of a reply that are kept."""
LONGEST_LINE = 2**16


class Stored(BaseModel):
    """One line. ``answer`` is null if no reply of the judge was A, B or TIE."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    key: str = Field(pattern=r"^[0-9a-f]{64}$", description="hash of prompt, model, seed and both pictures")
    scene: str
    light: str
    view: int
    seed: int
    first: str
    second: str
    answer: Answer | None
    text: str = Field(description="the reply, shortened")
    model: str


def answer_key(model: str, question: Question, first: bytes, second: bytes) -> str:
    """Hash everything that the judge is sent: other pictures or another prompt make another question."""
    digest = hashlib.sha256()
    for part in (PROMPT.encode(), model.encode(), str(question.seed).encode(), first, second):
        digest.update(hashlib.sha256(part).digest())
    return digest.hexdigest()


class Answers:
    """Answers of a file by their keys; ``with answers.appending():`` appends new ones to it."""

    def __init__(self, path: Path):
        self.path = path
        self._found = {each.key: each for each in _read(path)} if path.is_file() else {}

    def __len__(self) -> int:
        return len(self._found)

    def get(self, key: str) -> Stored | None:
        """Return the answer to a question, None if it was not asked."""
        return self._found.get(key)

    @contextmanager
    def appending(self) -> Iterator[None]:
        """Append answers to the file while the block runs; an incomplete last line is removed first."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with open(self.path, "ab+") as self._file:
            _end_whole(self.path)
            yield

    def add(self, stored: Stored) -> None:
        """Keep an answer, and write it to disk at once."""
        self._file.write((stored.model_dump_json() + "\n").encode())
        self._file.flush()
        self._found[stored.key] = stored


def _end_whole(path: Path) -> None:
    """Remove a last line without a line end, left by a process that was killed while writing."""
    with open(path, "rb+") as file:
        content = file.read()
        file.truncate(content.rfind(b"\n") + 1)


def _read(path: Path) -> Iterator[Stored]:
    """Read the complete lines of a file; TronError names a line that is no answer."""
    with open(path, "rb") as file:
        for number, line in enumerate(iter(lambda: file.readline(LONGEST_LINE), b""), 1):
            if not line.endswith(b"\n"):
                if len(line) < LONGEST_LINE:
                    return  # cut off as it was written
                raise TronError(f"line {number} is too long to be an answer", path, "choose another file")
            try:
                yield Stored.model_validate(json.loads(line))
            except (ValidationError, ValueError, RecursionError) as error:
                mend = "delete the line, and it is asked again"
                raise TronError(f"line {number} is not an answer of a judge", path, mend) from error
