"""Progress: sparse lines in a log, a bar on a terminal, the same numbers in both."""

import io
import logging
import math
import re
import sys
import time

import pytest

from tron.cli import progress as module
from tron.cli.progress import Progress, track, working


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def clock(monkeypatch) -> list[float]:
    """The time, which a test sets."""
    now = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    return now


def test_long_work_is_announced_and_has_ten_lines(caplog, clock):
    with caplog.at_level(logging.INFO):
        for _ in track(range(1000), "frames"):
            clock[0] += 0.03
    assert caplog.messages[:2] == ["frames: 0 of 1,000", "frames: 100 of 1,000, 0:27 left"]
    assert caplog.messages[-1] == "frames: 1,000 of 1,000"
    assert len(caplog.messages) == 11


def test_work_that_is_done_at_once_is_one_line(caplog):
    """Eight lines in one millisecond, each with a time left, were not news."""
    with caplog.at_level(logging.INFO):
        assert list(track(range(8), "rays of the surfels")) == list(range(8))
    assert caplog.messages == ["rays of the surfels: 0 of 8"]


def test_slow_work_is_heard_of_between_the_tenths_too(caplog, clock):
    with caplog.at_level(logging.INFO), Progress("train", 1000, start=100, unit="steps") as progress:
        for step in range(101, 150):
            clock[0] += 5
            progress.update(step, f"loss {step}")
    assert caplog.messages[:2] == ["train: 100 of 1,000 steps", "train: 101 of 1,000 steps, loss 101"]
    assert caplog.messages[2] == "train: 102 of 1,000 steps, loss 102, 74:50 left"  # 5 s for each of 898
    assert len(caplog.messages) == 50


def test_no_time_left_is_told_before_it_is_measured(caplog, clock):
    """The first frame waits for kernels: 250 s, then 5 s each."""
    with caplog.at_level(logging.INFO), Progress("guidance", 93) as progress:
        for frame in range(1, 94):
            clock[0] += 5 if frame > 1 else 250
            progress.update(frame)
    told = [line for line in caplog.messages if line.endswith(" left")]
    assert told[0] == "guidance: 14 of 93, 6:35 left"  # behind a quarter of 250 s
    for line in told:
        frame, minutes, seconds = map(int, re.findall(r"\d+(?= of|:| left)", line))
        assert 60 * minutes + seconds == 5 * (93 - frame)


def test_several_at_once_tell_no_time_left_before_the_second_round(caplog, clock):
    with caplog.at_level(logging.INFO), Progress("scenes", 8) as progress:
        for seconds in (60, 1, 1, 1, 57, 1, 1, 1):
            clock[0] += seconds
            progress.advance()
    assert next(line for line in caplog.messages if line.endswith(" left")).startswith("scenes: 5 of 8, 0:45")


def test_a_piece_that_takes_long_is_not_silent(caplog, monkeypatch):
    """Compiled kernels, baked light, a file that is read: nobody counts while they last."""
    monkeypatch.setattr(module, "SILENT_SECONDS", 0.6)
    with caplog.at_level(logging.INFO), Progress("frames", 3), working("light, baked"):
        time.sleep(1.4)
    assert caplog.messages[:2] == ["frames: 0 of 3", "light, baked"]
    assert set(caplog.messages[2:]) == {"light, baked: 0:01 so far"}, "the inner work alone speaks"


def test_hours_are_not_heard_of_every_five_seconds(caplog, clock):
    with caplog.at_level(logging.INFO), Progress("train", None) as progress:
        for step in range(1, 14401):
            clock[0] += 1
            progress.update(step)
    assert len(caplog.messages) < 50 + 50 * math.log(14400 / 250) + 10


def test_work_of_unknown_size_counts(caplog, clock):
    with caplog.at_level(logging.INFO):
        for _ in track(iter(range(5)), "files"):
            clock[0] += 21
    assert caplog.messages == ["files", *(f"files: {n}" for n in range(1, 6))]


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
