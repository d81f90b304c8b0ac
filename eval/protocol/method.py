"""A method's folder: pictures of a suite's test cameras under the suite's lights, and method.yaml.

    METHOD/method.yaml                :class:`Method`
    METHOD/SCENE/LIGHT/NNNN.png|exr   every test camera under every light
    METHOD/SCENE/albedo/NNNN.*        optional; .exr linear, .png by the sRGB curve
    METHOD/SCENE/normals/NNNN.*       optional; .exr (x, y, z), .png (n + 1) / 2

TRON's own methods write the same folders, by :func:`write_method`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, NonNegativeFloat, model_validator

from eval.protocol.pictures import SUFFIXES, Fault, read_frames, require_folder, write_frames
from eval.protocol.suite import Suite, SuiteScene, load_yaml, write_yaml
from tron.color import linear_to_srgb, srgb_to_linear
from tron.errors import TronError
from tron.run_folder import RunFolder
from tron.storage import atomic_folder

METHOD_NAME = "method.yaml"

ColorSpace = Literal["linear", "display", "srgb"]
Frame = Literal["world", "opencv", "opengl"]
Given = Literal["photos", "masks", "points", "train_light", "true_maps", "true_geometry", "other_scenes"]
_OPENGL = np.array([1.0, -1.0, -1.0])


class Seconds(BaseModel):
    """Wall time on ``machine`` to fit a scene, and to render one picture of it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    fit: NonNegativeFloat | None = None
    frame: NonNegativeFloat | None = None


class Method(BaseModel):
    """Contents of method.yaml."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    format: Literal["tron-method-1"] = "tron-method-1"
    name: str = Field(pattern=r"^[a-z][a-z0-9_]{0,39}$", description="name in rows: NAME.psnr")
    title: str = Field(default="", description="title in tables")
    suite: str = Field(description="id of the suite of the cameras and lights")
    color_space: ColorSpace = Field(
        description="of the pictures: linear, radiance without the suite's exposure; display, after exposure "
        "and tone curve; srgb, exposed radiance by the sRGB curve, clipped"
    )
    background: Literal["black", "environment", "white", "none"] = Field(
        default="none", description="content behind the subject; none: not judged"
    )
    scale: Literal["absolute", "scene"] = Field(
        default="absolute",
        description="scene: fit one factor on the light of each scene, which photos do not fix",
    )
    normals: Frame = Field(
        default="world",
        description="frame of the normals: world; opencv, x right, y down, z forward; opengl, y up, z back",
    )
    saw: list[Given] = Field(default=[], description="inputs that the method had of the judged scenes")
    citation: str = ""
    seconds: Seconds = Seconds()
    machine: str = ""

    @model_validator(mode="after")
    def _scalable(self) -> Method:
        if self.scale == "scene" and self.color_space == "display":
            raise ValueError("display values cannot be scaled: say scale: absolute, or write linear pictures")
        return self


@dataclass(frozen=True)
class MethodFolder:
    """A method's folder; pictures are read and checked on demand."""

    folder: Path
    method: Method

    @classmethod
    def load(cls, folder: str | Path, suite: Suite) -> MethodFolder:
        """Read method.yaml; TronError if it is missing, damaged, or of another suite."""
        folder = Path(folder)
        method = load_yaml(folder / METHOD_NAME, Method, "eval/protocol/method.py says what it holds")
        if method.suite != suite.id:
            raise TronError(
                f"these pictures are of suite {method.suite}, and the suite given is {suite.id}",
                folder / METHOD_NAME,
                "give the suite that they were made of",
            )
        return cls(folder, method)

    def frames(self, scene: SuiteScene, light: str) -> np.ndarray:
        """Read frames (K, H, W, 3) float32 in the method's colour space; Fault if any is wrong."""
        lights = self.folder / scene.name
        require_folder(lights, self.folder, "missing_scene", f"scene {scene.name} is missing")
        found = [path.name for path in lights.iterdir() if path.is_dir()]
        require_folder(
            lights / light, self.folder, "missing_light", f"light {light} is missing", sorted(found)
        )
        values = "radiance" if self.method.color_space == "linear" else "display"
        shown = read_frames(lights / light, scene.entry.frames, scene.size, values)
        if values == "radiance" and next((lights / light).glob("*.png"), None):
            mend = "write .exr, or say what curve they went through: display or srgb"
            raise Fault("out_of_range", "PNG pictures cannot be linear", lights / light, mend)
        return shown

    def albedo(self, scene: SuiteScene) -> np.ndarray | None:
        """Read linear base color (K, H, W, 3); None if the method has none."""
        found = self._maps(scene, "albedo")
        if found is None:
            return None
        frames, suffix = found
        return np.asarray(srgb_to_linear(frames) if suffix == ".png" else frames, np.float32)

    def normals(self, scene: SuiteScene, frame: Frame | None = None) -> np.ndarray | None:
        """Read world normals (K, H, W, 3) of any length; None if the method has none.

        ``frame`` is the assumed frame of the stored normals, by default the method's declared one.
        """
        found = self._maps(scene, "normals")
        if found is None:
            return None
        frames, suffix = found
        return to_world(2 * frames - 1 if suffix == ".png" else frames, frame or self.method.normals, scene)

    def _maps(self, scene: SuiteScene, what: Literal["albedo", "normals"]) -> tuple[np.ndarray, str] | None:
        folder = self.folder / scene.name / what
        if not folder.is_dir():
            return None
        require_folder(folder, self.folder, "missing_file", f"{what} are missing")
        values = "reflectance" if what == "albedo" else "vector"
        frames = read_frames(folder, scene.entry.frames, scene.size, values)
        return frames, next(suffix for suffix in SUFFIXES if next(folder.glob(f"*{suffix}"), None))


