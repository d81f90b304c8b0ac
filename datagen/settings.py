"""The settings of ``tron-datagen``: what every key means, and what it may be."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import (
    BaseModel,
    Field,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    field_validator,
    model_validator,
)

from datagen.capture_settings import CaptureSettings
from datagen.captured_settings import CapturedSettings
from datagen.lights import PROCEDURAL, Family, LightChoice
from datagen.pseudo_capture_settings import PseudoCaptureSettings
from datagen.scale_settings import SCALING, ScaleSettings
from datagen.settings_model import SettingsModel
from datagen.split_settings import SplitSettings
from datagen.surfel_settings import SurfelReconstruction, SurfelSources
from tron.estimation import FINAL, Diffuse, Estimation, Estimator, require_bounces
from tron.nested import leaves

Mode = Literal["make", "plan", "validate", "merge", "captures", "pseudo_captures", "equal_error", "sharing"]
Split = Literal["train", "train_b", "validation", "test"]
OUTSIDE = {
    *("output_dir", "mode", "only", "workers", "worker_timeout", "recycle_after", "scene_timeout", "cluster"),
    *("capture", "pseudo_capture", "equal_error", "sharing", "variety_against", "disjoint_from"),
    *SCALING,
}
"""Keys that decide where, by whom and how much of a dataset is made, and nothing of what is in it."""

ESTIMATED = ("estimator", "two_sided", "diffuse", "bounces", "reflections", "supersample")
"""Keys that decide how light on the surfels is estimated, named as in Estimation."""

CAPTURED = {
    "seed": True,
    "test": {"style", "frames"},
    "path_frames": True,
    "objects": True,
    "families": True,
    "mesh_edge": True,
    "texels_per_unit": True,
    "environment_height": True,
    "assets": True,
    "asset_names": True,
    "asset_share": True,
    "textures": True,
    "texture_share": True,
    "environments": True,
    "map_share": True,
    "share_maps": True,
    "share_models": True,
    "checklist": True,
    "catalogue": True,
    "allow_unlicensed": True,
    "variant": True,
    "capture": {
        *("lights", "views", "width", "height", "path_spp", "reference_spp", "points"),
        *("photographs", "sensor", "relights", "relight_spp"),
    },
}
"""Keys that decide what is in a capture."""

OF_CAPTURES = {"source", "captures", "captured"}
"""Keys of source=captured alone; the other source ignores ``captured``."""

OF_BOTH_SOURCES = {"seed", "clips_per_shard", "variant", *ESTIMATED}
"""Keys that decide what is in a dataset of either source."""

SPLITS: tuple[Split, ...] = ("train", "train_b", "validation", "test")

RELIT = "_relit"
"""Behind the name of a split: its captures under lights that their photos never saw."""

SHARD_SPLITS: tuple[str, ...] = tuple(f"{name}{suffix}" for suffix in ("", RELIT) for name in SPLITS)
"""Splits that shards may be of."""


class EqualErrorSettings(SettingsModel):
    """Comparison of guidance with the path tracer, on the test scenes of a dataset."""

    reference_spp: int = Field(
        default=1024, ge=2, multiple_of=2, description="Paths per pixel of what counts as the truth."
    )
    rounds: int = Field(default=3, ge=1, le=100, description="Times that each frame is rendered, in turns.")
    threads: int | None = Field(default=None, ge=1, description="Threads of both renderers; null: all.")


class SharingSettings(SettingsModel):
    """Comparison of frames under 20 lights one by one and together, on scenes drawn as the test split's."""

    scenes: int = Field(default=2, ge=1, le=1000, description="Number of scenes.")
    size: int = Field(default=48, ge=8, le=2048, description="Width and height of the frames in pixels.")
    path_spp: int = Field(default=64, ge=4, description="Paths per pixel of frames one by one.")
    rounds: int = Field(default=3, ge=1, le=100, description="Times that each way is rendered, in turns.")
    threads: int | None = Field(default=1, ge=1, description="Threads of both ways; null: all.")


