"""Peak memory of tracing a large scene, in a process of its own: `python -m eval.tracing.memory COUNT SIZE`.

The figure is the largest resident set of the whole process while it traces: Python, Mitsuba and LLVM, the
scene in NumPy, its records, lists, hierarchy and whatever the kernels need. On a GPU it is the host's part.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import resource
import subprocess
import sys
from pathlib import Path

from tron.errors import TronError

MEGABYTE = 1e6


def measure_memory(count: int, size: int, variant: str, seed: int) -> dict[str, float]:
    """Resident set in MB: ``base`` (libraries loaded), ``scene`` (surfels made), ``peak`` (while tracing).

    Beside them ``bounce``: what transport and bake of a light add to what is resident after a frame.

    Raises:
        TronError: the process failed.
    """
    command = [sys.executable, "-m", "eval.tracing.memory", str(count), str(size), variant, str(seed)]
    # Ours come first, whatever stands on the path of the user: another eval.py would be started instead.
    root = Path(__file__).resolve().parents[2]
    path = os.pathsep.join(filter(None, [str(root), os.environ.get("PYTHONPATH")]))
    environment = os.environ | {"PYTHONPATH": path}
    result = subprocess.run(command, capture_output=True, text=True, cwd=root, env=environment)
    if result.returncode != 0:
        raise TronError(f"measuring memory failed: {result.stderr.strip()[-500:]}", " ".join(command))
    return json.loads(result.stdout.splitlines()[-1])


def _resident() -> float:
    # On Linux, getrusage also remembers how large the process that started this one was.
    status = Path("/proc/self/status")
    if status.exists():
        line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) * 1024 / MEGABYTE
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / MEGABYTE * (1 if sys.platform == "darwin" else 1024)


def _forget() -> None:
    """Start the high-water mark again from what is resident now, where the system allows it."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def main(count: int, size: int, variant: str, seed: int) -> None:
    """Make the scene, trace a view, shadow rays from it and what bounces; print the peaks as JSON."""
    from tron.runtime import activate

    activate(variant)
    import drjit as dr

    from eval.peers.scene import camera, surfels
    from eval.tracing.lights import LIGHTS
    from eval.tracing.shadow_rays import random_rays
    from tron.shading.bounce import BounceTransport
    from tron.shading.lighting import Lighting
    from tron.tracing import SurfelTracer

    peaks = {"base": _resident()}
    scene = surfels(count, seed)
    gc.collect()
    _forget()
    peaks["scene"] = _resident()
    tracer = SurfelTracer(scene)
    gbuffer = tracer.gbuffer(camera(size))
    origin, direction = random_rays(gbuffer, scene.spacing, size * size, seed)
    dr.eval(tracer.transmittance(origin, direction))
    dr.sync_thread()
    peaks["peak"] = _resident()
    del gbuffer, origin, direction
    lighting = Lighting(LIGHTS["soft"]())
    gc.collect()
    dr.flush_malloc_cache()
    _forget()
    before = _resident()
    baked = BounceTransport.trace(tracer).bake(lighting)
    dr.eval(baked)
    dr.sync_thread()
    peaks["bounce"] = _resident() - before
    print(json.dumps(peaks))


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3], int(sys.argv[4]))
