"""The machine under TRON: finding LLVM, choosing the Mitsuba variant, setting threads, describing it all.

Entry points and test fixtures call :func:`activate` once, before anything touches ``mi.Float``.
"""

from __future__ import annotations

import ctypes
import glob
import importlib.metadata
import os
import platform
import re
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from pydantic import Field

from tron.errors import TronError

if TYPE_CHECKING:
    import numpy as np

Variant = Annotated[
    Literal["llvm_ad_rgb", "cuda_ad_rgb"], Field(description="Mitsuba variant: processor or NVIDIA GPU")
]
Threads = Annotated[int | None, Field(ge=1, description="threads of the renderer; null: all")]

MINIMUM_LLVM = 17
"""Below it a kernel with min or max aborts the whole process ("Cannot select: fminimum")."""

keep_kernel_history = False
"""Whether :func:`activate` lets Dr.Jit take note of each kernel it starts, for `--profile`."""

_TESTED_LLVM = 19
_STACK = ("tron", "mitsuba", "drjit", "numpy", "scipy", "torch", "diffusers", "lightning", "OpenEXR", "av")
_LLVM_FOLDERS = (
    "/usr/lib/*-linux-gnu",  # Debian, Ubuntu
    "/usr/lib/llvm-*/lib",
    "/usr/lib64",  # Fedora, openSUSE
    "/usr/lib64/llvm*/lib*",
    "/usr/lib",  # Arch
    "/usr/local/lib",
    "/opt/homebrew/opt/llvm*/lib",
    "/usr/local/opt/llvm*/lib",
)
_LLVM_NAMES = {"darwin": ("libLLVM.dylib", "libLLVM-[0-9]*.dylib"), "win32": ("LLVM-C.dll",)}
T = TypeVar("T")
ALIGNMENT = 64
"""Bytes of the widest packet: 16 numbers of 32 bits."""


def find_llvm() -> Path:
    """Return the LLVM library that Dr.Jit should load: version 17 or newer, 19 where there is a choice.

    ``DRJIT_LIBLLVM_PATH`` is taken at its word; otherwise the active conda environment, the loader's cache
    and the usual folders of Debian, Fedora, Arch and Homebrew are searched.

    Raises:
        TronError: nothing suitable was found, or DRJIT_LIBLLVM_PATH names something else; it says what to
            install.
    """
    chosen = os.environ.get("DRJIT_LIBLLVM_PATH")
    if chosen:
        version = llvm_version(Path(chosen))
        if version is None or version[0] < MINIMUM_LLVM:
            found = "no LLVM library" if version is None else f"LLVM {version[0]}"
            raise TronError(
                f"DRJIT_LIBLLVM_PATH names {found}, but {MINIMUM_LLVM} or newer is needed",
                chosen,
                "unset it, or point it at libLLVM of version 17 or newer",
            )
        return Path(chosen)
    versions = {path: llvm_version(path) for path in _llvm_candidates()}
    usable = {path: v for path, v in versions.items() if v is not None and v[0] >= MINIMUM_LLVM}
    if not usable:
        others = sorted({v[0] for v in versions.values() if v is not None})
        raise TronError(
            f"LLVM {MINIMUM_LLVM} or newer not found"
            + (f", only {', '.join(map(str, others))}" if others else ""),
            mend=_llvm_remedy(),
        )
    return max(usable, key=lambda path: (usable[path][0] == _TESTED_LLVM, usable[path]))


def llvm_version(path: Path) -> tuple[int, ...] | None:
    """Version of an LLVM library, read from its name or else asked of the library; None if it has none."""
    if not path.is_file():
        return None
    # libLLVM-17.so, libLLVM.so.19.1, llvm@19/lib/libLLVM.dylib, Cellar/llvm/18.1.8/lib/libLLVM.dylib
    for name in (path.name, path.resolve().name, str(path.resolve().parent)):
        found = re.findall(r"llvm(?:[-@/]|\.so\.)(\d+(?:\.\d+)*)", name, re.IGNORECASE)
        if found:
            return tuple(int(part) for part in found[-1].split("."))
    try:
        numbers = [ctypes.c_uint() for _ in range(3)]
        ctypes.CDLL(str(path)).LLVMGetVersion(*map(ctypes.byref, numbers))  # exists since LLVM 16
    except (OSError, AttributeError):
        return None
    return tuple(number.value for number in numbers)