class Settings(ScaleSettings):
    """Settings of ``tron-datagen``."""

    output_dir: Path = Field(description="Folder of the dataset; an interrupted run resumes there.")
    mode: Mode = Field(
        "make",
        description="make the dataset; plan it: print what is missing, the bytes and hours it takes and the "
        "memory of a worker, measured by a small probe here, and render nothing else; validate the one in "
        "output_dir and list every problem; join the parts in `merge`; path-trace captures for "
        "tron-reconstruct into "
        "output_dir/captures; photograph the splits' scenes as a phone would, with the truth kept apart in "
        "output_dir/truth (pseudo_captures); measure on the test scenes in output_dir how long the path "
        "tracer takes to be as near the truth as guidance is (equal_error); or measure what it saves to "
        "path-trace under many lights at once (sharing).",
    )
    seed: int = Field(
        0, description="Root of all randomness; a scene depends on it, its split and its index alone."
    )
    source: Literal["synthetic", "captured"] = Field(
        "synthetic",
        description="What is made: synthetic scenes, drawn from seeds and path-traced; or captured ones: "
        "each folder of photos in captures is reconstructed and lit, and its photos are the truth. Only "
        "seed, clips_per_shard, variant, estimation of the light and keys of the run concern both: other "
        "keys of synthetic scenes are refused with captured.",
    )
    captures: Path | None = Field(
        None,
        description="Local folder with a capture a sub-folder, whatever tron-reconstruct reads, for "
        "source=captured.",
    )
    captured: CapturedSettings = Field(
        default_factory=lambda: CapturedSettings(), description="Training pairs of captures."
    )
    train: SplitSettings = Field(SplitSettings(scenes=16), description="First training split.")
    train_b: SplitSettings = Field(
        SplitSettings(scenes=4, style="B"), description="Second training split, of another distribution."
    )
    validation: SplitSettings = Field(
        SplitSettings(scenes=2, lights=["any"] * 2),
        description="Scenes whose PSNR training shows; nothing is trained on them.",
    )
    test: SplitSettings = Field(
        SplitSettings(scenes=4, lights=["sun", "studio", "overcast"], reference_buffers=True),
        description="Held-out scenes under held-out lights, for evaluation alone: training never reads them.",
    )
    capture: CaptureSettings = Field(
        CaptureSettings(), description="Captures to reconstruct, of the test scenes."
    )
    pseudo_capture: PseudoCaptureSettings = Field(
        PseudoCaptureSettings(), description="Captures whose truth is hidden, of the splits' scenes."
    )
    sharing: SharingSettings = Field(
        SharingSettings(),
        description="What mode=sharing measures: how many times as fast a frame is path-traced under 10 "
        "lights of high and 10 of low contrast together as one by one, at equal mean error.",
    )
    equal_error: EqualErrorSettings = Field(
        EqualErrorSettings(), description="Comparison of guidance with the path tracer."
    )
    path_frames: int = Field(
        93, ge=1, le=100_000, description="Frames of the whole path that clips are cut from."
    )
    objects: tuple[int, int] | None = Field(
        None,
        description="Least and greatest number of objects of a scene, such as [2,4]; null takes the style's "
        "own.",
        examples=["[2,4]"],
    )
    families: list[Family] | None = Field(
        None,
        description="Light families that any, high, medium and low draw from, a list as above; null: [hdri] "
        f"where environments is given; else any draws from [{', '.join(PROCEDURAL)}] in styles A and B, in "
        "the others from the usual ones more often, and high, medium and low from every family but hdri.",
        examples=["[sun,overcast]"],
    )
    views: int = Field(64, ge=1, description="Views whose G-buffers the surfels are made from.")
    view_width: int = Field(256, ge=8, le=8192, description="Width of those views in pixels.")
    view_height: int = Field(256, ge=8, le=8192, description="Height of those views in pixels.")
    surfels: int = Field(60_000, ge=100, description="Approximate number of surfels of a scene.")
    refine_steps: int = Field(
        200,
        ge=0,
        le=100_000,
        description="Optimisation steps that fit a scene's surfels to its G-buffers; 0 takes them as made.",
    )
    surfels_from: SurfelSources = Field(
        SurfelSources(),
        description="What scenes' surfels are made from: gbuffers, reconstruction, or shares of the scenes.",
        examples=["{gbuffers: 3, reconstruction: 1}"],
    )
    surfel_reconstruction: SurfelReconstruction = Field(
        SurfelReconstruction(), description="Reconstruction of surfels, where they are made by it."
    )
    estimator: Estimator = Field(
        FINAL.estimator,
        description="Irradiance of the surfels. ratio: unshadowed irradiance times the share of it that "
        "arrives; plain: the Monte Carlo mean, as in the paper.",
    )
    two_sided: bool = Field(
        FINAL.two_sided,
        description="Back faces block the surfels' shadow rays beyond two spacings; false: never, as in the "
        "paper.",
    )
    diffuse: Diffuse = Field(
        FINAL.diffuse,
        description="Material that the surfels are shaded with: principled, as the path tracer's; lambert, "
        "as in the paper.",
    )
    bounces: int = Field(
        FINAL.bounces,
        ge=0,
        le=16,
        description="Times that light bounces between the surfels in lit; 0: lit is direct light alone.",
    )
    reflections: int = Field(
        FINAL.reflections,
        ge=0,
        description="Rays per pixel that find what glossy surfels mirror; 0: the bounced light around them.",
    )
    supersample: Literal[1, 2] = Field(
        FINAL.supersample,
        description="2: guidance on 2 x 2 sub-pixels with a quarter of the rays each, averaged.",
    )
    mesh_edge: float = Field(
        0.04,
        gt=0,
        le=1,
        description="Longest edge of procedural meshes in world units.",
    )
    texels_per_unit: float | None = Field(
        None,
        gt=0,
        le=4096,
        description="Texels a world unit of the textures on procedural pieces; null: two along a pixel of "
        "frames and views at the median distance of cameras and things. A scene has 64 for each pixel of a "
        "frame at most, between one and eight million; where those are too few, the log says how many a unit "
        "they are.",
    )
    environment_height: int = Field(
        256, ge=8, le=8192, description="Rows of the lat-long maps that lights are baked to."
    )
    assets: Path | None = Field(None, description="Folder of .gltf, .glb and .obj models to use as objects.")
    asset_names: list[str] = Field(
        default_factory=list, description="Names of the assets to use; empty: all in the folder."
    )
    asset_share: float = Field(
        1.0, ge=0, le=1, description="Share of objects drawn from assets, where given."
    )
    textures: Path | None = Field(
        None, description="Folder of PBR texture sets to lay on procedural pieces whose role they suit."
    )
    texture_share: float = Field(
        0.5, ge=0, le=1, description="Share of pieces with a texture set, among those that one suits."
    )
    environments: Path | None = Field(None, description="Folder of .hdr and .exr maps to use as lights.")
    map_share: float = Field(
        1.0,
        ge=0,
        le=1,
        description="Share of lights drawn from environments, where given, of those that any or a contrast "
        "asks for.",
    )
    share_models: bool = Field(
        False,
        description="All models and texture sets serve every split; false: every fourth of each serves the "
        "test split alone, where there are four.",
    )
    checklist: str | None = Field(
        None,
        description="Named maps and models of a benchmark, a YAML file or tron_synth: of environments those "
        "alone are used; for what is missing something procedural stands in, by share, and mode=plan lists "
        "it.",
    )
    disjoint_from: list[Path] = Field(
        default_factory=list,
        description="Folders of datasets that are trained on: a model, texture or map of theirs, by hash, or "
        "a scene is refused before any is made; with mode=validate it is a problem.",
    )
    share_maps: bool = Field(
        False,
        description="All maps light every split; false: every fourth lights the test split alone, where "
        "there are four.",
    )
    catalogue: Path | None = Field(
        None,
        description="JSON list of path, licence, author, source; null: catalogue.json in each folder.",
    )
    allow_unlicensed: list[str] = Field(
        default_factory=list,
        description="Names of assets and maps to use although the catalogue has no licence.",
    )
    only: list[str] = Field(default_factory=list, description="Make these scenes only, such as train-000012.")
    variety_against: Path | None = Field(
        None,
        description="Folder of another dataset whose histograms are drawn beside this one's in README.md.",
    )
    clips_per_shard: int = Field(
        64, ge=1, description="Maximum number of clips of a shard; no shard spans two scenes."
    )
    variant: Literal["llvm_ad_rgb", "cuda_ad_rgb"] = Field(
        "llvm_ad_rgb", description="Mitsuba variant; on cuda_ad_rgb bytes are not repeatable."
    )
    workers: int | None = Field(
        None,
        ge=1,
        description="Worker processes of the cluster; null: one per core with cluster=local.",
    )
    worker_timeout: float = Field(
        600.0, gt=0, description="Seconds to wait for the cluster's first worker: jobs may queue for long."
    )
    recycle_after: int = Field(
        50,
        ge=1,
        description="Scenes a worker makes before it is replaced, while the others go on; not with "
        "cluster=address.",
    )
    scene_timeout: float | None = Field(
        None,
        gt=0,
        description="Seconds after which a scene fails and its worker is killed and replaced; null: 20 times "
        "the median of its split so far, 600 at the least, and a day until three are made. With cluster=none "
        "it is only told.",
    )
    cluster: dict[str, Any] | None = Field(
        None,
        description="Where scenes are made, see cluster=NAME below; `tron-datagen cluster=NAME --help` lists "
        "its keys, conf/datagen/cluster says what they mean.",
    )

    @field_validator(*SPLITS, mode="wrap")
    @classmethod
    def _judge_what_is_made(
        cls, value: Any, handler: ValidatorFunctionWrapHandler, info: ValidationInfo
    ) -> SplitSettings:
        """A split without scenes may say what it likes; captures have the test split's style."""
        captures = info.data.get("mode") == "captures"
        made = info.field_name == "test" if captures else not _without_scenes(value)
        if made or not isinstance(value, Mapping | SplitSettings):
            return handler(value)
        return SplitSettings.model_construct(**dict(value))

    @field_validator("cluster", mode="before")
    @classmethod
    def _no_cluster(cls, value: Any) -> Any:
        if value and "_target_" not in value:
            raise ValueError("a cluster has a _target_: choose one by cluster=NAME")
        return value or None

    @field_validator("captures", mode="before")
    @classmethod
    def _local_captures(cls, value: Any) -> Any:
        if "://" in str(value):
            raise ValueError("captures must be a local folder, not an address: copy them here first")
        return value

    @model_validator(mode="after")
    def _consistent(self) -> Settings:
        if self.source == "captured":
            self._require_captured()
            return self
        if self.captures is not None:
            raise ValueError("captures is of source=captured: give source=captured, or leave it out")
        if self.mode in ("captures", "pseudo_captures"):
            for name in ("shard", "store"):
                if getattr(self, name):
                    raise ValueError(f"{name} is of datasets: leave it out with mode={self.mode}")
        captures = self.mode == "captures"
        lights = {"capture": self.capture.lights} if captures else {}
        for name in ["test"] if captures else self.used_splits():
            split = self.split(name)
            if split.frames > self.path_frames:
                raise ValueError(
                    f"{name}.frames is {split.frames}, longer than path_frames, {self.path_frames}"
                )
            if self.mode == "pseudo_captures":
                lights["pseudo_capture"] = [*self.pseudo_capture.lights, *self.pseudo_capture.relights]
            elif not captures:
                lights[name] = split.lights
        for name, wanted in lights.items():
            if self.environments is None and self._ask_hdri(wanted):
                raise ValueError(f"{name}.lights or families ask for hdri: give environments=FOLDER")
        if self.objects is not None and not 1 <= self.objects[0] <= self.objects[1]:
            raise ValueError("objects must be [least, greatest] with 1 <= least <= greatest")
        require_bounces(self.bounces, self.reflections)
        return self

    def _require_captured(self) -> None:
        """Raise ValueError where keys do not go with source=captured."""
        if self.captures is None:
            raise ValueError("source=captured needs captures=DIR, a folder with a capture a sub-folder")
        if self.mode not in ("make", "plan", "validate", "merge"):
            raise ValueError(f"mode={self.mode} is of source=synthetic")
        ours = OF_CAPTURES | OF_BOTH_SOURCES | OUTSIDE - {"variety_against", "disjoint_from"}
        for name, field in type(self).model_fields.items():
            default = field.get_default(call_default_factory=True)
            if name not in ours and getattr(self, name) != default:
                key = _first_difference(name, getattr(self, name), default)
                raise ValueError(f"{key} is of source=synthetic: leave it out with source=captured")
        require_bounces(self.bounces, self.reflections)

    def _ask_hdri(self, lights: list[LightChoice]) -> bool:
        return "hdri" in {*lights, *(self.light_families() or ())}

    def split(self, name: str) -> SplitSettings:
        """The settings of one split; of captures, how large and long its clips are."""
        if self.source == "captured":
            wanted = self.captured
            size = {key: getattr(wanted, key) for key in ("width", "height", "guidance_spp")}
            frames = wanted.relit_frames if name.endswith(RELIT) else wanted.frames
            return SplitSettings(scenes=0, lights=["any"], frames=frames, **size)
        return getattr(self, name)

    def estimation(self, split: str) -> Estimation:
        """Estimation of the light on the surfels."""
        chosen = {name: getattr(self, name) for name in ESTIMATED}
        return Estimation(rays=self.split(split).guidance_spp, **chosen)

    def used_splits(self) -> list[Split]:
        """The splits that have scenes; of captures, those that may have some."""
        if self.source == "captured":
            if self.captured.split_by_name:
                return list(SPLITS)
            return [name for name in SPLITS if getattr(self.captured.shares, name)]
        return [name for name in SPLITS if self.split(name).scenes]

    def light_families(self) -> list[Family] | None:
        """The families that ``any`` chooses from; None: the style's own."""
        if self.families is not None:
            return list(self.families)
        return ["hdri"] if self.environments is not None else None

    def recipe(self) -> dict[str, Any]:
        """Keys that decide a scene's content, plain values: not where it goes, who makes it or how many."""
        if self.source == "captured":
            seeded = {"reconstruction": {"seed", "checkpoint_every"}, "light": {"seed"}}
            places = dict.fromkeys(("names", "relit", "truth", "reconstructed"), True)
            values = self.model_dump(
                mode="json",
                include={"source", "captured", *OF_BOTH_SOURCES},
                exclude={"captured": {**places, **seeded}},
            )
            # That there are such clips, not where their truth lies.
            given = {"relit": self.captured.relit, "truth": self.captured.truth}
            values["captured"] |= {name: True for name, folder in given.items() if folder is not None}
            return values
        values = self.model_dump(mode="json", exclude=OUTSIDE | OF_CAPTURES)
        for name in SPLITS:
            if name in self.used_splits():
                del values[name]["scenes"]
            else:
                del values[name]
        return values

    def capture_recipe(self) -> dict[str, Any]:
        """Keys that decide a capture's content, as plain values."""
        return self.model_dump(mode="json", include=CAPTURED)

    def pseudo_capture_recipe(self) -> dict[str, Any]:
        """Keys that decide a pseudo-capture's content, as plain values; of the splits that have scenes."""
        splits = {name: {"style", "frames"} for name in self.used_splits()}
        shared = {key: True for key in CAPTURED if key not in ("capture", "test")}
        return self.model_dump(mode="json", include={**shared, **splits, "pseudo_capture": True})


def _without_scenes(split: Any) -> bool:
    return isinstance(split, Mapping) and split.get("scenes") == 0


def _first_difference(name: str, value: Any, default: Any) -> str:
    """Dotted key, as it is typed, of the first setting below ``name`` that is not the default's."""
    if not isinstance(value, BaseModel) or not isinstance(default, BaseModel):
        return name
    given, shipped = (leaves({name: each.model_dump(mode="json")}) for each in (value, default))
    return next((key for key in given if given[key] != shipped.get(key)), name)
