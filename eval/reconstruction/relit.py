"""The fox under other lights: cameras of held-out views for tron-relight, and its frames as pictures."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from eval.reconstruction.light import read_light
from eval.reconstruction.measured import Fox
from eval.reconstruction.pictures import light_picture, show_view
from eval.reconstruction.runs import collect_run
from tron.captures import LoadSettings, View, load_capture
from tron.color import to_display
from tron.errors import TronError
from tron.images import read_image
from tron.reconstruction.evaluation import wanted_picture
from tron.shading.environment import EnvironmentMap
from tron.storage import write_atomic


@dataclass
class FoxRun:
    """Files that the commands left of the fox.

    Attributes:
        capture: what was read.
        folder: what tron-reconstruct wrote.
        seconds: its wall time.
        views: the held-out views that are shown.
        lights: name of a light -> (map, folder of tron-relight's frames).
        relit_seconds: wall time of all the lights together.
    """

    capture: Path
    folder: Path
    seconds: float
    views: list[View]
    lights: dict[str, tuple[Path, Path]] = field(default_factory=dict)
    relit_seconds: float = 0.0


def chosen_views(capture: Path, downscale: float, count: int) -> list[View]:
    """``count`` of the held-out views, evenly spread, as tron-reconstruct loads them."""
    views = load_capture(capture, LoadSettings(downscale=downscale)).test_views
    places = np.unique(np.linspace(0, len(views) - 1, min(count, len(views))).round().astype(int))
    return [views[place] for place in places]


def write_cameras(path: Path, views: Sequence[View]) -> None:
    """The views' cameras as tron-relight's ``cameras=`` takes them; a file that says so already stays."""
    text = json.dumps([view.camera.to_dict() for view in views], indent=1) + "\n"
    if not path.is_file() or path.read_text("utf-8") != text:
        write_atomic(path, text)


def collect_fox(made: FoxRun) -> Fox:
    """Figures and pictures of the finished commands."""
    fitted = read_light(made.folder)
    return Fox(
        run=collect_run("fox", made.folder, made.capture, made.seconds),
        photos={view.name: wanted_picture(view) for view in made.views},
        rendered={view.name: show_view(made.folder, view) for view in made.views},
        relit={
            name: [light_picture(EnvironmentMap.load(light)), *relit_frames(frames, len(made.views))]
            for name, (light, frames) in made.lights.items()
        },
        relit_seconds=made.relit_seconds,
        light=None if fitted is None else light_picture(fitted),
    )


def relit_frames(folder: Path, frames: int) -> list[np.ndarray]:
    """Frames of tron-relight as pictures, display values: ``lit``, through its exposure and AgX."""
    path = folder / "relight.json"
    try:
        exposure = float(json.loads(path.read_text("utf-8"))["exposure"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TronError(f"not tron-relight's report: {error}", path) from error
    return [
        to_display(read_image(folder / "frames" / f"{index:04d}.lit.exr"), exposure)
        for index in range(frames)
    ]