def _llvm_candidates() -> list[Path]:
    folders = [
        os.path.join(sys.prefix, "lib"),
        os.path.join(os.environ.get("CONDA_PREFIX", sys.prefix), "lib"),
    ]
    cache = (
        _output(["ldconfig", "-p"]) or _output(["/sbin/ldconfig", "-p"]) or ""
    )  # users' PATH may lack /sbin
    folders += sorted({os.path.dirname(path) for path in re.findall(r"=> (\S*libLLVM\S*)", cache)})
    folders += _LLVM_FOLDERS
    if sys.platform == "win32":
        folders += [*os.environ.get("PATH", "").split(os.pathsep), r"C:\Program Files\LLVM\bin"]
    names = _LLVM_NAMES.get(sys.platform, ("libLLVM*.so*",))
    found = (glob.glob(os.path.join(folder, name)) for folder in folders for name in names)
    return [Path(path) for path in dict.fromkeys(path for paths in found for path in sorted(paths))]


def _llvm_remedy() -> str:
    if sys.platform == "darwin":
        return "run `brew install llvm@19`, or set DRJIT_LIBLLVM_PATH to libLLVM.dylib"
    if sys.platform == "win32":
        return "run `winget install LLVM.LLVM`, or set DRJIT_LIBLLVM_PATH to LLVM-C.dll"
    return (
        "install it with `apt-get install libllvm19` (Debian, Ubuntu), `dnf install llvm-libs` (Fedora) or "
        "`conda install -c conda-forge libllvm19`, or set DRJIT_LIBLLVM_PATH to libLLVM.so"
    )


def activate(variant: str = "llvm_ad_rgb", threads: int | None = None) -> None:
    """Set the Mitsuba variant of this process and, if given, Dr.Jit's number of threads; safe to repeat.

    Args:
        variant: ``llvm_ad_rgb``, ``cuda_ad_rgb`` or another that this Mitsuba build has.
        threads: worker threads of Dr.Jit's LLVM backend; 1 makes sums reproducible bit by bit.

    Raises:
        TronError: an unknown variant, LLVM missing or too old, or no usable CUDA device.
    """
    if variant.startswith("llvm"):
        os.environ["DRJIT_LIBLLVM_PATH"] = str(find_llvm())  # read by Dr.Jit when its LLVM backend starts
    import drjit as dr
    import mitsuba as mi

    if variant not in mi.variants():
        raise TronError(
            f"unknown Mitsuba variant {variant!r}", mend=f"choose one of {', '.join(mi.variants())}"
        )
    if threads is not None:
        if threads < 1:
            raise TronError(f"number of threads must be at least 1, not {threads}")
        dr.set_thread_count(threads)
    if keep_kernel_history:
        dr.set_flag(dr.JitFlag.KernelHistory, True)
    if mi.variant() == variant:
        return
    try:
        mi.set_variant(variant)
    except ImportError as error:
        if variant.startswith("cuda"):
            raise TronError(
                f"variant {variant} needs an NVIDIA GPU, and Dr.Jit found none it can use",
                mend="use llvm_ad_rgb, or install a current NVIDIA driver",
            ) from error
        raise TronError(f"variant {variant} does not start: {error}") from error
    loaded = dr.detail.llvm_version() if variant.startswith("llvm") else None
    if loaded is not None and loaded[0] < MINIMUM_LLVM:
        raise TronError(
            f"Dr.Jit has loaded LLVM {loaded[0]} already, {MINIMUM_LLVM} or newer is needed",
            mend="call tron.runtime.activate before any other use of Dr.Jit",
        )
    if loaded is not None and (width := os.environ.get("TRON_LLVM_WIDTH")):
        _set_llvm_width(width)


def _set_llvm_width(width: str) -> None:
    """Let LLVM's kernels take ``width`` lanes at once, as on another processor: sums round as they do there.

    Dr.Jit takes 16 lanes with AVX-512, 8 with AVX and 4 elsewhere, and its Python part cannot change that.
    """
    import drjit as dr

    if width not in ("4", "8", "16"):  # Embree knows no others
        raise TronError(f"TRON_LLVM_WIDTH must be 4, 8 or 16, not {width!r}")
    core = ctypes.CDLL(next(map(str, Path(dr.__file__).parent.glob("libdrjit-core.*"))))
    strings = core["_Z19jit_llvm_target_cpuv"], core["_Z24jit_llvm_target_featuresv"]
    for string in strings:
        string.restype = ctypes.c_char_p
    set_target = core["_Z19jit_llvm_set_targetPKcS0_j"]
    set_target.argtypes, set_target.restype = (ctypes.c_char_p, ctypes.c_char_p, ctypes.c_uint), None
    set_target(*(string() for string in strings), int(width))


