"""The fox, a real capture: figures, and pictures of its photos, its surfels and relit frames."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from eval.reconstruction.light import read_light
from eval.reconstruction.pictures import light_picture, show_view
from eval.reconstruction.runs import Run, collect_run
from eval.results import Row
from tron.captures import LoadSettings, View, load_capture
from tron.color import to_display
from tron.errors import TronError
from tron.io.images import read_image
from tron.reconstruction.scores import wanted_picture
from tron.report.page import Picture, Pictures
from tron.shading.environments.environment import EnvironmentMap
from tron.storage import write_atomic


@dataclass(frozen=True)
class Fox:
    """Photos, reconstruction and relit frames of the real capture.

    Attributes:
        run: run of tron-reconstruct.
        photos: name of a held-out view -> (H, W, 3) display values.
        rendered: name -> channel -> (H, W, 3) display values, of the surfels.
        relit: name of a light -> its picture, then one picture a view.
        relit_seconds: of all the lights together.
        light: picture of the fitted light, if any.
    """

    run: Run
    photos: dict[str, np.ndarray]
    rendered: dict[str, dict[str, np.ndarray]]
    relit: dict[str, list[np.ndarray]]
    relit_seconds: float
    light: np.ndarray | None

    def rows(self) -> Iterator[Row]:
        """Yield figures of the reconstruction, and the time to relight it."""
        report = self.run.report
        for name, key, unit in (("test_psnr", "psnr", "dB"), ("ssim", "ssim", "1"), ("lpips", "lpips", "1")):
            if key in report.test:
                n = len(report.capture.held_out)
                yield Row(metric=f"fox.{name}", value=report.test[key], unit=unit, n=n)
        views = int(report.train["views"])
        yield Row(metric="fox.train_psnr", value=report.train["psnr"], unit="dB", n=views)
        for name, value, unit in (
            ("seconds", self.run.seconds, "s"),
            ("surfels_seconds", report.seconds.surfels, "s"),
            ("light_seconds", report.seconds.light, "s"),
            ("surfels", report.surfels, "surfels"),
            ("views", report.capture.views, "views"),
        ):
            yield Row(metric=f"fox.{name}", value=value, unit=unit, n=1)
        if self.relit:
            yield Row(metric="fox.relight_seconds", value=self.relit_seconds, unit="s", n=len(self.relit))

    def pictures(self) -> Iterator[tuple[str, Pictures]]:
        """Yield file name -> group: held-out photos beside the surfels, and a group for each other light."""
        for name, photo in self.photos.items():
            psnr = self.run.report.views.get(name, {}).get("psnr")
            pictures = [Picture(photo, "photo", f"held-out photo {name} of the fox")]
            for channel, image in self.rendered[name].items():
                figure = f"{psnr:.1f} dB" if channel == "radiance" and psnr is not None else ""
                pictures.append(Picture(image, channel, f"{channel} of the surfels, view {name}", figure))
            yield f"fox-{name}", Pictures(f"Held-out photo {name}", pictures, columns=len(pictures))
        if self.light is not None:
            found = Picture(self.light, "fitted light", "environment map that was fitted to the photos")
            yield "fox-light", Pictures("The light that was found", [found], columns=1)
        for light, (environment, *frames) in self.relit.items():
            pictures = [Picture(environment, "light", f"environment map {light}")]
            for name, frame in zip(self.photos, frames, strict=True):
                pictures.append(Picture(frame, f"view {name}", f"the fox from view {name}, lit by {light}"))
            yield (
                f"fox-{light}",
                Pictures(f"Under {light.replace('_', ' ')}", pictures, columns=len(pictures)),
            )


@dataclass
class FoxRun:
    """Files that the commands wrote for the fox.

    Attributes:
        capture: input of tron-reconstruct.
        folder: output of tron-reconstruct.
        seconds: wall time of tron-reconstruct.
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
    """Return ``count`` held-out views, evenly spread, as tron-reconstruct loads them."""
    views = load_capture(capture, LoadSettings(downscale=downscale)).test_views
    places = np.unique(np.linspace(0, len(views) - 1, min(count, len(views))).round().astype(int))
    return [views[place] for place in places]


def write_cameras(path: Path, views: Sequence[View]) -> None:
    """Write the views' cameras for tron-relight's ``cameras=``; a file with this content is left alone."""
    text = json.dumps([view.camera.to_dict() for view in views], indent=1) + "\n"
    if not path.is_file() or path.read_text("utf-8") != text:
        write_atomic(path, text)


def collect_fox(made: FoxRun) -> Fox:
    """Return figures and pictures of the finished commands."""
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
    """Return frames of tron-relight in display values: ``lit`` after its exposure and AgX."""
    path = folder / "relight.json"
    try:
        exposure = float(json.loads(path.read_text("utf-8"))["exposure"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TronError(f"not tron-relight's report: {error}", path) from error
    return [
        to_display(read_image(folder / "frames" / f"{index:04d}.lit.exr"), exposure)
        for index in range(frames)
    ]
