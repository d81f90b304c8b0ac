"""Profile of a command: in Python by cProfile, in kernels by Dr.Jit's own history."""

from __future__ import annotations

import cProfile
import json
import pstats
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tron import runtime
from tron.errors import TronError
from tron.storage import atomic_path, write_atomic

SHOWN_FUNCTIONS = 15
KEPT_KERNELS = 20


@contextmanager
def profiled(folder: Path, name: str) -> Iterator[None]:
    """Profile the block, whether it succeeds or not.

    Writes folder/NAME.prof (for snakeviz, pstats) and, where Dr.Jit was used, folder/NAME.kernels.json; shows
    the functions that took longest, and the sums of the kernels, on stderr. It sees the main thread of this
    process. Dr.Jit's history holds the code of every kernel that was started: long runs need memory for it.

    The block's own error always goes on. A run that was refused leaves no folder behind: after a TronError,
    the profile is written only where the folder above is there.

    Args:
        folder: made if missing.
        name: of the command, which the files are called after.

    Raises:
        TronError: the block succeeded, and its profile cannot be written.
    """
    profile = cProfile.Profile()
    runtime.keep_kernel_history = True
    profile.enable()
    try:
        yield
    except BaseException as error:
        kernels = _stop(profile)
        if not isinstance(error, TronError) or folder.parent.is_dir():
            try:
                _write(folder, name, profile, kernels)
            except TronError as second:
                print(f"profile: {second}", file=sys.stderr)
        raise
    _write(folder, name, profile, _stop(profile))


def _stop(profile: cProfile.Profile) -> dict[str, Any] | None:
    """End the profile and Dr.Jit's history; the summary of the latter, None where Dr.Jit was not used."""
    profile.disable()
    runtime.keep_kernel_history = False
    return _kernels()


def _write(folder: Path, name: str, profile: cProfile.Profile, kernels: dict[str, Any] | None) -> None:
    """Show a profile on stderr and write it; TronError where that cannot be."""
    pstats.Stats(profile, stream=sys.stderr).strip_dirs().sort_stats("tottime").print_stats(SHOWN_FUNCTIONS)
    if kernels is not None:
        said = (f"{key.replace('_', ' ')} {value}" for key, value in kernels.items() if key != "slowest")
        print(f"Dr.Jit: {', '.join(said)}", file=sys.stderr)
    path = folder / f"{name}.prof"
    with atomic_path(path) as temporary:
        profile.dump_stats(temporary)
    if kernels is not None:
        write_atomic(folder / f"{name}.kernels.json", json.dumps(kernels, indent=1) + "\n")
    print(f"profile: {path}", file=sys.stderr)


def summarize(history: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Sums over Dr.Jit's kernel history; its times are milliseconds, here they are seconds.

    A kernel is compiled once and started often; `compile_seconds` are code generation and the backend, and
    `slowest` are the kernels whose launches took longest together.
    """
    launches: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for entry in history:
        launches[str(entry.get("hash", entry["type"]))].append(entry)
    kernels = [
        {
            "hash": key,
            "launches": len(entries),
            "operations": entries[0].get("operation_count"),
            "largest_size": max(entry["size"] for entry in entries),
            "execution_seconds": _seconds(entries, "execution_time"),
        }
        for key, entries in launches.items()
    ]
    kernels.sort(key=lambda kernel: kernel["execution_seconds"], reverse=True)
    return {
        "launches": len(history),
        "kernels": len({entry["hash"] for entry in history if "hash" in entry}),
        "cache_hits": sum(bool(entry.get("cache_hit")) for entry in history),
        "disk_cache_hits": sum(bool(entry.get("cache_disk")) for entry in history),
        "compile_seconds": round(_seconds(history, "codegen_time") + _seconds(history, "backend_time"), 3),
        "execution_seconds": _seconds(history, "execution_time"),
        "slowest": kernels[:KEPT_KERNELS],
    }


def _kernels() -> dict[str, Any] | None:
    """The summary of what Dr.Jit did in this process; None where it was never imported."""
    dr = sys.modules.get("drjit")
    if dr is None:
        return None
    history = dr.kernel_history()
    dr.set_flag(dr.JitFlag.KernelHistory, False)
    return summarize(history)


def _seconds(entries: Sequence[dict[str, Any]], name: str) -> float:
    return round(sum(entry.get(name) or 0.0 for entry in entries) / 1000, 3)
