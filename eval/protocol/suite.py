"""A suite: scenes with training views, lights, test cameras, and the truth for comparisons.

    SUITE/suite.yaml                   names, lights, exposures; the id that methods cite
    SUITE/SCENE/train/                 training views, a capture folder (tron.captures.folder)
    SUITE/SCENE/train_light.exr        light of the training views, where it is known
    SUITE/SCENE/test/transforms.json   test cameras without pictures, OpenGL camera-to-world, world of train/
    SUITE/SCENE/lights/LIGHT.exr       lat-long map, linear, float32 (conventions.md, 3)
    SUITE/SCENE/truth/LIGHT/NNNN.exr   linear radiance of each test camera, where it is known
    SUITE/SCENE/truth/mask/NNNN.png    coverage; albedo/NNNN.exr linear; normals/NNNN.exr unit, world;
                                       depth/NNNN.exr distance along the rays, world units, 0 of nothing

``id`` is the suite's name and a digest of cameras, lights and truth: figures of two suites are comparable
if their ids are equal. A folder is written whole or not at all, and checked when it is read.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import numpy as np
import yaml
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    PositiveFloat,
    PositiveInt,
    ValidationError,
    field_validator,
)

from eval.protocol.pictures import Fault, Size, Values, read_frames, require_folder, write_frames
from tron.cameras import Camera, opencv_to_opengl
from tron.color import agx, linear_to_srgb
from tron.errors import TronError
from tron.io.transforms_json import cameras_of_transforms
from tron.shading.environments.environment import EnvironmentMap
from tron.storage import atomic_folder, sha256

SUITE_NAME, TRANSFORMS = "suite.yaml", "test/transforms.json"
TRAIN, TRUTH, LIGHTS, TRAIN_LIGHT = "train", "truth", "lights", "train_light.exr"
MapName = Literal["albedo", "normals", "mask", "depth"]
MAP_VALUES: dict[MapName, Values] = {
    "albedo": "reflectance",
    "normals": "vector",
    "mask": "share",
    "depth": "distance",
}
MAPS = tuple(MAP_VALUES)
"""Of a scene's truth, beside its lights; no light may be called so."""
NAME = r"^[A-Za-z0-9][A-Za-z0-9_-]{0,59}$"
LARGEST_YAML = 2**22

Name = Annotated[str, Field(pattern=NAME)]
Model = TypeVar("Model", bound=BaseModel)
ToneCurve = Literal["agx", "srgb"]
CURVES: dict[ToneCurve, Callable[[np.ndarray], np.ndarray]] = {
    "agx": agx,
    "srgb": lambda linear: linear_to_srgb(np.clip(linear, 0, 1)),
}
"""Tone curve -> exposed linear radiance to display values in [0, 1]."""


