"""tron-reconstruct: a folder of photos becomes relightable surfels and the light they were taken in."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tron
from tron.apps.reconstruct.settings import Settings
from tron.apps.reconstruct.splat_capture import film_splats, is_splats
from tron.captures import Capture, load_capture
from tron.cli.instantiation import make
from tron.cli.progress import track, working
from tron.errors import TronError
from tron.reconstruction.settings import FusionSettings
from tron.run_folder import RunFolder
from tron.runtime import activate, set_torch_threads
from tron.storage import locked, require_free_space

if TYPE_CHECKING:
    from tron.metrics import LPIPS
    from tron.reconstruction import Prior

log = logging.getLogger(__name__)

RESULTS = (
    *("scene.ply", "cameras.json", "environment.exr", "metrics.json", "curve.json"),
    *("light.png", "contact_sheet.png", "report.html"),
)
SURFEL_BYTES = 1600  # PLY, checkpoint with Adam's moments, and their temporary copies


def run(settings: Settings) -> None:
    """Do what the command does; its ``main`` says what that is."""
    with working("reading the capture"):
        prior = make(settings.prior, "prior")
        lpips = _load_lpips(settings)
        require_free_space(settings.output_dir, settings.radiance.density.most * SURFEL_BYTES)
        activate(settings.variant, settings.threads)
        # Photos without poses take minutes to load: whatever can be refused without them is refused by now.
        capture = _load_capture(settings)
    log.info(
        "%d views, %d of them held out, %d x %d, %d skipped",
        len(capture.views), len(capture.test), capture.views[0].camera.width,
        capture.views[0].camera.height, len(capture.skipped),
    )  # fmt: skip
    prior.check(capture)  # what cannot be had is said before long work
    # Dr.Jit has the cores; the loss is small, and torch's threads would wait for theirs.
    set_torch_threads(1)
    with locked(settings.output_dir):
        _claim(settings, capture, prior)
        report = _finished(settings, capture)
        if report is None:
            from tron.apps.reconstruct.run import run

            try:
                report = run(settings, capture, prior, lpips)
            except (KeyboardInterrupt, SystemExit) as end:
                if settings.overwrite:
                    end.add_note("what is finished is kept; go on from it without overwrite=true")
                raise
        else:
            log.info("finished before; overwrite=true begins anew")
        _log_summary(report, settings.output_dir)


def _load_capture(settings: Settings) -> Capture:
    if not is_splats(settings.capture):
        return load_capture(settings.capture, settings.of_loading())
    fusion = FusionSettings(most_voxels=settings.radiance.consistency.most_voxels)
    return film_splats(
        settings.capture, settings.splats, settings.up, settings.test_every, fusion, settings.seed,
        track,
    )  # fmt: skip


def _load_lpips(settings: Settings) -> LPIPS | None:
    if settings.lpips_weights is None:
        return None
    from tron.metrics import LPIPS

    return LPIPS.load(settings.lpips_weights)


def _claim(settings: Settings, capture: Capture, prior: Prior) -> None:
    """Keep the resolved configuration, and clear the way for a new run where that is asked for.

    Raises:
        TronError: the folder holds another run; nothing in it is changed.
    """
    from tron.apps.reconstruct.run import CHECKPOINT
    from tron.reconstruction.pipeline import require_same_run

    run = RunFolder(settings.output_dir)
    if settings.overwrite:
        run.clear(CHECKPOINT, *RESULTS)
    require_same_run(settings.output_dir / CHECKPOINT, capture, prior, settings.of_surfels())
    run.keep(settings.model_dump(mode="json"))


def _finished(settings: Settings, capture: Capture) -> dict[str, Any] | None:
    """The report of a run with these settings and photos that came to its end, all its files there."""
    from tron.apps.reconstruct.run import shown_by

    run = RunFolder(settings.output_dir, record="metrics.json")
    try:
        report = run.recipe() or {}
        same = report["settings"] == settings.kept() and report["capture"]["content"] == shown_by(capture)
        files = (
            *("scene.ply", "contact_sheet.png"),
            *(("environment.exr", "light.png") if report["light"] else ()),
            *(("report.html",) if settings.report else ()),
        )
        return report if same and report["version"] == tron.__version__ and run.has(*files) else None
    except (TronError, KeyError, TypeError):
        return None


def _log_summary(report: dict[str, Any], out: Path) -> None:
    for name in ("test", "train"):
        figures = report[name]
        if figures:
            said = ", ".join(f"{key} {value:.4g}" for key, value in figures.items() if key != "views")
            log.info("%s, %d views: %s", name, figures["views"], said)
    log.info("%d surfels in %s", report["surfels"], out / "scene.ply")
    pages = [out / name for name in ("report.html", "contact_sheet.png") if (out / name).is_file()]
    log.info("look at %s", pages[0])