def set_torch_threads(n: int) -> None:
    """Let torch use ``n`` threads within an operation; 1 makes sums reproducible bit by bit."""
    import torch

    torch.set_num_threads(n)


def torch_device() -> str:
    """The torch device that the active Mitsuba variant shares its arrays with: "cuda" or "cpu"."""
    mitsuba = sys.modules.get("mitsuba")
    return "cuda" if mitsuba and (mitsuba.variant() or "").startswith("cuda") else "cpu"


def describe_machine() -> dict[str, Any]:
    """Describe hardware, software and commit, as plain values for reports and manifests of measurements.

    Neither Mitsuba nor torch is loaded for it. Keys: ``cpu``, ``cores`` (those this process may use),
    ``memory_gb``, ``gpu`` (names, or "none"), ``os``, ``python``, ``packages`` (name -> version, installed
    ones), ``llvm`` (version or "none"), ``variant`` (the active one or "none"), ``commit`` and ``dirty``
    (both None outside a checkout).
    """
    mitsuba = sys.modules.get("mitsuba")
    return {
        "cpu": _cpu_model(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "memory_gb": _memory_gb(),
        "gpu": (_output(["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"]) or "none").replace(
            "\n", ", "
        ),
        "os": platform.platform(),
        "python": platform.python_version(),
        "packages": _package_versions(),
        "llvm": _llvm_in_use(),
        "variant": (mitsuba.variant() if mitsuba else None) or "none",
        **_git_state(Path(__file__).resolve().parent.parent),
    }


def _memory_gb() -> float | None:
    if not hasattr(os, "sysconf"):  # Windows
        return None
    return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1)


def _cpu_model() -> str:
    if sys.platform == "darwin":
        return _output(["sysctl", "-n", "machdep.cpu.brand_string"]) or platform.machine()
    try:
        match = re.search(r"model name\s*:\s*(.+)", Path("/proc/cpuinfo").read_text())
    except OSError:
        match = None
    return match[1].strip() if match else platform.machine()


def _package_versions() -> dict[str, str]:
    versions = {}
    for name in _STACK:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return versions


def _llvm_in_use() -> str:
    try:
        version = llvm_version(find_llvm())
    except TronError:
        return "none"
    return ".".join(map(str, version or ()))


def _git_state(root: Path) -> dict[str, Any]:
    if not (root / ".git").exists():
        return {"commit": None, "dirty": None}
    commit = _output(["git", "-C", str(root), "rev-parse", "HEAD"])
    status = _output(["git", "-C", str(root), "status", "--porcelain"])
    return {"commit": commit or None, "dirty": None if status is None else bool(status)}


def _output(command: list[str]) -> str | None:
    """Stripped output of a short command; None if it is missing, fails or takes over ten seconds."""
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=10, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None


def aligned(array: np.ndarray) -> np.ndarray:
    """A contiguous copy at a multiple of ``ALIGNMENT`` bytes, with as many to spare behind its end.

    Dr.Jit borrows the memory of a NumPy array. It reads whole packets, past the end of the last one too:
    where the array ends with its page and the next page is nobody's, that ends the process with a
    segmentation fault, once in some hundred runs. It also writes the alignment into the kernels that read
    the array: loads of whole packets where it begins at a multiple of 64 bytes, else loads byte by byte, and
    gathers of four numbers one by one. NumPy's memory begins at any multiple of 16, by chance, so the same
    call would now and then compile another and slower kernel.
    """
    import numpy as np

    array = np.ascontiguousarray(array)
    memory = np.empty(array.nbytes + 2 * ALIGNMENT, np.uint8)
    first = -memory.ctypes.data % ALIGNMENT
    copy = memory[first : first + array.nbytes].view(array.dtype).reshape(array.shape)
    copy[...] = array
    return copy


def lanes(kind: type[T], rows: np.ndarray) -> T:
    """Rows (N, C), float32, on the device: a Dr.Jit vector ``kind``, such as mi.Point3f, of N lanes."""
    import drjit as dr
    import numpy as np

    number = dr.value_t(kind)
    return kind(*(number(aligned(column.astype(np.float32))) for column in rows.T))