def to_world(normals: np.ndarray, frame: Frame, scene: SuiteScene) -> np.ndarray:
    """Turn normals (K, H, W, 3) of a frame to the world: row vectors times the world-to-camera rotation."""
    if frame == "world":
        return normals
    if frame == "opengl":
        normals = normals * _OPENGL
    turns = np.stack([camera.world_to_camera[:3, :3] for camera in scene.cameras])
    return np.einsum("khwi,kij->khwj", normals, turns).astype(np.float32)


class MethodWriter:
    """Writer of a method's pictures, one light of a scene at a time, whole or not at all."""

    def __init__(self, folder: Path, method: Method):
        self.folder, self._method, self._seconds = folder, method, Seconds()

    def has(self, scene: str, what: str) -> bool:
        """Whether the frames of a light, or albedo or normals, exist already."""
        return (self.folder / scene / what).is_dir()

    def frames(self, scene: str, light: str, frames: np.ndarray, suffix: str = ".exr") -> None:
        """Write the pictures (K, H, W, 3) of a light, in the method's colour space."""
        values = "radiance" if self._method.color_space == "linear" else "display"
        self._write(scene, light, frames, values, suffix)

    def albedo(self, scene: str, frames: np.ndarray, suffix: str = ".exr") -> None:
        """Write linear base color (K, H, W, 3)."""
        stored = linear_to_srgb(np.clip(frames, 0, 1)) if suffix == ".png" else np.clip(frames, 0, 1)
        self._write(scene, "albedo", stored, "reflectance", suffix)

    def normals(self, scene: str, frames: np.ndarray, suffix: str = ".exr") -> None:
        """Write normals (K, H, W, 3), in the method's declared frame."""
        self._write(scene, "normals", frames * 0.5 + 0.5 if suffix == ".png" else frames, "vector", suffix)

    def seconds(self, fit: float | None = None, frame: float | None = None) -> None:
        """Record the seconds to fit a scene, and to render a picture."""
        self._seconds = Seconds(fit=fit, frame=frame)

    def _write(
        self,
        scene: str,
        what: str,
        frames: np.ndarray,
        values: Literal["radiance", "display", "reflectance", "vector"],
        suffix: str,
    ) -> None:
        if not np.isfinite(frames).all():
            raise TronError("pictures hold NaN or infinity", self.folder / scene / what)
        with atomic_folder(self.folder / scene / what) as made:
            write_frames(made, frames, values, suffix)


@contextmanager
def write_method(folder: Path, method: Method) -> Iterator[MethodWriter]:
    """Write a method's folder; finished parts of an earlier call are kept, and method.yaml is written last.

    Raises:
        TronError: the folder holds something else, or pictures of another method or suite.
    """
    run = RunFolder(folder, "a method's pictures", "method.json")
    run.claim(method.model_dump(mode="json", exclude={"seconds", "machine"}))
    writer = MethodWriter(folder, method)
    yield writer
    made = method.model_copy(update={"seconds": writer._seconds} if writer._seconds != Seconds() else {})
    write_yaml(folder / METHOD_NAME, made)
