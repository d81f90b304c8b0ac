"""The machine is found, described and refused in one line."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tron import runtime
from tron.errors import TronError
from tron.runtime import ALIGNMENT, aligned, lanes


@pytest.fixture
def no_llvm_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)


def offer(monkeypatch: pytest.MonkeyPatch, folder: Path, *names: str) -> None:
    """Let the search see these (empty) libraries only."""
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    monkeypatch.setattr(runtime, "_llvm_candidates", lambda: [folder / name for name in names])


def test_found_llvm_exists_and_is_new_enough(no_llvm_path: None):
    path = runtime.find_llvm()
    version = runtime.llvm_version(path)
    assert path.is_file()
    assert version is not None
    assert version[0] >= runtime.MINIMUM_LLVM


@pytest.mark.parametrize(
    "name, version",
    [
        ("libLLVM-14.so.1", (14,)),
        ("libLLVM.so.19.1", (19, 1)),
        ("libLLVM-20.dylib", (20,)),
        ("libLLVM-17.0.6.so", (17, 0, 6)),
        ("llvm@19/lib/libLLVM.dylib", (19,)),  # Homebrew
        ("llvm/18.1.8/lib/libLLVM.dylib", (18, 1, 8)),
        ("llvm-17/lib/libLLVM.so", (17,)),  # Debian's own folder
        ("libLLVM.so", None),  # empty: nothing to ask
        ("libsomething.so", None),
    ],
)
def test_version_is_read_from_the_names_systems_give(tmp_path: Path, name: str, version: tuple | None):
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).touch()
    assert runtime.llvm_version(tmp_path / name) == version


def test_version_without_a_telling_name_is_asked_of_the_library(no_llvm_path: None, tmp_path: Path):
    real = runtime.find_llvm().resolve()
    copy = tmp_path / "lib.so"
    try:
        os.link(real, copy)
    except OSError:
        pytest.skip("the library cannot be linked to under another name here")
    asked, named = runtime.llvm_version(copy), runtime.llvm_version(real)
    assert asked is not None
    assert named is not None
    assert asked[: len(named)] == named


def test_newest_is_taken_unless_the_tested_one_is_there(
    no_llvm_path: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    offer(monkeypatch, tmp_path, "libLLVM-15.so", "libLLVM.so.18.1", "libLLVM.so.21.1")
    assert runtime.find_llvm().name == "libLLVM.so.21.1"
    offer(monkeypatch, tmp_path, "libLLVM-15.so", "libLLVM.so.19.1", "libLLVM.so.21.1")
    assert runtime.find_llvm().name == "libLLVM.so.19.1"


@pytest.mark.parametrize("names, found", [((), ""), (("libLLVM-14.so.1", "libLLVM-15.so.1"), "only 14, 15")])
def test_missing_llvm_says_what_to_install(
    no_llvm_path: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, names: tuple, found: str
):
    offer(monkeypatch, tmp_path, *names)
    with pytest.raises(TronError) as caught:
        runtime.find_llvm()
    message = str(caught.value)
    assert "LLVM 17 or newer not found" in message
    assert found in message
    assert re.search(r"apt-get install libllvm19|brew install llvm@19", message)
    assert "\n" not in message


def test_users_own_llvm_is_taken_or_refused_never_replaced(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    (tmp_path / "libLLVM-18.so").touch()
    (tmp_path / "libLLVM-15.so").touch()
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "libLLVM-18.so"))
    assert runtime.find_llvm() == tmp_path / "libLLVM-18.so"
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "libLLVM-15.so"))
    with pytest.raises(TronError, match=r"LLVM 15, but 17 or newer.*libLLVM-15"):
        runtime.find_llvm()
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "absent.so"))
    with pytest.raises(TronError, match="no LLVM library"):
        runtime.find_llvm()


def in_new_process(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)


def test_activation_sets_variant_and_threads_and_can_be_repeated():
    done = in_new_process(
        "from tron.runtime import activate\nactivate('llvm_ad_rgb', threads=1)\nactivate()\n"
        "import drjit as dr, mitsuba as mi\n"
        "print(mi.variant(), dr.thread_count(), dr.sum(mi.Float(1, 2))[0], dr.minimum(mi.Float(3), 2)[0])"
    )
    assert done.stdout.split() == ["llvm_ad_rgb", "1", "3.0", "2.0"], done.stderr


def test_cuda_without_a_gpu_is_one_line():
    if runtime.describe_machine()["gpu"] != "none":
        pytest.skip("this machine has an NVIDIA GPU")
    done = in_new_process(
        "from tron.errors import TronError\nfrom tron.runtime import activate\n"
        "try:\n    activate('cuda_ad_rgb')\nexcept TronError as error:\n    print(error)"
    )
    assert done.stdout.count("\n") == 1, done.stderr
    assert "NVIDIA GPU" in done.stdout
    assert done.stderr == ""


def test_wrong_variant_and_thread_count_are_one_line(variant: str):
    with pytest.raises(TronError, match=r"unknown Mitsuba variant 'lvm_ad_rgb': choose one of .*llvm_ad_rgb"):
        runtime.activate("lvm_ad_rgb")
    with pytest.raises(TronError, match="at least 1"):
        runtime.activate(variant, threads=0)


def test_torch_threads_are_set():
    import torch

    before = torch.get_num_threads()
    runtime.set_torch_threads(1)
    assert torch.get_num_threads() == 1
    torch.set_num_threads(before)


def test_machine_is_described_in_plain_values(variant: str):
    machine = runtime.describe_machine()
    assert json.loads(json.dumps(machine)) == machine
    assert machine["cpu"]
    assert 1 <= machine["cores"] <= (os.cpu_count() or 1)
    assert machine["memory_gb"] > 0.5
    assert machine["python"].startswith(f"{sys.version_info.major}.{sys.version_info.minor}")
    assert machine["packages"]["mitsuba"].startswith("3.")
    assert machine["variant"] == variant
    assert int(machine["llvm"].split(".")[0]) >= runtime.MINIMUM_LLVM


def test_description_loads_neither_mitsuba_nor_torch():
    done = in_new_process(
        "import sys\nfrom tron.runtime import describe_machine\n"
        "assert describe_machine()['variant'] == 'none'\n"
        "print('mitsuba' in sys.modules, 'torch' in sys.modules)"
    )
    assert done.stdout.split() == ["False", "False"], done.stderr


def test_commit_is_gits_own_and_dirt_is_seen(tmp_path: Path):
    def git(*words: str) -> str:
        identity = ["-c", "user.name=t", "-c", "user.email=t@t"]
        done = subprocess.run(
            ["git", *identity, *words], cwd=tmp_path, capture_output=True, text=True, check=True
        )
        return done.stdout.strip()

    assert runtime._git_state(tmp_path) == {"commit": None, "dirty": None}
    git("init", "-q")
    (tmp_path / "a").write_text("a")
    git("add", "a")
    git("commit", "-q", "-m", "a")
    assert runtime._git_state(tmp_path) == {"commit": git("rev-parse", "HEAD"), "dirty": False}
    (tmp_path / "a").write_text("b")
    assert runtime._git_state(tmp_path)["dirty"] is True


def test_memory_is_aligned_wherever_it_began():
    room = np.arange(100, dtype=np.float32)
    for start in range(20):
        part = room[start : start + 70].reshape(7, 10)
        moved = aligned(part)
        assert moved.ctypes.data % ALIGNMENT == 0
        np.testing.assert_array_equal(moved, part)
    strided = aligned(room.reshape(10, 10)[:, 3])
    assert strided.flags.c_contiguous
    np.testing.assert_array_equal(strided, room[3::10])


@pytest.mark.parametrize("count", [5, 16, 1021])
def test_borrowed_arrays_may_be_read_a_packet_past_their_end(count):
    """Dr.Jit does so, and would end the process where nothing lies behind; what begins well is copied too."""
    array = aligned(aligned(np.arange(count, dtype=np.float32)))
    memory = array
    while isinstance(memory.base, np.ndarray):
        memory = memory.base
    assert memory.ctypes.data + memory.nbytes - (array.ctypes.data + array.nbytes) >= ALIGNMENT


def test_rows_become_lanes(variant):
    import mitsuba as mi

    rows = np.arange(12.0).reshape(4, 3)[::2]
    np.testing.assert_array_equal(np.array(lanes(mi.Vector3f, rows)).T, rows)


WIDTH = """
from tron.runtime import activate
activate()
import drjit as dr, mitsuba as mi
with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
    dr.eval(dr.arange(mi.Float, 99) * 3)
    print(dr.kernel_history()[-1]["ir"].getvalue())
"""


@pytest.mark.parametrize("width", [4, 8, 16])
def test_kernels_are_as_wide_as_they_are_asked_to_be(width: int):
    environment = {**os.environ, "TRON_LLVM_WIDTH": str(width)}
    command = [sys.executable, "-c", WIDTH]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert set(re.findall(r"<(\d+) x float>", done.stdout)) == {str(width)}


def test_a_width_that_no_processor_has_is_refused():
    command = [sys.executable, "-c", "from tron.runtime import activate; activate()"]
    done = subprocess.run(command, env={**os.environ, "TRON_LLVM_WIDTH": "7"}, capture_output=True, text=True)
    assert "TRON_LLVM_WIDTH must be 4, 8 or 16, not '7'" in done.stderr.strip().splitlines()[-1]
