"""Blender as a reference: it reads and renders our files in a separate process.

It has its own Python (:mod:`eval.renderers.blender_process`); a job file and EXR files are exchanged.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tron.cameras import Camera, opencv_to_opengl
from tron.errors import TronError
from tron.io.images import write_image
from tron.shading.environments.environment import EnvironmentMap

LAYER, BASE_COLOR = "ViewLayer", "base_color"
INSTALL = (
    "python3.11 -m venv FOLDER; FOLDER/bin/pip install 'bpy<5'; benchmark.blender_python=FOLDER/bin/python"
)
_PATIENCE = 3600
"""Seconds that a job may take."""


class Seen(NamedTuple):
    """A view by Cycles; uncovered pixels are 0.

    Attributes:
        lit: (H, W, 3) linear radiance.
        normal: (H, W, 3) means of unit shading normals, world.
        base_color: (H, W, 3) linear.
        opacity: (H, W).
    """

    lit: np.ndarray
    normal: np.ndarray
    base_color: np.ndarray
    opacity: np.ndarray


def blender_version(python: Path) -> str:
    """Return the version of Blender in a Python.

    Raises:
        TronError: there is no such Python, or it has no Blender.
    """
    words = [str(python), "-I", "-c", "import bpy; print('blender', bpy.app.version_string)"]
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=120, stdin=subprocess.DEVNULL)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise TronError(f"cannot be run: {error}", python, INSTALL) from error
    said = [line for line in done.stdout.splitlines() if line.startswith("blender ")]
    if done.returncode or not said:
        raise TronError("this Python has no Blender (bpy)", python, INSTALL)
    return said[-1].removeprefix("blender ")


def rendered(
    python: Path,
    model: Path,
    cameras: Sequence[Camera],
    lights: Sequence[EnvironmentMap],
    folder: Path,
    *,
    samples: int,
    bounces: int,
    threads: int,
    seed: int,
) -> list[list[Seen]]:
    """Render a glTF by Cycles with Blender's importer; return each light's views.

    Args:
        python: Python with ``bpy``.
        model: the file; Blender imports it z up.
        cameras: cameras with square pixels and a central principal point.
        lights: around the model.
        folder: folder of the job and its frames.
        samples: samples per pixel.
        bounces: bounces of light between surfaces.
        threads: threads of Cycles.
        seed: seed of Cycles.

    Raises:
        TronError: Blender failed; the error has its last output.
    """
    folder.mkdir(parents=True, exist_ok=True)
    maps = [folder / f"light{number}.exr" for number in range(len(lights))]
    for path, light in zip(maps, lights):
        write_image(path, lat_long(light), half=False)
    job = folder / "job.json"
    told = {
        "model": str(model.absolute()), "lights": [str(path.absolute()) for path in maps],
        "cameras": [_told(camera) for camera in cameras], "layer": LAYER, "base_color": BASE_COLOR,
        "samples": samples, "bounces": bounces, "threads": threads, "seed": seed % 2**31,
    }  # fmt: skip
    job.write_text(json.dumps(told))
    script = Path(__file__).with_name("blender_process.py")
    words = [str(python), "-I", str(script), str(job.absolute())]
    try:
        done = subprocess.run(
            words,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=_PATIENCE,
            stdin=subprocess.DEVNULL,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise TronError(f"cannot be run: {error}", python, INSTALL) from error
    frames = [[folder / f"{n}_{k}.exr" for k in range(len(cameras))] for n in range(len(lights))]
    if done.returncode or not all(path.is_file() for paths in frames for path in paths):
        said = (done.stderr.strip() or done.stdout.strip()).splitlines()
        raise TronError(f"Blender cannot render it: {said[-1] if said else 'without a word'}", model)
    return [[_read(path) for path in paths] for paths in frames]


def lat_long(light: EnvironmentMap) -> np.ndarray:
    """Bake a light to (H, 2H, 3) in Blender's convention.

    Its middle column looks along +x, azimuth falls to the right, and rows are centred on half texels
    (``direction_to_equirectangular`` of Cycles).
    """
    height = light.image.shape[0]
    azimuth = 2 * np.pi * (0.5 - (np.arange(2 * height) + 0.5) / (2 * height))
    polar = np.pi * (np.arange(height)[:, None] + 0.5) / height
    x, y = np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth)
    return light.lookup(np.stack([x, y, np.broadcast_to(np.cos(polar), x.shape)], axis=-1))


def _told(camera: Camera) -> dict[str, object]:
    matrix = opencv_to_opengl(camera.camera_to_world)
    return {
        "camera_to_world": matrix.tolist(),
        "focal": camera.fx,
        "width": camera.width,
        "height": camera.height,
    }


def _read(path: Path) -> Seen:
    """Read all layers of a frame; :func:`tron.io.images.read_image` reads only one."""
    import OpenEXR

    held = OpenEXR.File(str(path), separate_channels=True).channels()

    def planes(layer: str, letters: str) -> np.ndarray:
        found = [held[f"{LAYER}.{layer}.{letter}"].pixels for letter in letters]
        return np.stack([np.asarray(each, np.float32) for each in found], axis=-1)

    return Seen(
        lit=planes("Combined", "RGB"),
        normal=planes("Normal", "XYZ"),
        base_color=planes(BASE_COLOR, "RGB"),
        opacity=planes("Combined", "A")[..., 0],
    )
