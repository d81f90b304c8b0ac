"""`tron-eval export=SUITE`: suites from captures of tron-datagen, from any captures, and from TensoIR.

``conf/eval/export/NAME.yaml`` names the class by ``_target_``.
"""

from __future__ import annotations

import abc
import json
import logging
import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, PositiveInt

from eval.protocol.pictures import Fault
from eval.protocol.suite import MapName, NewScene, Suite, ToneCurve, require_new, write_suite
from eval.stages import Child, Stages, script_path
from tron.captures import Capture, LoadSettings, load_capture
from tron.captures.folder import read_capture_folder, write_capture
from tron.cli.installation import require_own_packages
from tron.color import srgb_to_linear
from tron.errors import TronError
from tron.shading.environments.environment import EnvironmentMap

log = logging.getLogger("tron.eval")

CAPTURES, RELIT, SHOT_TRUTH = "captures", "relit", "truth"
"""Folders of what tron-datagen mode=captures and mode=pseudo_captures wrote."""
ENVIRONMENT, SPEC = "environment.exr", "spec.json"
FIELDS: dict[MapName, str] = {"albedo": "base_color", "normals": "normal", "depth": "depth"}
"""A suite's map -> field of a view."""
TENSOIR_LIGHTS = ("bridge", "city", "fireplace", "forest", "night")
"""Of TensoIR's relighting; its photos are of ``sunset``."""


class Export(BaseModel, abc.ABC):
    """Settings of all exports."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9_]{0,39}$", description="name of the suite")

    def write(self, output_dir: Path) -> Suite:
        """Write the suite at ``output_dir/NAME``.

        Raises:
            TronError: an input is missing or is not what it should be, or the folder is not empty.
            StageFailed: the command that makes the scenes failed.
        """
        require_new(output_dir / self.name)
        return self._laid_out(output_dir)

    @abc.abstractmethod
    def _laid_out(self, output_dir: Path) -> Suite: ...


class Synthetic(Export):
    """Path-traced captures with relit views: the truth under every light is known."""

    captures: Path | None = Field(
        description="folder of tron-datagen mode=captures or mode=pseudo_captures; null: recipe makes it"
    )
    recipe: list[str] = Field(description="arguments of tron-datagen if captures is null")
    scenes: PositiveInt | None = Field(default=None, description="maximum number of scenes; null: all")

    def _laid_out(self, output_dir: Path) -> Suite:
        made = self.captures or self._made(output_dir)
        names = sorted(
            path.name for path in (made / CAPTURES).glob("*") if path.is_dir() and path.name[0] != "."
        )
        if not names:
            mend = "give a folder of tron-datagen mode=captures with capture.relights=[..]"
            raise TronError(f"no folders in {CAPTURES}/", made, mend)
        source = "tron-datagen " + " ".join(self.recipe) if self.captures is None else str(self.captures)
        scenes = (self._scene(made, name) for name in names[: self.scenes])
        return write_suite(output_dir / self.name, self.name, scenes, source=source)

    def _made(self, output_dir: Path) -> Path:
        require_own_packages("datagen")
        script_path("tron-datagen")
        made = output_dir / "made"
        output_dir.mkdir(parents=True, exist_ok=True)
        Stages(output_dir).run(
            "captures", [Child("captures", "tron-datagen", [*self.recipe, f"output_dir={made}"])]
        )
        return made

    def _scene(self, made: Path, name: str) -> NewScene:
        folders = _relit(made / RELIT, name)
        if not folders:
            mend = "make them with capture.relights=[high,medium]"
            raise TronError(f"{name} has no views under other lights", made / RELIT, mend)
        shot = made / SHOT_TRUTH / name if (made / SHOT_TRUTH / name).is_dir() else made / CAPTURES / name
        relit = {light: read_capture_folder(path) for light, path in folders.items()}
        test = [view.name for view in next(iter(relit.values())).views]
        lights = {}
        for light, capture in relit.items():
            if [view.name for view in capture.views] != test:
                raise TronError(f"{light} shows other views than {next(iter(relit))}", made / RELIT)
            truth = np.stack([view.read() for view in capture.views])
            family = light.partition("_")[2]
            lights[light] = (
                EnvironmentMap.load(folders[light] / ENVIRONMENT),
                capture.exposure,
                family,
                truth,
            )
        first = next(iter(relit.values())).views
        # Held-out views have their maps in the capture, frames of a film in the folder itself.
        views = {view.name: view for view in (*first, *read_capture_folder(shot).views)}
        maps: dict[MapName, np.ndarray] = {"mask": np.stack([view.read("mask") for view in first])}
        for what, field in FIELDS.items():
            if all(each in views and views[each].has(field) for each in test):
                maps[what] = np.stack([views[each].read(field) for each in test])
        light = shot / ENVIRONMENT
        log.info("%s: %d test cameras, lights %s", name, len(test), ", ".join(lights))
        return NewScene(
            name,
            _style(shot / SPEC),
            partial(_write_train, load_capture(made / CAPTURES / name), frozenset(test)),
            EnvironmentMap.load(light) if light.is_file() else None,
            [view.camera for view in first],
            lights,
            maps,
        )


class Photos(Export):
    """Any captures under any maps: there is no truth, so only judges of pictures apply."""

    captures: Path | None = Field(description="a capture, or a folder of captures, of any format")
    lights: list[Path] = Field(description="lat-long maps, the lights of every capture")
    turns_deg: list[float] = Field(
        min_length=1, description="turn of each map about the zenith; further maps use the last value"
    )
    max_side: PositiveInt | None = Field(description="maximum side of the photos in pixels; null: unchanged")

    def _laid_out(self, output_dir: Path) -> Suite:
        if self.captures is None or not self.lights:
            raise TronError(
                "no captures or no lights", mend="give export.captures=DIR export.lights=[A.hdr,B.hdr]"
            )
        settings = LoadSettings(max_side=self.max_side)
        folders = sorted(path for path in self.captures.glob("*") if path.is_dir() and path.name[0] != ".")
        try:
            loaded = {self.captures.resolve().name: load_capture(self.captures, settings)}
        except TronError:
            loaded = {path.name: load_capture(path, settings) for path in folders}
        if not loaded:
            raise TronError("no captures", self.captures)
        scenes = (self._scene(_plain(name), capture) for name, capture in loaded.items())
        return write_suite(
            output_dir / self.name, self.name, scenes, "srgb", "environment", str(self.captures)
        )

    def _scene(self, name: str, capture: Capture) -> NewScene:
        test = list(capture.test_views)
        if not test:
            raise TronError(f"no views of {name} are held out", mend="a capture needs 8 photos at least")
        lights = {}
        for number, path in enumerate(self.lights):
            turn = self.turns_deg[min(number, len(self.turns_deg) - 1)]
            light = EnvironmentMap.load(path, turn).baked()
            lights[f"{number}_{_plain(path.stem)}"] = (light, light.exposure(), "photographed", None)
        held_out = frozenset(view.name for view in test)
        cameras = [view.camera for view in test]
        train = partial(_write_train, capture, held_out)
        return NewScene(name, "photos", train, None, cameras, lights, {})


class Tensoir(Export):
    """TensoIR's synthetic scenes in the layout of its authors: SCENE/train_000, SCENE/test_000, maps."""

    root: Path | None = Field(description="folder of the scenes; it has lego/ in it")
    maps: Path | None = Field(description="folder of the .hdr lights; null: root/Environment_Maps")
    lights: list[str] = Field(min_length=1, description="names of the lights for relighting")

    def _laid_out(self, output_dir: Path) -> Suite:
        if self.root is None:
            raise TronError("no TensoIR scenes", mend="give export.root=DIR, which holds lego/, hotdog/ ..")
        scenes = sorted(path.name for path in self.root.glob("*") if (path / "train_000").is_dir())
        if not scenes:
            raise TronError(
                "no folder in it has train_000", self.root, "give the folder that holds lego/, hotdog/ .."
            )
        found = map(self._scene, scenes)
        return write_suite(output_dir / self.name, self.name, found, "srgb", "black", str(self.root))

    def _scene(self, name: str) -> NewScene:
        assert self.root is not None
        trained = load_capture(self.root / name, LoadSettings(format="tensoir"))
        train = Capture(tuple(trained.train_views), up=trained.up)
        maps = self.maps or self.root / "Environment_Maps"
        lights, masks, first = {}, None, None
        for light in self.lights:
            views = load_capture(self.root / name, LoadSettings(format="tensoir", tensoir_light=light)).views
            test = [view for view in views if view.name.startswith("test")]
            if not test:
                raise Fault("missing_light", f"no test view of {name} shows {light}", self.root / name)
            first = first or test
            truth = np.stack([srgb_to_linear(view.read()) for view in test])
            masks = np.stack([view.read("mask") for view in test])
            lights[light] = (from_tensoir(maps / f"{light}.hdr"), 1.0, "", truth * (masks[..., None] > 0))
        assert first is not None
        assert masks is not None
        known: dict[MapName, np.ndarray] = {
            what: np.stack([v.read(field) for v in first])
            for what, field in FIELDS.items()
            if first[0].has(field)
        }
        known["mask"] = masks
        cameras = [view.camera for view in first]
        write = partial(_write_train, train, frozenset())
        return NewScene(name, "object", write, None, cameras, lights, known)


