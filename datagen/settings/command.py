"""The settings of ``tron-datagen``, with their ranges and checks."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import (
    BaseModel,
    Field,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    field_validator,
    model_validator,
)

from datagen.settings import Family, LightChoice, SettingsModel
from datagen.settings.captures import CapturedSettings, CaptureSettings, PseudoCaptureSettings
from datagen.settings.split import SplitSettings, SurfelReconstruction, SurfelSources
from datagen.settings.surfels import AUTO, Auto, SurfelBudget, surfels_by_pixels
from tron.errors import TronError
from tron.estimation import FINAL, FINEST, PREVIEW, Brdf, Estimation, Estimator, require_bounces
from tron.run_folder import leaves
from tron.seeds import generator

Mode = Literal["make", "plan", "validate", "merge", "captures", "pseudo_captures", "equal_error", "publish"]
Split = Literal["train", "train_b", "validation", "test"]
SHARD = re.compile(r"([1-9][0-9]{0,8})/([1-9][0-9]{0,8})")
SCALING = ("shard", "merge", "merge_incomplete", "store", "publish", "licence")
"""Keys that decide where parts of a dataset are made and kept, and nothing of what is in it."""

Item = TypeVar("Item")

OUTSIDE = {
    *("output_dir", "mode", "only", "workers", "worker_timeout", "recycle_after", "scene_timeout", "cluster"),
    *("capture", "pseudo_capture", "equal_error", "variety_against", "disjoint_from"),
    *SCALING,
}
"""Keys that decide where, by whom and how much of a dataset is made, and nothing of what is in it."""

ESTIMATED = ("estimator", "two_sided", "brdf", "bounces", "reflections", "supersample")
"""Keys that decide how light on the surfels is estimated, named as in Estimation."""

OF_FRAMES = ("rays", "filtered", "reflections", "supersample")
"""Those of an Estimation that a quality of tron-relight chooses."""

OF_A_SCENE = {"style", "things", "materials", "frames"}
"""Keys of a split that decide what stands in a scene and along which path it is filmed."""

CAPTURED: dict[str, Any] = {
    **dict.fromkeys(("seed", "path_frames", "objects", "families", "mesh_edge", "texels_per_unit"), True),
    **dict.fromkeys(("environment_height", "assets", "asset_names", "asset_share", "textures"), True),
    **dict.fromkeys(("texture_share", "environments", "map_share", "share_maps", "share_models"), True),
    **dict.fromkeys(("checklist", "catalogue", "allow_unlicensed", "variant"), True),
    "test": OF_A_SCENE,
    "capture": set(CaptureSettings.model_fields) - {"scenes"},
}
"""Keys that decide what is in a capture."""

METER = "balanced"
"""What the camera of pseudo-captures does (``datagen.photographs.meter``); recipes without the key are of a
camera that neither balanced white nor metered."""

FIT = "windows"
"""How surfels are fitted to their views (``datagen.sources.refinement``); recipes without the key compared
whole views by structural similarity too."""

OF_CAPTURES = {"source", "captures", "captured"}
"""Keys of source=captured alone; the other source ignores ``captured``."""

OF_BOTH_SOURCES = {"seed", "clips_per_shard", "variant", *ESTIMATED}
"""Keys that decide what is in a dataset of either source."""

TEST_LIGHTS: list[LightChoice] = ["sun", "studio", "overcast"]
"""Lights of the test split, unless the user gave some."""

SPLITS: tuple[Split, ...] = ("train", "train_b", "validation", "test")

RELIT = "_relit"
"""Behind the name of a split: its captures under lights that their photos never saw."""

SHARD_SPLITS: tuple[str, ...] = tuple(f"{name}{suffix}" for suffix in ("", RELIT) for name in SPLITS)
"""Splits that shards may be of."""


class ScaleSettings(SettingsModel):
    """Parts of a dataset, and where its shards go."""

    shard: str | None = Field(
        None,
        description="Make one of n disjoint parts, i/n with 1 <= i <= n: every n-th scene of the plan, with "
        "the names and bytes of a run of all. Each part has an output_dir of its own; mode=merge joins them.",
        examples=["2/8"],
    )
    merge: list[Path] = Field(
        default_factory=list, description="Folders of the parts that mode=merge joins in output_dir."
    )
    merge_incomplete: bool = Field(
        False, description="Join parts although scenes of the dataset are in none of them."
    )
    store: str | None = Field(
        None,
        description="URL that fsspec writes to, such as s3://bucket/dataset: finished shards are sent there "
        "and leave output_dir; the other files follow at the end. mode=validate checks what is there. "
        "Credentials are the environment's.",
        examples=["s3://bucket/dataset"],
    )

    publish: Path | None = Field(
        None, description="Folder for the Hub that mode=publish makes of the dataset in output_dir."
    )
    licence: str | None = Field(
        None, description="Licence of a published dataset, by the Hub's names; none: that of its files."
    )

    @field_validator("shard")
    @classmethod
    def _one_of_n(cls, value: str | None) -> str | None:
        if value is not None:
            found = SHARD.fullmatch(value)
            if found is None or int(found[1]) > int(found[2]):
                raise ValueError("give i/n with 1 <= i <= n, such as 2/8")
        return value

    @field_validator("store")
    @classmethod
    def _a_url(cls, value: str | None) -> str | None:
        if value is not None and "://" not in value:
            raise ValueError("give a URL, such as s3://bucket/dataset")
        return value if value is None else value.rstrip("/")


class EqualErrorSettings(SettingsModel):
    """Comparison of guidance with the path tracer, on the test scenes of a dataset."""

    reference_spp: int = Field(
        default=1024, ge=2, multiple_of=2, description="Paths per pixel of the reference."
    )
    rounds: int = Field(
        default=3, ge=1, le=100, description="Number of times that each frame is rendered, in turns."
    )


def _listed(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]


class Settings(ScaleSettings):
    """Settings of ``tron-datagen``."""

    output_dir: Path = Field(description="Folder of the dataset; an interrupted run resumes there.")
    mode: Mode = Field(
        "make",
        description="make the dataset; plan it: print what is missing, the bytes and hours it takes and the "
        "memory of a worker, by a table of measured costs, and render nothing; validate the one in "
        "output_dir and list every problem; join the parts in `merge`; publish it: a folder "
        "for the Hub; path-trace captures for tron-reconstruct into "
        "output_dir/captures; photograph the splits' scenes as a phone would, with the truth kept apart in "
        "output_dir/truth (pseudo_captures); or measure on the test scenes in output_dir how long the path "
        "tracer takes to be as near the truth as guidance is (equal_error).",
    )
    seed: int = Field(
        0, description="Root of all randomness; a scene depends only on this seed, its split and its index."
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
        description="Local folder with one sub-folder per capture, in any format that tron-reconstruct "
        "reads, for source=captured.",
    )
    captured: CapturedSettings = Field(
        default_factory=lambda: CapturedSettings(), description="Training pairs of captures."
    )
    # Those with words of registries are not checked, which would import these.
    train: SplitSettings = Field(SplitSettings(scenes=16), description="First training split.")
    train_b: SplitSettings = Field(
        SplitSettings.model_construct(scenes=4, style="object"),
        description="Second training split, of another distribution.",
    )
    validation: SplitSettings = Field(
        SplitSettings.model_construct(scenes=2, lights=["any"] * 2),
        description="Scenes for the PSNR shown during training; networks are not trained on them.",
    )
    test: SplitSettings = Field(
        SplitSettings(scenes=4, lights=[], reference_buffers=True),
        description="Held-out scenes under held-out lights, for evaluation alone: training never reads them.",
    )
    capture: CaptureSettings = Field(
        CaptureSettings(), description="Captures of the test scenes, to reconstruct."
    )
    pseudo_capture: PseudoCaptureSettings = Field(
        PseudoCaptureSettings(),
        description="Pseudo-captures of the splits' scenes, with the truth in separate folders.",
    )
    equal_error: EqualErrorSettings = Field(
        EqualErrorSettings(), description="Comparison of guidance with the path tracer."
    )
    path_frames: int = Field(
        93, ge=1, le=100_000, description="Frames of the whole path that clips are cut from."
    )
    objects: tuple[int, int] | None = Field(
        None,
        description="Least and greatest number of objects of a scene, such as [2,4]; null: as in the style.",
        examples=["[2,4]"],
    )
    families: list[Family] | None = Field(
        None,
        description="Light families that any, high, medium and low draw from, a list as above; null: [hdri] "
        "where environments is given; else any draws from the usual ones more often, and high, medium and "
        "low from every family but hdri.",
        examples=["[sun,overcast]"],
    )
    views: Annotated[int, Field(ge=1)] | Auto = Field(
        AUTO, description="Number of views whose G-buffers the surfels are made from; auto: as for surfels."
    )
    view_width: Annotated[int, Field(ge=8, le=8192)] | Auto = Field(
        AUTO, description="Width of these views in pixels; auto: as for surfels."
    )
    view_height: Annotated[int, Field(ge=8, le=8192)] | Auto = Field(
        AUTO, description="Height of these views in pixels; auto: as for surfels."
    )
    surfels: Annotated[int, Field(ge=100)] | Auto = Field(
        AUTO,
        description="Approximate number of surfels of a scene; auto: as suits the split's frames, with "
        "their views and steps: 20,000 from 32 views of 192 x 192 in 100 steps for frames of 128 x 128; "
        "100,000 from 384 x 384 in 400 for 512 x 512.",
    )
    refine_steps: Annotated[int, Field(ge=0, le=100_000)] | Auto = Field(
        AUTO,
        description="Optimisation steps that fit a scene's surfels to its G-buffers; 0: no fit; auto: as "
        "for surfels.",
    )
    surfels_from: SurfelSources = Field(
        SurfelSources(),
        description="Source of the surfels of scenes: gbuffers, reconstruction, or shares of both.",
        examples=["{gbuffers: 3, reconstruction: 1}"],
    )
    surfel_reconstruction: SurfelReconstruction = Field(
        SurfelReconstruction(), description="Settings of the reconstruction of surfels, for surfels_from."
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
    brdf: Brdf = Field(
        FINAL.brdf,
        description="Material of the surfels in shading: conserving, as in the path tracer; lambert, as "
        "in the paper.",
    )
    bounces: int = Field(
        FINAL.bounces,
        ge=0,
        le=16,
        description="Number of bounces of light between surfels in lit; 0: lit is direct light alone.",
    )
    reflections: int = Field(
        FINAL.reflections,
        ge=0,
        description="Reflection rays per pixel for glossy surfels; 0: bounced light around them instead.",
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
        description="Texels per world unit of the textures on procedural pieces; null: two per pixel of "
        "frames and views, at the median distance between cameras and objects. A scene has at "
        "most 64 texels per pixel of a frame, between one and eight million in all; if this "
        "limits the density, the log gives it.",
    )
    environment_height: int = Field(
        256, ge=8, le=8192, description="Rows of the lat-long maps that lights are baked to."
    )
    assets: Path | None = Field(None, description="Folder of .gltf, .glb and .obj models to use as objects.")
    asset_names: list[str] = Field(
        default_factory=list, description="Names of the assets to use; empty: all in the folder."
    )
    asset_share: float = Field(
        1.0, ge=0, le=1, description="Share of objects drawn from assets, if assets is given."
    )
    textures: Path | None = Field(
        None, description="Folder of PBR texture sets for procedural pieces with a matching role."
    )
    texture_share: float = Field(
        0.5, ge=0, le=1, description="Share of pieces with a texture set, among pieces with a matching set."
    )
    environments: Path | None = Field(None, description="Folder of .hdr and .exr maps to use as lights.")
    map_share: float = Field(
        1.0,
        ge=0,
        le=1,
        description="Share of lights drawn from environments, if given, among lights that any or a "
        "contrast asks for.",
    )
    share_models: bool = Field(
        False,
        description="All models and texture sets are used in every split; false: every fourth is for the "
        "test split alone, if there are four.",
    )
    checklist: str | None = Field(
        None,
        description="Named maps and models of a benchmark, a YAML file or tron_synth: of environments "
        "only these are used. Procedural ones stand in for missing files, by share, and "
        "mode=plan lists them.",
    )
    disjoint_from: list[Path] = Field(
        default_factory=list,
        description="Folders of training datasets: a model, texture or map in common, by hash, or a scene "
        "in common is refused before any scene is made; with mode=validate it is a problem.",
    )
    share_maps: bool = Field(
        False,
        description="All maps light every split; false: every fourth lights the test split alone, if "
        "there are four.",
    )
    catalogue: Path | None = Field(
        None,
        description="JSON list of path, licence, author, source; null: catalogue.json in each folder.",
    )
    allow_unlicensed: Literal["all"] | list[str] = Field(
        default_factory=list,
        description="Names of models, textures and maps to use without a licence in the catalogue; all: "
        "every file.",
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
        600.0, gt=0, description="Seconds to wait for the cluster's first worker; jobs may queue for long."
    )
    recycle_after: int = Field(
        50,
        ge=1,
        description="Number of scenes after which a worker restarts, because Mitsuba's memory grows; not "
        "with cluster=address.",
    )
    scene_timeout: float | None = Field(
        None,
        gt=0,
        description="Seconds after which a scene fails and its worker is replaced; null: 20 times the "
        "estimate of mode=plan for it, at least 600, and a day for captures that are "
        "rendered. Not with cluster=none.",
    )
    cluster: dict[str, Any] | None = Field(
        None,
        description="Where scenes are made, see cluster=NAME; `tron-datagen cluster=NAME --help cluster` "
        "lists the keys of a cluster, conf/datagen/cluster explains them.",
    )

    @field_validator(*SPLITS, mode="wrap")
    @classmethod
    def _judge_what_is_made(
        cls, value: Any, handler: ValidatorFunctionWrapHandler, info: ValidationInfo
    ) -> SplitSettings:
        """Check used splits only; captures have the test split's style."""
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
        OF_SOURCE[self.source].require(self)
        require_bounces(self.bounces, self.reflections)
        wanted = [getattr(self.split(name), "guidance_spp", None) for name in self.used_splits()]
        named = {"preview", "final"} & {rays for each in wanted for rays in _listed(each)}
        if named and (self.reflections or self.supersample != 1):
            raise ValueError(f"guidance_spp={min(named)} has reflections and sub-pixels of its own")
        if "final" in named and not self.bounces:
            raise ValueError("guidance_spp=final shows light that bounces: give bounces=4 or the like")
        return self

    def split(self, name: str) -> SplitSettings:
        """Return the settings of one split; for captures, the size and length of its clips."""
        return OF_SOURCE[self.source].split(self, name)

    def estimation(self, split: str, scene: int = 0, light: int = 0) -> Estimation:
        """Return the estimation of a clip's light on the surfels, for light number ``light``."""
        chosen = {name: getattr(self, name) for name in ESTIMATED}
        draw = generator(self.seed, split, scene, "rays")
        rays = self.split(split).rays_of(light, lambda count: draw.permutation(count))
        if isinstance(rays, int):
            return Estimation(rays=rays, **chosen)
        quality = PREVIEW if rays == "preview" else FINEST
        return Estimation.model_validate(chosen | {name: getattr(quality, name) for name in OF_FRAMES})

    def surfel_budgets(self, split: str) -> list[SurfelBudget]:
        """Return surfel budgets of a split's scenes: the given numbers, else one per size of pictures."""
        given = {name: getattr(self, name) for name in SurfelBudget._fields}
        chosen = {name: value for name, value in given.items() if value != AUTO}
        pictures = self.split(split).pictures
        return [surfels_by_pixels(width * height)._replace(**chosen) for width, height in pictures]

    def surfel_budget(self, split: str, scene: int = 0) -> SurfelBudget:
        """Return the surfel budget of one scene, which draws one of the sizes.

        Its surfels are then larger than the pixels of some windows and smaller than those of others.
        """
        budgets = self.surfel_budgets(split)
        drawn = int(generator(self.seed, split, scene, "surfels").integers(len(budgets)))
        return budgets[drawn]

    def used_splits(self) -> list[Split]:
        """Return the splits with scenes; for captures, the splits that may have some."""
        return OF_SOURCE[self.source].used_splits(self)

    def light_families(self) -> list[Family] | None:
        """Return the families for ``any``; None: the usual ones."""
        if self.families is not None:
            return list(self.families)
        return ["hdri"] if self.environments is not None else None

    def recipe(self) -> dict[str, Any]:
        """Return the keys that decide a scene's content, as plain values: no places, workers or counts."""
        return OF_SOURCE[self.source].recipe(self)

    def capture_recipe(self) -> dict[str, Any]:
        """Return the keys that decide a capture's content, as plain values."""
        return self.model_dump(mode="json", include=CAPTURED)

    def pseudo_capture_recipe(self) -> dict[str, Any]:
        """Return the keys that decide a pseudo-capture's content, as plain values; used splits only."""
        splits = dict.fromkeys(self.used_splits(), OF_A_SCENE)
        shared = {key: True for key in CAPTURED if key not in ("capture", "test")}
        values = self.model_dump(mode="json", include={**shared, **splits, "pseudo_capture": True})
        return {**values, "meter": METER}


