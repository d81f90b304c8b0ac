"""Settings of tron-relight."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

import tron
from tron.apps.relit import Background
from tron.apps.scene_file import GROUND, SURROUNDINGS, FoundMaterials, SeenAs, Up
from tron.apps.splat_file import SceneFile
from tron.color import Look
from tron.denoising import DENOISERS, DenoiserName
from tron.editing.models import PlacedModel
from tron.errors import TronError
from tron.estimation import FINAL, QUALITY, Brdf, Estimation, Estimator, require_bounces
from tron.neural.clips import Overlap
from tron.neural.configs import check_sizes
from tron.neural.shipped import AUTO, DEFAULT, SHIPPED
from tron.runtime import Variant
from tron.scans import GroundChoice, Treatment
from tron.shards.schema import guidance_members, light_members
from tron.storage import sha256
from tron.trajectories import TrajectoryName

DEFAULT_BUFFERS = (*light_members(), "indirect", "foreground", "mask", "share", "depth")
BUFFERS = (
    *dict.fromkeys((*DEFAULT_BUFFERS, *guidance_members())),
    *("base_color", "normal", "position", "roughness", "metallic", "rgb"),  # of the G-buffer
    "relit",
)
if TYPE_CHECKING:
    import numpy as np

    BufferName = str
else:
    BufferName = Literal[BUFFERS]
LONGER_SIDE = 512
"""Default of the longer side of a frame, pixels."""

ProxyChoice = Literal["auto", "always", "never"]
Side = Annotated[int, Field(ge=8, le=8192)]
T = TypeVar("T")
DisplayOnly = Annotated[T, Field(json_schema_extra={"display_only": True})]
"""Type of a setting that affects no traced frame: after a change the frames of a folder are kept."""


class Settings(BaseModel):
    """All settings of tron-relight."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    scene: SceneFile = Field(description="the scene: a PLY of TRON, 3DGS or 2DGS, or packed splats")
    environment: Path | Annotated[tuple[Path, ...], Field(min_length=1)] = Field(
        description="environment map, .hdr or .exr (.png and .jpg are clipped), or another file that "
        "tron-environment reads; capture: the light of the scene's photos, environment.exr "
        "beside the scene; each map of a list [a.hdr,b.hdr] has a folder in output_dir, named "
        "after the file",
        examples=["[a.hdr,b.hdr]"],
    )
    output_dir: DisplayOnly[Path] = Field(description="folder for frames, videos and relight.json")
    background: DisplayOnly[Background] = Field(
        "environment",
        description="background of the surfels in the relit picture: the environment, nothing (PNG with "
        "alpha; black in videos), or a colour in display values, such as [1,1,1] for white",
        examples=["[1,1,1]"],
    )
    ground: GroundChoice = Field("auto", description=GROUND)
    surroundings: Treatment = Field("drop", description=SURROUNDINGS)
    proxy: ProxyChoice = Field(
        "auto",
        description="whether light is computed on a proxy of the scan: one layer of surfels, made once "
        "and kept beside the scan as NAME.proxy.ply, or in output_dir if that folder is "
        "read-only; auto: if the scan is thick (the log gives a number) or its normals have "
        "no sign; never: the scan itself is used",
    )
    projection: SeenAs = "auto"
    materials: FoundMaterials = "auto"
    rotation: float | tuple[float, float] = Field(
        0.0,
        description="rotation of the environment about up, degrees, counter-clockwise seen from above; "
        "[0,360] turns it evenly over the clip without the end, so that the clip loops: frame "
        "i of n is at 360 i/n",
        examples=["[0,360]"],
    )
    trajectory: TrajectoryName | Literal["keyframes"] = Field(
        "orbit",
        description="camera path around the scene; still: no motion; keyframes: a path through the "
        "cameras of `cameras`. If cameras.json lies beside the scene, orbit and still stay "
        "between its cameras",
    )
    cameras: Path | None = Field(
        None,
        description="file to use instead of a trajectory: a list of cameras (as in relight.json), "
        "cameras.json of a 3DGS model, a transforms.json, nerfstudio's camera_path.json, SuperSplat's "
        ".ssproj, COLMAP's images.txt or .bin; .glb and .usd with a camera, moving or not, upright",
    )
    motion: Path | None = Field(
        None,
        description="YAML of motions: keyframes of objects and of the light, and falling objects; see "
        "docs/guides/editing.md",
    )
    meshes: tuple[PlacedModel, ...] = Field(
        (),
        description="models that stand in the scene as meshes: they and the surfels shadow and light each "
        "other (pip install 'tron-relight[models]'); tron-edit's insert makes surfels of a "
        "model instead",
        examples=["[{file: cow.glb, at: [0,0,1], height: 0.5}]"],
    )
    quality: Literal["preview", "final"] = Field(
        "preview",
        description="preview: shadows of 32 rays per surfel, once per light, and no shadow rays per "
        "pixel; final: 64 shadow rays per pixel over 2 x 2 sub-pixels, filtered, and 4 "
        "reflection rays",
    )
    bounces: int = Field(
        FINAL.bounces,
        ge=0,
        le=16,
        description="number of bounces of light between surfels; 0: direct light alone, and the relit "
        "picture is 'shadowed'",
    )
    reflections: int | None = Field(
        None, ge=0, description="GGX reflection rays per pixel, for glossy surfaces; null: by quality"
    )
    supersample: Literal[1, 2] | None = Field(
        None, description="2: the mean of 2 x 2 sub-pixels, with a quarter of the rays each; null: by quality"
    )
    brdf: Brdf = Field(
        FINAL.brdf,
        description="material: conserving (energy-conserving), or lambert, as in the paper",
    )
    estimator: Estimator = Field(
        FINAL.estimator,
        description="ratio: unshadowed irradiance times the share of it that arrives; plain: the Monte Carlo "
        "mean, as in the paper",
    )
    two_sided: bool = Field(
        FINAL.two_sided,
        description="back faces block shadow rays beyond two spacings; false: never, as in the paper",
    )
    denoise: DenoiserName | bool = Field(
        True,
        description="filter of the shadows' noise; false: as they are traced; or a denoiser of the relit "
        "picture besides, in place of a network: "
        + ", ".join(f"{name}, {row.title} ({row.mend})" for name, row in DENOISERS.items()),
    )
    frames: int = Field(
        60,
        ge=1,
        le=10_000,
        description="number of frames; the number of `cameras` takes precedence, except with "
        "trajectory=keyframes",
    )
    width: Side | None = Field(
        None,
        description="pixels; null: aspect ratio of the cameras of `cameras`, or of cameras.json beside "
        "the scene, with 512 on the longer side; without cameras, square",
    )
    height: Side | None = Field(None, description="pixels; null: as for width")
    fov: float | None = Field(
        None,
        gt=1,
        lt=150,
        description="horizontal field of view, degrees; null: of the cameras that set the width, or 40",
    )
    distance: float = Field(1.0, gt=0, le=100, description="factor on the automatic distance to the subject")
    fps: float = Field(24.0, gt=0, le=240, description="frames a second of the videos")
    exposure: DisplayOnly[Literal["auto"] | Annotated[float, Field(gt=0)]] = Field(
        "auto",
        description="factor before the tone curve of the relit picture; auto: metered for the light that "
        "falls on the subject in the first frame, one for the clip; the log gives it",
    )
    look: DisplayOnly[Look] = Field(
        "photograph",
        description="tone of the relit picture: AgX with the contrast that photographs have, or none",
    )
    up: Up = None
    checkpoint: DisplayOnly[Path | None] = Field(
        Path(AUTO),
        description="renderer.safetensors, or the name of a checkpoint that comes with the package "
        f"({', '.join(SHIPPED)}): the relit picture is then the neural renderer's; auto: {DEFAULT}, or a "
        "denoiser that is installed, whichever surely makes the picture better, or neither, as the log says; "
        "null: no network. A network wants pip install 'tron-relight[network]'",
        examples=["paper"],
    )
    window: DisplayOnly[int | None] = Field(
        None,
        ge=1,
        description="frames in the sliding window of the neural renderer; null: as the checkpoint says, "
        "which is 1 for bundled checkpoints",
    )
    overlap: DisplayOnly[Overlap] = Field(
        "anchor",
        description="which window draws a frame that lies in several: the window with the frame in its "
        "middle (anchor), the window that ends with it (newest), or the mean of all",
    )
    reproject: DisplayOnly[int] = Field(
        5,
        ge=1,
        le=33,
        description="number of neural frames that are averaged, against flicker: neighbours (with "
        "overlap=newest, earlier frames) are warped along the exact motion of surfaces; not "
        "while the light turns; 1: no average",
    )
    weights: DisplayOnly[dict[str, float] | None] = Field(
        None,
        description="weights of the neural renderer's buffers, one per buffer; null: the checkpoint's "
        "weights",
        examples=["{pbr: 0.3, irradiance: 0.7}"],
    )
    vae: DisplayOnly[Path | None] = Field(None, description="WAN 2.1 VAE, for checkpoints trained with it")
    buffers: DisplayOnly[tuple[BufferName, ...]] = Field(
        DEFAULT_BUFFERS,
        description=f"buffers written as EXR, of {', '.join(BUFFERS)}; relit is the relit picture before "
        "exposure (without checkpoint)",
        examples=["[pbr]"],
    )
    overwrite: DisplayOnly[bool] = Field(False, description="replace frames made with other settings")
    seed: int = Field(0, description="root of all random numbers")
    variant: Variant = "llvm_ad_rgb"
    threads: DisplayOnly[int | None] = Field(None, ge=1, description="of renderer and network; null: all")

    @model_validator(mode="before")
    @classmethod
    def _finds_its_own_light(cls, data: Any) -> Any:
        if not isinstance(data, dict) or not isinstance(data.get("scene"), str | Path):
            return data
        from tron.scans.scan import LIGHT

        own, given = str(Path(data["scene"]).with_name(LIGHT)), data.get("environment")
        several = isinstance(given, list | tuple)
        found = [own if str(each) == "capture" else each for each in (given if several else [given])]
        return {**data, "environment": found if several else found[0]}

    @field_validator("weights")
    @classmethod
    def _weigh_something(cls, weights: dict[str, float] | None) -> dict[str, float] | None:
        if weights is not None:
            check_sizes(weights)
        return weights

    @model_validator(mode="after")
    def _drawn_by_one(self) -> Settings:
        asked = self.checkpoint is not None and not self.takes_default
        if asked and "relit" in self.buffers:
            raise ValueError(
                "a network draws display values, so there is no relit.exr with a checkpoint: leave 'relit' "
                "out of buffers, or take 'shadowed'"
            )
        if asked and self.denoiser is not None:
            both = f"denoise={self.denoiser} and a checkpoint would both draw the picture"
            raise ValueError(f"{both}: leave one of the two out")
        if self.tuned and self.checkpoint is None:
            what = f"{self.tuned[0]} is the neural renderer's"
            raise ValueError(f"{what}: give a checkpoint too, or leave it out")
        return self

    @model_validator(mode="after")
    def _reflects_something(self) -> Settings:
        require_bounces(self.bounces, self.reflections or 0)
        return self

    def estimation(self) -> Estimation:
        """Estimation of the light: what quality says, unless the settings do."""
        said = {
            "filtered": self.denoise is not False,
            "reflections": self.reflections if self.bounces else 0,
            "supersample": self.supersample,
            **self.model_dump(include={"estimator", "two_sided", "bounces", "brdf"}),
        }
        given = {name: value for name, value in said.items() if value is not None}
        return Estimation(**{**QUALITY[self.quality].model_dump(), **given})

    def made_with(self, frames: int, up: np.ndarray) -> dict[str, Any]:
        """Recipe of one light's frames as JSON values: all settings that are not :data:`DisplayOnly`.

        Files count by what is in them, other settings by what they come to.

        Args:
            frames: their number.
            up: (3,) unit, in the frame of the scene's file.
        """
        from tron.editing.motion import Motion
        from tron.scans.camera_files import CAMERAS
        from tron.scans.scan import is_of_capture

        counted = {
            name for name, field in type(self).model_fields.items()
            if not (isinstance(extra := field.json_schema_extra, dict) and extra.get("display_only"))
        }  # fmt: skip
        made: dict[str, Any] = {}
        for name, value in self.model_dump(mode="json", include=counted).items():
            path = getattr(self, name)
            made |= {f"{name}_sha256": sha256(path)} if isinstance(path, Path) else {name: value}
        if self.motion is None and self.cameras is None:
            del made["fps"]  # nothing knows of seconds
        if self.motion is not None:
            made["motion_sha256"] = [made["motion_sha256"], *map(sha256, Motion.read(self.motion).maps)]
        for model, said in zip(self.meshes, made["meshes"]):
            del said["file"]
            said["sha256"] = sha256(model.file)
        if self.denoiser is None:
            made["denoise"] = self.estimation().filtered  # what null comes to
        if (filmed := self.scene.with_name(CAMERAS)).is_file():
            made["filmed_sha256"] = sha256(filmed)
        if is_of_capture(self.light, self.scene):
            made["turned_with_scene"] = True
        decided = {"frames": frames, "up": [round(float(value), 6) for value in up]}
        return made | decided | self.estimation().model_dump(mode="json") | {"version": tron.__version__}

    @property
    def tuned(self) -> list[str]:
        """Settings of the neural renderer that were chosen."""
        chosen = {
            "window": self.window,
            "weights": self.weights,
            "overlap": self.overlap != "anchor",
            "reproject": self.reproject != 5,
        }
        return [name for name, given in chosen.items() if given]

    @property
    def denoiser(self) -> str | None:
        """Name of the denoiser that the relit picture goes through."""
        return None if isinstance(self.denoise, bool) else self.denoise

    @property
    def takes_default(self) -> bool:
        """Whether the checkpoint is the one that nobody asked for, which may give way."""
        return self.checkpoint is not None and str(self.checkpoint) == AUTO

    @property
    def source(self) -> Literal["neural", "lit", "shadowed"]:
        """Origin of the relit picture."""
        if self.checkpoint is not None:
            return "neural"
        return "lit" if self.bounces else "shadowed"

    def by_light(self) -> list[Settings]:
        """The settings that give each environment's frames alone.

        Raises:
            TronError: two environments would share a folder.
        """
        if isinstance(self.environment, Path) or len(self.environment) == 1:
            only = self.environment if isinstance(self.environment, Path) else self.environment[0]
            return [self.model_copy(update={"environment": only})]
        stems = [path.stem for path in self.environment]
        twice = [path for path in self.environment if stems.count(path.stem) > 1]
        if twice:
            named = ", ".join(map(str, twice))
            raise TronError("environments of one name would share a folder", named, "rename one of them")
        return [
            self.model_copy(update={"environment": path, "output_dir": self.output_dir / path.stem})
            for path in self.environment
        ]

    def shaped(self) -> Settings:
        """The settings with the size and the field of view of frames, as the photos have them where known."""
        from tron.io.cameras.registry import cameras_of
        from tron.scans.camera_files import CAMERAS, frame_size

        path = self.cameras or self.scene.with_name(CAMERAS)
        shape, fov = (LONGER_SIDE, LONGER_SIDE), 40.0
        if path.is_file():
            try:
                first = cameras_of(path)[0]
            except TronError:
                if self.cameras is not None:
                    raise
            else:
                shape = first.width, first.height
                fov = first.fov_deg
        width, height = self.width, self.height
        if width is None and height is None:
            width, height = frame_size(shape, LONGER_SIDE)
        elif width is None and height is not None:
            width, _ = frame_size(shape, round(height * max(shape) / shape[1]))
        elif height is None and width is not None:
            _, height = frame_size(shape, round(width * max(shape) / shape[0]))
        return self.model_copy(update={"width": width, "height": height, "fov": self.fov or fov})

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of frames, where these are :meth:`shaped`."""
        assert self.width is not None
        assert self.height is not None
        return self.width, self.height

    @property
    def light(self) -> Path:
        """File of the environment, where these are the settings of one light alone (`by_light`)."""
        assert isinstance(self.environment, Path)
        return self.environment

    def rotations(self, frames: int) -> list[float]:
        """Turn of the environment in each of so many frames, degrees.

        From a to b the end is left out, so that a whole turn loops: a + (b - a) i / n.
        """
        first, end = self.rotation if isinstance(self.rotation, tuple) else (self.rotation, self.rotation)
        return [first + (end - first) * index / frames for index in range(frames)]
