"""Progress: sparse lines in a log, a bar on a terminal, the same numbers in both."""

import io
import logging
import sys

import pytest

from tron.cli import progress as module
from tron.cli.progress import Progress, track


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def clock(monkeypatch) -> list[float]:
    """The time, which a test sets."""
    now = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    return now


def test_long_work_is_ten_lines(caplog):
    with caplog.at_level(logging.INFO):
        assert list(track(range(1000), "frames")) == list(range(1000))
    assert len(caplog.messages) == 10
    assert caplog.messages[0].startswith("frames: 100 of 1,000, 0:")
    assert caplog.messages[-1] == "frames: 1,000 of 1,000, 0:00 left"


def test_slow_work_is_heard_of_between_the_tenths_too(caplog, clock):
    with caplog.at_level(logging.INFO), Progress("train", 1000, start=100, unit="steps") as progress:
        for step in range(101, 150):
            clock[0] += 5
            progress.update(step, f"loss {step}")
    assert caplog.messages[0] == "train: 105 of 1,000 steps, loss 105, 74:35 left"  # 5 s for each of 895
    assert len(caplog.messages) == 9  # every 25 s


def test_work_of_unknown_size_counts(caplog, clock):
    with caplog.at_level(logging.INFO):
        for _ in track(iter(range(5)), "files"):
            clock[0] += 21
    assert caplog.messages == [f"files: {n}" for n in range(1, 6)]


def test_a_terminal_gets_a_bar_and_no_lines(monkeypatch, caplog):
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setenv("TERM", "xterm")
    with caplog.at_level(logging.INFO), Progress("scenes", 40, unit="clips") as progress:
        progress.advance(30, "train-000001")
        progress.advance(2, "train-000002")
    assert caplog.messages == []
    for text in ("scenes", "32 of 40 clips, train-000002", "━"):
        assert text in screen.getvalue()
