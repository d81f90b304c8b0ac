"""Files appear whole or not at all, folders are held by one process, and the disk is asked first."""

import errno
import hashlib
import os
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import pytest

from tron import storage
from tron.errors import TronError

HOLD = """
import sys, time
from tron.storage import locked
with locked(sys.argv[1]):
    print("held", flush=True)
    time.sleep(60)
"""
WRITE = """
import sys, time
from tron.storage import atomic_path
with atomic_path(sys.argv[1]) as path:
    path.write_bytes(b"half")
    print("writing", flush=True)
    time.sleep(60)
"""


def write_half_and_fail(path: Path) -> None:
    path.write_text("half")
    raise RuntimeError


def test_success_leaves_exactly_the_file(tmp_path: Path):
    with storage.atomic_path(tmp_path / "deep" / "a.txt") as temporary:
        assert temporary.suffix == ".txt"
        assert temporary.parent == tmp_path / "deep"  # the same disk, so that the rename is atomic
        temporary.write_text("whole")
        assert not (tmp_path / "deep" / "a.txt").exists()
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["a.txt"]
    assert (tmp_path / "deep" / "a.txt").read_text() == "whole"


def test_failure_leaves_the_old_file_and_nothing_else(tmp_path: Path):
    storage.write_atomic(tmp_path / "a.txt", "old")
    with pytest.raises(RuntimeError), storage.atomic_path(tmp_path / "a.txt") as temporary:
        write_half_and_fail(temporary)
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    assert (tmp_path / "a.txt").read_text() == "old"


def test_killed_writer_leaves_nothing_that_the_next_one_does_not_clear(tmp_path: Path):
    child = subprocess.Popen([sys.executable, "-c", WRITE, tmp_path / "a.bin"], stdout=subprocess.PIPE)
    assert child.stdout is not None
    child.stdout.readline()
    with pytest.raises(TronError, match="being written by another run"):
        storage.write_atomic(tmp_path / "a.bin", b"mine")
    child.kill()
    child.communicate()
    assert not (tmp_path / "a.bin").exists()
    storage.write_atomic(tmp_path / "a.bin", b"new")
    assert (tmp_path / "a.bin").read_bytes() == b"new"
    assert [path.name for path in tmp_path.iterdir()] == ["a.bin"]


def test_a_folder_appears_whole_and_replaces_the_old_one_whole(tmp_path: Path):
    for content in ("old", "new"):
        with storage.atomic_folder(tmp_path / "deep" / "a") as temporary:
            assert list(temporary.iterdir()) == []
            (temporary / f"{content}.txt").write_text(content)
            assert not (tmp_path / "deep" / "a" / f"{content}.txt").exists()
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["a"]
    assert [path.name for path in (tmp_path / "deep" / "a").iterdir()] == ["new.txt"]


def test_a_folder_that_fails_leaves_the_old_one_and_nothing_else(tmp_path: Path):
    with storage.atomic_folder(tmp_path / "a") as temporary:
        (temporary / "old.txt").write_text("old")
    with pytest.raises(RuntimeError), storage.atomic_folder(tmp_path / "a") as temporary:
        write_half_and_fail(temporary / "new.txt")
    assert [path.name for path in tmp_path.rglob("*")] == ["a", "old.txt"]


def test_a_folder_is_written_by_one_run_and_what_a_killed_one_left_is_emptied(tmp_path: Path):
    with (
        storage.atomic_folder(tmp_path / "a"),
        pytest.raises(TronError, match="being written by another run"),
        storage.atomic_folder(tmp_path / "a"),
    ):
        pass
    left = tmp_path / ".b.part"
    (left / "deep").mkdir(parents=True)
    with storage.atomic_folder(tmp_path / "b"):
        pass
    assert list((tmp_path / "b").iterdir()) == []


def test_on_a_file_system_without_locks_files_are_written_by_one_run_too(tmp_path: Path, monkeypatch):
    """Lustre mounted without `flock` answers ENOSYS: the lock's file itself is then the mark."""

    def missing(*_):
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))

    monkeypatch.setattr("fcntl.flock", missing)
    monkeypatch.setattr(warnings, "warn", lambda *_, **__: None)  # filelock tells of it
    with storage.atomic_folder(tmp_path / "a") as first:
        (first / "1.txt").write_text("1")
        with pytest.raises(TronError, match="another run"), storage.atomic_folder(tmp_path / "a"):
            pass
    storage.write_atomic(tmp_path / "b", "whole")
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["1.txt", "a", "b"]


def test_new_files_follow_the_umask(tmp_path: Path):
    old = os.umask(0o027)
    try:
        storage.write_atomic(tmp_path / "a", b"")
    finally:
        os.umask(old)
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o640


def test_unwritable_target_is_one_line(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(TronError, match=r"^cannot write: .*file"):
        storage.write_atomic(tmp_path / "file" / "below", "x")
    (tmp_path / "folder").mkdir()
    with pytest.raises(TronError, match="cannot write"):
        storage.write_atomic(tmp_path / "folder", "x")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
def test_full_disk_is_one_line(tmp_path: Path):
    with pytest.raises(TronError, match="No space left"), storage.atomic_path(tmp_path / "a"):
        Path("/dev/full").write_bytes(b"x")
    assert not list(tmp_path.iterdir())


def test_sha256_agrees_with_the_library_and_names_a_missing_file(tmp_path: Path):
    data = bytes(range(256)) * 5000
    storage.write_atomic(tmp_path / "a", data)
    assert storage.sha256(tmp_path / "a") == hashlib.sha256(data).hexdigest()
    with pytest.raises(TronError, match="cannot read"):
        storage.sha256(tmp_path / "missing")


def test_folder_is_held_by_one_process_and_freed_by_its_death(tmp_path: Path):
    child = subprocess.Popen([sys.executable, "-c", HOLD, tmp_path], stdout=subprocess.PIPE)
    assert child.stdout is not None
    try:
        assert child.stdout.readline() == b"held\n"
        with pytest.raises(TronError, match="in use by another run"), storage.locked(tmp_path):
            pass
    finally:
        child.send_signal(signal.SIGKILL)
        child.communicate()
    for _ in range(50):  # the operating system frees the lock as it buries the process
        try:
            with storage.locked(tmp_path):
                return
        except TronError:
            time.sleep(0.1)
    pytest.fail("the lock outlived its process")


def test_a_file_is_no_folder_to_lock(tmp_path: Path):
    (tmp_path / "file").write_text("mine")
    with (
        pytest.raises(TronError, match="a folder is wanted, and this is a file"),
        storage.locked(tmp_path / "file"),
    ):
        pass
    assert (tmp_path / "file").read_text() == "mine"


def test_lock_can_be_taken_again_after_use(tmp_path: Path):
    for _ in range(2):
        with storage.locked(tmp_path / "new"):
            pass


def test_free_space_is_checked_where_the_folder_will_be(tmp_path: Path):
    storage.require_free_space(tmp_path / "not" / "yet", 1)
    with pytest.raises(TronError, match="not enough disk space"):
        storage.require_free_space(tmp_path / "not" / "yet", 2**60)