class KeysOfSynthetic:
    """Meaning of the keys for scenes drawn from seeds; ``captured`` is ignored."""

    def require(self, settings: Settings) -> None:
        """Raise ValueError if a split cannot be drawn, or a key is for captures or datasets only."""
        if settings.captures is not None:
            raise ValueError("captures is of source=captured: give source=captured, or leave it out")
        if settings.mode in ("captures", "pseudo_captures"):
            for name in ("shard", "store"):
                if getattr(settings, name):
                    raise ValueError(f"{name} is of datasets: leave it out with mode={settings.mode}")
        captures = settings.mode == "captures"
        lights = {"capture": settings.capture.lights} if captures else {}
        for name in ["test"] if captures else self.used_splits(settings):
            split = self.split(settings, name)
            if not split.lights:
                raise ValueError(f"{name}.lights is empty: a scene has a light or more")
            if split.frames > settings.path_frames:
                raise ValueError(
                    f"{name}.frames is {split.frames}, longer than path_frames, {settings.path_frames}"
                )
            if settings.mode == "pseudo_captures":
                shots = settings.pseudo_capture
                lights["pseudo_capture"] = [*shots.lights, *shots.relights]
            elif not captures:
                lights[name] = split.lights
        for name, wanted in lights.items():
            hdri = "hdri" in {*wanted, *(settings.light_families() or ())}
            if settings.environments is None and hdri:
                raise ValueError(f"{name}.lights or families ask for hdri: give environments=FOLDER")
        if settings.objects is not None and not 1 <= settings.objects[0] <= settings.objects[1]:
            raise ValueError("objects must be [least, greatest] with 1 <= least <= greatest")

    def split(self, settings: Settings, name: str) -> SplitSettings:
        """Return the split as typed; the test split has its own default lights."""
        chosen = getattr(settings, name)
        if name == "test" and not chosen.lights:
            usual = TEST_LIGHTS if settings.environments is None else ["any"] * len(TEST_LIGHTS)
            return chosen.model_copy(update={"lights": usual})
        return chosen

    def used_splits(self, settings: Settings) -> list[Split]:
        """Return the splits with scenes."""
        return [name for name in SPLITS if self.split(settings, name).scenes]

    def recipe(self, settings: Settings) -> dict[str, Any]:
        """Return all keys except the keys of captures and of the run; only splits with scenes.

        Surfels and their views are numbers, split by split: another law of them is another recipe.
        """
        values = settings.model_dump(mode="json", exclude=OUTSIDE | OF_CAPTURES | {*SurfelBudget._fields})
        used = self.used_splits(settings)
        for name in SPLITS:
            if name in used:
                del values[name]["scenes"]
                budgets = settings.surfel_budgets(name)
                values[name] |= (
                    budgets[0]._asdict()
                    if len(budgets) == 1
                    else {"surfel_budgets": [each._asdict() for each in budgets]}
                )
            else:
                del values[name]
        values["fit"] = FIT
        if "test" in values:
            values["test"]["lights"] = self.split(settings, "test").lights
        return values