class _Described(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class SuiteLight(_Described):
    """A light of a scene."""

    exposure: PositiveFloat = Field(description="factor on linear values before the tone curve")
    truth: bool = Field(description="whether the true pictures of the test cameras under it are known")
    family: str = Field(default="", description="groups rows: high, medium, ...")


class SceneEntry(_Described):
    """Entry of a scene in suite.yaml."""

    kind: str = Field(default="", description="groups rows: object, table, photos, ...")
    frames: PositiveInt = Field(le=10_000, description="number of test cameras")
    width: PositiveInt = Field(le=16_384)
    height: PositiveInt = Field(le=16_384)
    maps: list[MapName] = Field(default=[], description="further known truth")
    lights: dict[Name, SuiteLight] = Field(min_length=1)

    @field_validator("lights")
    @classmethod
    def _no_map(cls, lights: dict[str, SuiteLight]) -> dict[str, SuiteLight]:
        if taken := set(lights) & set(MAPS):
            raise ValueError(f"no light can be named {min(taken)}")
        return lights


class SuiteFile(_Described):
    """Contents of suite.yaml."""

    format: Literal["tron-suite-1"] = "tron-suite-1"
    name: str = Field(pattern=r"^[a-z0-9][a-z0-9_]{0,39}$")
    id: str = Field(description="id that methods cite")
    tone_curve: ToneCurve
    background: Literal["black", "environment"] = Field(description="content of the truth off surfaces")
    source: str = Field(default="", description="command that made the suite")
    scenes: dict[Name, SceneEntry] = Field(min_length=1)


@dataclass(frozen=True)
class SuiteScene:
    """A scene; pictures are read on demand."""

    name: str
    folder: Path
    entry: SceneEntry

    @property
    def train(self) -> Path:
        """The capture folder of the training views."""
        return self.folder / TRAIN

    @property
    def lights(self) -> Mapping[str, SuiteLight]:
        """Name -> light, in the suite's order."""
        return self.entry.lights

    @property
    def kind(self) -> str:
        """Kind of scene, such as object or table."""
        return self.entry.kind

    @property
    def size(self) -> Size:
        """Picture size of the test cameras."""
        return Size(self.entry.width, self.entry.height)

    @cached_property
    def cameras(self) -> list[Camera]:
        """Test cameras, in the order of the frames."""
        return cameras_of_transforms(self.folder / TRANSFORMS, self.size)

    def light(self, name: str) -> EnvironmentMap:
        """Read a light's map."""
        return EnvironmentMap.load(self.folder / LIGHTS / f"{name}.exr")

    def truth(self, light: str) -> np.ndarray:
        """Read true linear radiance (K, H, W, 3) float32; Fault if it is not known."""
        if not self.lights[light].truth:
            raise Fault("missing_light", f"the suite has no truth of {light}", self.folder)
        return self._frames(light, "radiance")

    def mask(self) -> np.ndarray | None:
        """Read coverage (K, H, W) float32, if it is known."""
        return self._frames("mask", "share")[..., 0] if "mask" in self.entry.maps else None

    def albedo(self) -> np.ndarray | None:
        """Read linear base color (K, H, W, 3) float32, if it is known."""
        return self._frames("albedo", "reflectance") if "albedo" in self.entry.maps else None

    def normals(self) -> np.ndarray | None:
        """Read world normals (K, H, W, 3) float32, zero off surfaces, if they are known."""
        return self._frames("normals", "vector") if "normals" in self.entry.maps else None

    def depth(self) -> np.ndarray | None:
        """Read distance along the rays (K, H, W) float32, 0 off surfaces, if it is known."""
        return self._frames("depth", "distance")[..., 0] if "depth" in self.entry.maps else None

    def _frames(self, what: str, values: Values) -> np.ndarray:
        return read_frames(self.folder / TRUTH / what, self.entry.frames, self.size, values)


@dataclass(frozen=True)
class Suite:
    """A suite's folder, checked when read."""

    folder: Path
    file: SuiteFile
    scenes: Mapping[str, SuiteScene]

    @property
    def name(self) -> str:
        """Name of the suite, such as tron_synth_small."""
        return self.file.name

    @property
    def id(self) -> str:
        """Name and digest."""
        return self.file.id

    def display(self, exposed: np.ndarray) -> np.ndarray:
        """Map exposed linear radiance (..., 3) to display values in [0, 1] by the suite's tone curve."""
        return np.asarray(CURVES[self.file.tone_curve](exposed), np.float32)

    @classmethod
    def load(cls, folder: str | Path) -> Suite:
        """Read suite.yaml and check all files that it names.

        Raises:
            TronError: there is no suite, it is damaged, files are missing, or its files do not match its id.
        """
        folder = Path(folder)
        file = load_yaml(folder / SUITE_NAME, SuiteFile, "give a folder that tron-eval export=SUITE wrote")
        scenes = {name: SuiteScene(name, folder / name, entry) for name, entry in file.scenes.items()}
        for scene in scenes.values():
            _require_whole(scene, folder)
        if (found := suite_id(file.name, scenes.values())) != file.id:
            raise TronError(
                f"cameras, lights or truth are not those of {file.id}, but of {found}",
                folder,
                "export it again",
            )
        return cls(folder, file, scenes)


def load_yaml(path: Path, model: type[Model], mend: str) -> Model:
    """Read a YAML file as a model; TronError if it is missing, damaged or invalid."""
    try:
        if path.stat().st_size > LARGEST_YAML:
            raise TronError(f"{path.name} is too large to be one", path)
        text = path.read_text("utf-8")
        if any(
            isinstance(token, yaml.AliasToken) for token in yaml.scan(text)
        ):  # a few lines may expand to 2^60
            raise TronError(f"{path.name} has aliases (*name), which are not read", path, "write them out")
        return model.model_validate(yaml.safe_load(text))
    except OSError as error:
        raise TronError(f"no {path.name}: {error.strerror or error}", path.parent, mend) from error
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        given = "" if first["type"] == "missing" else f", not {str(first['input'])[:60]!r}"
        raise TronError(f"{path.name}: {key or 'file'}: {first['msg']}{given}", path) from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise TronError(f"{path.name} is no YAML", path) from error


def suite_id(name: str, scenes: Iterable[SuiteScene]) -> str:
    """Return the name and 12 digits of a hash of all scenes' names, lights, exposures, cameras and truth."""
    digest = hashlib.sha256()
    for scene in sorted(scenes, key=lambda each: each.name):
        digest.update(f"{scene.name} {scene.entry.model_dump_json()}\n".encode())
        judged = [scene.folder / TRANSFORMS, *sorted((scene.folder / LIGHTS).glob("*.exr"))]
        judged += sorted(path for path in (scene.folder / TRUTH).rglob("*") if path.is_file())
        for path in judged:
            digest.update(f"{path.relative_to(scene.folder).as_posix()} {sha256(path)}\n".encode())
    return f"{name}-{digest.hexdigest()[:12]}"


def _require_whole(scene: SuiteScene, root: Path) -> None:
    require_folder(
        scene.folder, root, "missing_scene", f"suite.yaml names scene {scene.name}, which is not there"
    )
    require_folder(scene.train, root, "missing_file", "training views are missing")
    for name, light in scene.lights.items():
        if not (scene.folder / LIGHTS / f"{name}.exr").is_file():
            raise Fault("missing_light", f"the map of light {name} is missing", scene.folder / LIGHTS)
        if light.truth:
            require_folder(scene.folder / TRUTH / name, root, "missing_light", f"truth of {name} is missing")
    for what in scene.entry.maps:
        require_folder(scene.folder / TRUTH / what, root, "missing_file", f"true {what} are missing")
    found = len(scene.cameras)
    if found != scene.entry.frames or any((c.width, c.height) != scene.size for c in scene.cameras):
        raise Fault("wrong_size", f"{found} test cameras do not fit suite.yaml", scene.folder / TRANSFORMS)


@dataclass(frozen=True)
class NewScene:
    """A scene to write.

    Attributes:
        name, kind: as in suite.yaml.
        write_train: function that writes the training views' capture folder at a path.
        train_light: light of the training views, if it is known.
        cameras: test cameras.
        lights: name -> map, exposure, family, and truth (K, H, W, 3) or None.
        maps: name in MAPS -> (K, H, W, C).
    """

    name: str
    kind: str
    write_train: Callable[[Path], None]
    train_light: EnvironmentMap | None
    cameras: Sequence[Camera]
    lights: Mapping[str, tuple[EnvironmentMap, float, str, np.ndarray | None]]
    maps: Mapping[MapName, np.ndarray]


def write_suite(
    folder: Path,
    name: str,
    scenes: Iterable[NewScene],
    tone_curve: ToneCurve = "agx",
    background: Literal["black", "environment"] = "black",
    source: str = "",
) -> Suite:
    """Write a suite whole or not at all, with one scene in memory at a time, and read it back.

    Raises:
        TronError: the folder is not empty, or cannot be written.
    """
    require_new(folder)
    with atomic_folder(folder) as made:
        entries: dict[str, SceneEntry] = {}
        for scene in scenes:
            if scene.name in entries:
                raise TronError(f"two scenes are named {scene.name}", mend="rename one of them")
            entries[scene.name] = _write_scene(made / scene.name, scene)
        written = [SuiteScene(each, made / each, entry) for each, entry in entries.items()]
        file = SuiteFile(
            name=name,
            id=suite_id(name, written),
            tone_curve=tone_curve,
            background=background,
            source=source,
            scenes=entries,
        )
        write_yaml(made / SUITE_NAME, file)
    return Suite.load(folder)


def require_new(folder: Path) -> None:
    """Raise TronError if a folder is not empty."""
    if folder.exists() and any(folder.iterdir()):
        raise TronError("folder is not empty", folder, "choose another output_dir for the suite")


def write_yaml(path: Path, model: BaseModel) -> None:
    """Write a model as plain YAML."""
    path.write_text(
        yaml.safe_dump(model.model_dump(mode="json"), sort_keys=False, allow_unicode=True), "utf-8"
    )


def _write_scene(folder: Path, scene: NewScene) -> SceneEntry:
    for inner in (LIGHTS, "test", *(f"{TRUTH}/{what}" for what in scene.maps)):
        (folder / inner).mkdir(parents=True)
    scene.write_train(folder / TRAIN)
    if scene.train_light is not None:
        scene.train_light.save(folder / TRAIN_LIGHT)
    (folder / TRANSFORMS).write_text(json.dumps(transforms(scene.cameras), indent=1) + "\n", "utf-8")
    lights = {}
    for name, (light, exposure, family, truth) in scene.lights.items():
        light.save(folder / LIGHTS / f"{name}.exr")
        lights[name] = SuiteLight(exposure=exposure, truth=truth is not None, family=family)
        if truth is not None:
            (folder / TRUTH / name).mkdir(parents=True)
            write_frames(folder / TRUTH / name, truth, "radiance", ".exr")
    for what, frames in scene.maps.items():
        frames = frames[..., None] if frames.ndim == 3 else frames
        write_frames(folder / TRUTH / what, frames, MAP_VALUES[what], ".png" if what == "mask" else ".exr")
    first = scene.cameras[0]
    return SceneEntry(
        kind=scene.kind,
        frames=len(scene.cameras),
        width=first.width,
        height=first.height,
        maps=[what for what in MAPS if what in scene.maps],
        lights=lights,
    )


def transforms(cameras: Sequence[Camera]) -> dict[str, object]:
    """Return cameras as a nerfstudio transforms.json without pictures; TronError if their sizes differ."""
    if len({(camera.width, camera.height) for camera in cameras}) != 1:
        raise TronError("test cameras differ in size", mend="give those of one size")
    lenses = [
        {"fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy, "w": c.width, "h": c.height} for c in cameras
    ]
    shared = lenses[0] if all(lens == lenses[0] for lens in lenses) else {}
    frames = [
        {
            "file_path": f"{k:04d}",
            **({} if shared else lens),
            "transform_matrix": opencv_to_opengl(camera.camera_to_world).tolist(),
        }
        for k, (camera, lens) in enumerate(zip(cameras, lenses))
    ]
    return {"camera_model": "PINHOLE", **shared, "frames": frames}
