"""Fixtures for every test: one torch thread, this machine's Mitsuba variants, the real data."""

import ctypes
import os
import sys
from pathlib import Path

import pytest

# Read by torch when it is first imported: sums depend on the thread count, tests must not.
os.environ["OMP_NUM_THREADS"] = "1"

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def has_cuda() -> bool:
    """Whether a CUDA driver with at least one device is present; asked of the driver, not of torch."""
    try:
        driver = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    count = ctypes.c_int(0)
    return driver.cuInit(0) == 0 and driver.cuDeviceGetCount(ctypes.byref(count)) == 0 and count.value > 0


def available_variants() -> list[str]:
    """Mitsuba variants that can run here: LLVM always (the set-up guarantees it), CUDA with a device."""
    return ["llvm_ad_rgb"] + (["cuda_ad_rgb"] if has_cuda() else [])


@pytest.fixture(scope="session", params=available_variants())
def variant(request: pytest.FixtureRequest) -> str:
    """The active Mitsuba variant. A test that touches Dr.Jit types asks for it."""
    from tron.runtime import activate

    activate(request.param)
    return request.param


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real assets, HDRIs and captures beside the repository."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"no real data: {SHARED_DATA} is absent")
    return SHARED_DATA


@pytest.fixture(autouse=True)
def drjit_threads() -> None:
    """Give Dr.Jit two threads or more before each test, whatever the last one set.

    Commands run with one thread to be reproducible; Mitsuba 3.9 reads and writes OpenEXR on Dr.Jit's worker
    threads, and where there are none it waits for ever.
    """
    if "drjit" in sys.modules:
        import drjit as dr

        threads = max(2, os.cpu_count() or 1)
        if dr.thread_count() != threads:
            dr.set_thread_count(threads)