class KeysOfCaptured:
    """Meaning of the keys for folders of photos, which ``captures`` and ``captured`` describe."""

    def require(self, settings: Settings) -> None:
        """Raise ValueError without captures, or if a key is for synthetic scenes."""
        if settings.captures is None:
            raise ValueError("source=captured needs captures=DIR, a folder with a capture a sub-folder")
        if settings.mode not in ("make", "plan", "validate", "merge", "publish"):
            raise ValueError(f"mode={settings.mode} is of source=synthetic")
        ours = OF_CAPTURES | OF_BOTH_SOURCES | OUTSIDE - {"variety_against", "disjoint_from"}
        for name, field in Settings.model_fields.items():
            default = field.get_default(call_default_factory=True)
            if name not in ours and getattr(settings, name) != default:
                key = _first_difference(name, getattr(settings, name), default)
                raise ValueError(f"{key} is of source=synthetic: leave it out with source=captured")

    def split(self, settings: Settings, name: str) -> SplitSettings:
        """Return the size and length of its clips; no scene is drawn."""
        wanted = settings.captured
        size = {key: getattr(wanted, key) for key in ("width", "height", "guidance_spp")}
        frames = 1 if name.endswith(RELIT) else wanted.frames
        return SplitSettings(scenes=0, lights=["any"], frames=frames, **size)

    def used_splits(self, settings: Settings) -> list[Split]:
        """Return the splits that captures may be in."""
        wanted = settings.captured
        return [name for name in SPLITS if wanted.split_by_name or getattr(wanted.shares, name)]

    def recipe(self, settings: Settings) -> dict[str, Any]:
        """Return the keys of captures and of both sources, without places and derived seeds."""
        seeded = {"reconstruction": {"seed", "checkpoint_every"}, "light": {"seed"}}
        places = dict.fromkeys(("names", "relit", "truth", "reconstructed"), True)
        values = settings.model_dump(
            mode="json",
            include={"source", "captured", *OF_BOTH_SOURCES},
            exclude={"captured": {**places, **seeded}},
        )
        # That there are such clips, not where their truth lies.
        given = {"relit": settings.captured.relit, "truth": settings.captured.truth}
        values["captured"] |= {name: True for name, folder in given.items() if folder is not None}
        return values


