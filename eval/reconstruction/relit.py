"""The fox under other lights: cameras of held-out views for tron-relight, and its frames as pictures."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from eval.reconstruction.pictures import light_picture, show_view
from eval.reconstruction.runs import Run
from tron.captures import LoadSettings, View, load_capture
from tron.color import to_display
from tron.errors import TronError
from tron.images import read_image
from tron.reconstruction.evaluation import wanted_picture
from tron.shading.environment import EnvironmentMap
from tron.storage import write_atomic


@dataclass(frozen=True)
class Fox:
    """The real capture as it was photographed, reconstructed and relit.

    Attributes:
        run: the reconstruction.
        photos: name of a held-out view -> (H, W, 3) display values.
        shown: name -> channel -> (H, W, 3) display values, of the surfels.
        relit: name of a light -> its picture, then one picture a view.
        light: picture of the fitted light, if one was fitted.
    """

    run: Run
    photos: dict[str, np.ndarray]
    shown: dict[str, dict[str, np.ndarray]]
    relit: dict[str, list[np.ndarray]]
    light: np.ndarray | None


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


def collect(run: Run, views: Sequence[View], relit: dict[str, tuple[Path, Path]]) -> Fox:
    """Pictures of a finished run; ``relit`` maps a light's name to its file and tron-relight's folder."""
    fitted = run.folder / "environment.exr"
    return Fox(
        run=run,
        photos={view.name: wanted_picture(view) for view in views},
        shown={view.name: show_view(run.folder, view) for view in views},
        relit={
            name: [light_picture(EnvironmentMap.load(light)), *relit_frames(folder, len(views))]
            for name, (light, folder) in relit.items()
        },
        light=light_picture(EnvironmentMap.load(fitted)) if fitted.is_file() else None,
    )


def relit_frames(folder: Path, frames: int) -> list[np.ndarray]:
    """Frames of tron-relight as pictures, display values: shadowed shading, through its exposure and AgX."""
    path = folder / "relight.json"
    try:
        exposure = float(json.loads(path.read_text("utf-8"))["exposure"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TronError(f"not tron-relight's report: {error}", path) from error
    return [
        to_display(read_image(folder / "frames" / f"{index:04d}.shadowed.exr"), exposure)
        for index in range(frames)
    ]