def from_tensoir(path: Path) -> EnvironmentMap:
    """Turn a TensoIR light by 90 degrees: its maps have azimuth 0 in the middle, growing to the left.

    Its u is 1/2 - atan2(y, x) / 2 pi (models/relight_utils.py, get_light), ours 1/4 - atan2(y, x) / 2 pi.
    """
    image = EnvironmentMap.load(path).image
    return EnvironmentMap(np.roll(image, -image.shape[1] // 4, axis=1))


def _write_train(capture: Capture, without: frozenset[str], path: Path) -> None:
    """Write the training views in their original tone curve."""
    views = tuple(view for view in capture.views if view.name not in without)
    curve: ToneCurve = capture.tone_curve
    write_capture(path, replace(capture, views=views, test=frozenset()), tone_curve=curve)


def _relit(folder: Path, name: str) -> dict[str, Path]:
    """Return ``1_high`` -> the folder of a scene's views under this light."""
    found = (path for path in folder.glob(f"{name}_*") if path.is_dir())
    numbered = {path.name.removeprefix(f"{name}_"): path for path in found}
    return dict(sorted(numbered.items(), key=lambda each: (int(each[0].partition("_")[0]), each[0])))


def _style(spec: Path) -> str:
    try:
        found: Any = json.loads(spec.read_text("utf-8"))["style"]
    except (OSError, ValueError, KeyError, TypeError):
        return ""
    return str(found)


def _plain(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]+", "_", name).strip("_-")[:60] or "capture"