OF_SOURCE: dict[str, KeysOfSynthetic | KeysOfCaptured] = {
    "synthetic": KeysOfSynthetic(),
    "captured": KeysOfCaptured(),
}
"""What the keys mean, by ``source``; what is made of them, ``datagen.sources`` says."""


def _without_scenes(split: Any) -> bool:
    return isinstance(split, Mapping) and split.get("scenes") == 0


def _first_difference(name: str, value: Any, default: Any) -> str:
    """Return the dotted key, as typed, of the first non-default setting below ``name``."""
    if not isinstance(value, BaseModel) or not isinstance(default, BaseModel):
        return name
    given, shipped = (leaves({name: each.model_dump(mode="json")}) for each in (value, default))
    return next((key for key in given if given[key] != shipped.get(key)), name)


def part_of(items: Sequence[Item], shard: str | None) -> list[Item]:
    """Return the items of ``shard=i/n``: i - 1, i - 1 + n, ...; all without it.

    Raises:
        TronError: there are fewer items than parts, so that some would be empty.
    """
    if shard is None:
        return list(items)
    number, count = map(int, shard.split("/"))
    if count > len(items):
        raise TronError(
            f"shard={shard} asks for more parts than there are scenes, {len(items)}",
            mend=f"give shard=i/n with n of at most {len(items)}",
        )
    return list(items[number - 1 :: count])
