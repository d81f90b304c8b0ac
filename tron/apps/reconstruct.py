"""tron-reconstruct: a folder of photos becomes relightable surfels and the light they were taken in."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import yaml
from pydantic import BaseModel, Field

import tron
from tron.captures import Capture, LoadSettings, load_capture
from tron.captures.load import CaptureSettings
from tron.cli.command_line import command
from tron.cli.instantiation import make
from tron.cli.progress import Progress, track
from tron.images import write_image
from tron.reconstruction.settings import FitSettings, ReconstructionSettings
from tron.runtime import activate, describe_machine, set_torch_threads, torch_device
from tron.storage import locked, require_free_space, write_atomic

if TYPE_CHECKING:
    from tron.metrics import LPIPS
    from tron.reconstruction import EnvironmentFit, Reconstruction
    from tron.reconstruction.evaluation import ViewScore
    from tron.reconstruction.training import Progress as StageProgress
    from tron.reconstruction.training import Stage
    from tron.tracing import SurfelTracer

log = logging.getLogger(__name__)

SHEET_VIEWS = 6
TRAIN_VIEWS_SCORED = 8
SHADOW_RAYS = 16
CHECKPOINT = "checkpoint.safetensors"
RESULTS = ("scene.ply", "environment.exr", "metrics.json", "curve.json", "light.png", "contact_sheet.png")
SURFEL_BYTES = 1600  # PLY, checkpoint with Adam's moments, and their temporary copies


class Paths(BaseModel):
    """Capture that is reconstructed, and the folder that the files go to."""

    capture: Path = Field(description="folder of photos, with or without poses, or of path-traced views")
    output_dir: Path = Field(description="folder for scene.ply, environment.exr, metrics.json and pictures")


# Bases are listed the other way round than their keys: pydantic collects fields from the last base first.
class Settings(ReconstructionSettings, CaptureSettings, Paths):
    """Everything that tron-reconstruct can be told."""

    prior: Any = Field(description="source of normals, materials and irradiance, by _target_ (prior=NAME)")
    light: FitSettings | None = Field(
        default_factory=lambda: FitSettings(), description="environment map and scale; null fits none"
    )
    score_every: int = Field(
        0, ge=0, description="steps between two scores of the held-out views, kept in curve.json; 0: none"
    )
    lpips_weights: Path | None = Field(
        None, description="local vgg16-397923af.pth, to score LPIPS as well; nothing is downloaded"
    )
    overwrite: bool = Field(False, description="begin anew in an output_dir made with other settings")
    variant: Literal["llvm_ad_rgb", "cuda_ad_rgb"] = Field(
        "llvm_ad_rgb", description="Mitsuba variant: processor or NVIDIA GPU"
    )
    threads: int | None = Field(
        None, ge=1, description="threads of the renderer; null: all; 1 makes runs repeat bit by bit"
    )


def main(settings: Settings) -> None:
    """Turn posed photos, bare photos or path-traced views into surfels with materials, and find their light.

    Writes scene.ply, which tron-relight and every 3DGS viewer open, environment.exr, metrics.json (held-out
    and training views), contact_sheet.png (held-out views and every channel), light.png and config.yaml. A
    run that was interrupted goes on where it stopped when it is started again.
    """
    prior = make(settings.prior, "prior")
    lpips = _load_lpips(settings)
    require_free_space(settings.output_dir, settings.radiance.density.most * SURFEL_BYTES)
    activate(settings.variant, settings.threads)
    # Photos without poses take minutes to load: whatever can be refused without them is refused by now.
    capture = load_capture(settings.capture, _load_settings(settings))
    log.info(
        "%d views, %d of them held out, %d x %d, %d skipped",
        len(capture.views), len(capture.test), capture.views[0].camera.width,
        capture.views[0].camera.height, len(capture.skipped),
    )  # fmt: skip
    prior.fields(capture)  # what cannot be had is said before long work
    # Dr.Jit has the cores; the loss is small, and torch's threads would wait for theirs.
    set_torch_threads(1)
    with locked(settings.output_dir):
        _claim(settings, capture, prior)
        report = _finished(settings)
        if report is None:
            _run(settings, capture, prior, lpips)
        else:
            log.info("finished before; overwrite=true begins anew")
            _say(report, settings.output_dir)


def _load_lpips(settings: Settings) -> LPIPS | None:
    if settings.lpips_weights is None:
        return None
    from tron.metrics import LPIPS

    return LPIPS.load(settings.lpips_weights)


def _load_settings(settings: Settings) -> LoadSettings:
    return LoadSettings(
        **{name: getattr(settings, name) for name in CaptureSettings.model_fields},
        workspace=settings.output_dir / "structure_from_motion",
        threads=settings.threads or 0,
        seed=settings.seed,
    )


def _claim(settings: Settings, capture: Capture, prior: Any) -> None:
    """Keep the resolved configuration, and clear the way for a new run where that is asked for.

    Raises:
        TronError: the folder holds another run; nothing in it is changed.
    """
    from tron.reconstruction.checkpoint import Checkpoint
    from tron.reconstruction.pipeline import made_with

    if settings.overwrite:
        for name in (CHECKPOINT, *RESULTS):
            (settings.output_dir / name).unlink(missing_ok=True)
    checkpoint = settings.output_dir / CHECKPOINT
    if checkpoint.exists():
        Checkpoint(checkpoint).require(made_with(capture, prior, _only_reconstruction(settings)))
    text = yaml.safe_dump(settings.model_dump(mode="json"), sort_keys=False)
    write_atomic(settings.output_dir / "config.yaml", text)


def _finished(settings: Settings) -> dict[str, Any] | None:
    """The report of a run with these settings that came to its end, all its files still there; else None."""
    try:
        report = json.loads((settings.output_dir / "metrics.json").read_text("utf-8"))
        same = report["settings"] == json.loads(settings.model_dump_json()) | {"overwrite": False}
        files = [
            "scene.ply",
            "contact_sheet.png",
            *(["environment.exr", "light.png"] if report["light"] else []),
        ]
        complete = report["version"] == tron.__version__ and all(
            (settings.output_dir / name).is_file() for name in files
        )
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return report if same and complete else None


def _run(settings: Settings, capture: Capture, prior: Any, lpips: LPIPS | None) -> None:
    from tron.reconstruction import fit_environment, reconstruct
    from tron.reconstruction.curve import Curve
    from tron.reconstruction.evaluation import score_views
    from tron.tracing import SurfelTracer

    out = settings.output_dir
    bars = _Bars()
    curve = None
    if settings.score_every and capture.test:
        curve = Curve(out / "curve.json", capture.test_views, settings.score_every)

    def watch(progress: StageProgress, stage: Stage) -> None:
        bars.watch(progress)
        if curve is not None:
            curve.watch(progress, stage)

    try:
        found = reconstruct(
            capture, prior, _only_reconstruction(settings),
            checkpoint=out / CHECKPOINT, device=torch_device(settings.variant), watch=watch, track=track,
        )  # fmt: skip
    finally:
        bars.close()
    found.scene.save(out / "scene.ply")
    tracer = SurfelTracer(found.scene)
    started = time.perf_counter()
    light: EnvironmentFit | None = None
    if settings.light is None:
        log.info("no light is fitted: light=null")
    elif not any(view.has("irradiance") for view in found.capture.train_views):
        log.warning("the prior gives no irradiance, so no light can be fitted: there is no environment.exr")
    else:
        light = fit_environment(found.capture, tracer, settings.light, track)
        light.environment.save(out / "environment.exr")
    seconds = {"surfels": round(found.seconds, 2), "light": round(time.perf_counter() - started, 2)}
    background = settings.radiance.background
    test = score_views(tracer, capture.test_views, background, lpips, track)
    some = capture.train_views[:: max(1, len(capture.train_views) // TRAIN_VIEWS_SCORED)]
    train = score_views(tracer, some, background, lpips, track)
    _write_sheet(out / "contact_sheet.png", tracer, capture, light)
    if light is not None:
        write_image(out / "light.png", _light_picture(light))
    report = _report(settings, capture, found, light, test, train, seconds)
    if curve is not None:
        report["curve"] = curve.points
    write_atomic(out / "metrics.json", json.dumps(report, indent=1, allow_nan=False) + "\n")
    _say(report, out)


def _only_reconstruction(settings: Settings) -> ReconstructionSettings:
    names = ReconstructionSettings.model_fields
    return ReconstructionSettings(**{name: getattr(settings, name) for name in names})


class _Bars:
    """A bar for each stage as it comes."""

    def __init__(self) -> None:
        self._stage, self._bar = "", None

    def watch(self, progress: StageProgress) -> None:
        if progress.stage != self._stage:
            self.close()
            self._stage = progress.stage
            self._bar = Progress(progress.stage, progress.steps, progress.step - 1, "steps")
        if self._bar is not None:
            quality = "" if np.isnan(progress.psnr) else f"{progress.psnr:.1f} dB, "
            self._bar.update(progress.step, f"{quality}{progress.surfels:,} surfels")

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None


def _report(
    settings: Settings,
    capture: Capture,
    found: Reconstruction,
    light: EnvironmentFit | None,
    test: Sequence[ViewScore],
    train: Sequence[ViewScore],
    seconds: dict[str, float],
) -> dict[str, Any]:
    from tron.reconstruction.evaluation import mean_figures

    return {
        "version": tron.__version__,
        "capture": {
            "path": str(settings.capture),
            "views": len(capture.views),
            "held_out": sorted(capture.test),
            "skipped": dict(capture.skipped),
            "up": capture.up.tolist(),
            "transform": capture.transform.tolist(),
        },
        "surfels": len(found.scene),
        "materials_learnt": list(found.learnt),
        "test": mean_figures(test) if test else None,
        "train": mean_figures(train),
        "views": {score.view: dict(score.figures) for score in (*test, *train)},
        "albedo_scaling": "per view and channel, least squares on the subject",
        "light": None
        if light is None
        else {"sigma": light.scale.sigma, "irradiance_l1": float(np.mean(light.cubemap.loss[-50:]))},
        "seconds": seconds,
        "settings": {**settings.model_dump(mode="json"), "overwrite": False},
        "machine": describe_machine(),
    }


def _write_sheet(path: Path, tracer: SurfelTracer, capture: Capture, light: EnvironmentFit | None) -> None:
    """Held-out views (training views, if none is) with every channel of the G-buffer and the guidance."""
    from tron.apps.labelled_sheet import labelled_sheet
    from tron.color import to_display
    from tron.estimation import Estimation
    from tron.reconstruction.evaluation import picture, wanted_picture
    from tron.shading.guidance import Lighting, render_guidance

    views = capture.test_views or capture.train_views
    views = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, SHEET_VIEWS).astype(int))]
    rows: dict[str, list[np.ndarray]] = {}
    lighting = None if light is None else Lighting(light.environment)
    for number, view in enumerate(views):
        buffers = tracer.gbuffer(view.camera).numpy()
        seen, wanted = picture(buffers), wanted_picture(view)
        for name, image in {
            "photo": wanted,
            "radiance": seen,
            "error x 4": 4 * np.abs(seen - wanted),
            "opacity": buffers["opacity"],
            "depth": _relative(buffers["depth"]),
            "position": _relative(buffers["position"], buffers["opacity"] > 0.5),
            "normal": 0.5 * buffers["normal"] + 0.5,
            "base color": _srgb(buffers["base_color"]),
            "roughness": buffers["roughness"],
            "metallic": buffers["metallic"],
        }.items():
            rows.setdefault(name, []).append(image)
        if lighting is not None:
            estimation = Estimation(rays=SHADOW_RAYS, filtered=True)
            guidance = render_guidance(tracer, view.camera, lighting, estimation, number)
            for name, image in (("pbr", guidance.pbr), ("irradiance", guidance.irradiance)):
                rows.setdefault(name, []).append(to_display(image, capture.exposure))
    write_image(path, labelled_sheet(rows, [view.name for view in views]))


def _srgb(linear: np.ndarray) -> np.ndarray:
    """Base color as a picture."""
    from tron.color import linear_to_srgb

    return linear_to_srgb(np.clip(linear, 0, 1))


def _relative(values: np.ndarray, known: np.ndarray | None = None) -> np.ndarray:
    """Values spread over [0, 1], each channel for itself, strays left out; black where nothing is known."""
    known = values > 0 if known is None else known
    if not known.any():
        return np.zeros_like(values)
    low, high = np.percentile(values[known], [2, 98], axis=0)
    spread = np.clip((values - low) / np.maximum(high - low, 1e-9), 0, 1)
    return np.where(known if values.ndim == 2 else known[..., None], spread, 0)


def _light_picture(light: EnvironmentFit) -> np.ndarray:
    """The environment map, exposed as tron-relight would."""
    from tron.color import to_display

    return to_display(light.environment.image, light.environment.exposure())


def _say(report: dict[str, Any], out: Path) -> None:
    for name in ("test", "train"):
        figures = report[name]
        if figures:
            said = ", ".join(f"{key} {value:.4g}" for key, value in figures.items() if key != "views")
            log.info("%s, %d views: %s", name, figures["views"], said)
    log.info("%d surfels in %s", report["surfels"], out / "scene.ply")
    log.info("pictures: %s", out / "contact_sheet.png")


cli = command(
    "tron-reconstruct",
    "conf.reconstruct",
    Settings,
    main,
    examples=(
        "tron-reconstruct capture=photos output_dir=outputs/mine",
        "tron-reconstruct experiment=photos capture=fox downscale=8 output_dir=outputs/fox",
        "tron-reconstruct capture=scene prior=ground_truth initial.source=depth output_dir=out",
        "tron-reconstruct capture=garden prior=precomputed prior.folder=maps experiment=paper output_dir=out",
    ),
)

if __name__ == "__main__":
    cli()
