"""Loading of every kind of capture, and the table of known formats."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import ConfigDict, Field

from tron.captures.settings import (
    FrameSettings,
    MatchingSettings,
    PhotoSettings,
    PosingSettings,
    TensoirSettings,
)
from tron.errors import TronError
from tron.io.recognised import VIDEOS, foreign_poses, refuse_by_sight
from tron.lazily import later

if TYPE_CHECKING:
    from tron.captures.capture import Capture
    from tron.captures.photos.photographs import PosedPhotos

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class CaptureFormat:
    """Kind of folder that a capture is read from.

    Attributes:
        holds: what lies in the folder, for help and errors.
        detect: whether a folder (or a file, of ``files``) is of this format.
        read: the photos that a path names, with their poses, or a whole capture; takes the
            :class:`LoadSettings`. A format's own settings are a model of its file that
            :class:`CaptureSettings` inherits.
        files: suffixes of single files that are taken in place of a folder.
    """

    holds: str
    detect: Callable[[Path], object]
    read: Callable[[Path, Any], PosedPhotos | Capture]
    files: tuple[str, ...] = ()

    def takes(self, path: Path) -> bool:
        """Whether a path is of the kind that the format is read from, by its name alone."""
        return path.is_dir() or path.suffix.lower() in self.files


def _format(holds: str, module: str, detect: str, read: str, files: tuple[str, ...] = ()) -> CaptureFormat:
    """A row of functions of a module of this package, which is imported once one of them is called."""
    return CaptureFormat(
        holds, later(f"tron.captures.{module}", detect), later(f"tron.captures.{module}", read), files
    )


FORMATS = {
    "tron": _format("tron-datagen's views", "folder", "is_capture_folder", "load_traced", (".json",)),
    "transforms": _format(
        "transforms.json of NeRF, instant-ngp, nerfstudio, DL3DV",
        *("formats.transforms", "has_transforms", "read_transforms", (".json",)),
    ),
    "colmap": _format("COLMAP's sparse/0", "formats.colmap", "model_folder", "read_colmap"),
    "tensoir": _format("TensoIR's folders train_000, ...", "formats.tensoir", "is_tensoir", "read_tensoir"),
    "polycam": _format("Polycam's raw export", "formats.polycam", "camera_folder", "read_polycam"),
    "record3d": _format("Record3D's EXR + RGB export", "formats.record3d", "metadata_file", "read_record3d"),
    "metashape": _format(
        "Metashape's XML of cameras", "formats.metashape", "cameras_file", "read_metashape", (".xml",)
    ),
    "opensfm": _format(
        "a project of OpenSfM or OpenDroneMap", "formats.opensfm", "reconstruction_file", "read_opensfm"
    ),
    "realitycapture": _format(
        "RealityCapture's CSV of cameras",
        *("formats.realitycapture", "registration_file", "read_realitycapture", (".csv",)),
    ),
    "stray_scanner": _format(
        "Stray Scanner's recording", "formats.stray_scanner", "is_stray_scanner", "read_stray_scanner"
    ),
    "scanner_app": _format(
        "3D Scanner App's data", "formats.scanner_app", "is_scanner_app", "read_scanner_app"
    ),
    "video": _format(
        "a video file, whose sharpest frames are posed", "posing.video", "is_video", "read_video", VIDEOS
    ),
    "photos": _format(
        "photos, posed by structure from motion",
        *("posing.structure_from_motion", "has_photos", "pose_photos"),
    ),
}
"""Formats by the names that ``format=`` takes, in the order in which ``auto`` looks for them."""

HOLDS = "; ".join(f"{name}: {each.holds}" for name, each in FORMATS.items())
KINDS = "; ".join(each.holds for each in FORMATS.values())

if TYPE_CHECKING:
    FormatName = str
else:
    FormatName = Literal[("auto", *FORMATS)]


class CaptureSettings(FrameSettings, MatchingSettings, TensoirSettings, PhotoSettings):
    """Choices of how a capture is read; path-traced views (``tron``) have their own split and heed ``up``."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    format: FormatName = Field(
        default="auto", description=f"what the folder holds. {HOLDS}; auto: looks, in this order"
    )


class LoadSettings(CaptureSettings, PosingSettings):
    """All options of :func:`load_capture`: the users' choices and the calling program's."""

    cache_bytes: int = Field(default=1_000_000_000, ge=0, description="decoded image data kept in memory")


def load_capture(path: str | os.PathLike[str], settings: LoadSettings | None = None) -> Capture:
    """Load a capture of one of the :data:`FORMATS`; photos are decoded when they are looked at.

    What the files name and cannot be used is in ``Capture.skipped`` and is logged in one line.

    Args:
        path: the capture's folder, its transforms file, or a video.
        settings: see :class:`LoadSettings`.

    Raises:
        TronError: nothing there, no poses and no photos, poses without photos, fewer than two usable views,
            all views held out, files that cannot be read.
    """
    from tron.captures.assembly import assemble
    from tron.captures.capture import Capture
    from tron.captures.formats.metashape import cameras_file
    from tron.captures.formats.not_a_capture import refusal
    from tron.captures.formats.realitycapture import registration_file

    path = Path(path)
    settings = settings or LoadSettings()
    if not path.exists():
        raise TronError("capture not found", path)
    if not any(each.takes(path) for each in FORMATS.values()):
        raise refusal(path, KINDS, _holds_capture)
    if path.is_file() and not (cameras_file(path) or registration_file(path)):
        refuse_by_sight(path, "a capture is a folder, or a file of its cameras")
    name = _detected(path) if settings.format == "auto" else settings.format
    if not FORMATS[name].takes(path):
        raise TronError(f"a capture of format {name} is a folder", path)
    if name == "photos" and settings.format == "auto":
        _log_poses(path)
    found = FORMATS[name].read(path, settings)
    return found if isinstance(found, Capture) else assemble(found, settings, settings.cache_bytes)


def _detected(path: Path) -> str:
    from tron.captures.formats.not_a_capture import refusal

    name = _format_of(path)
    if name is None:
        raise refusal(path, KINDS, _holds_capture)
    return name


def _format_of(path: Path) -> str | None:
    return next((name for name, each in FORMATS.items() if each.takes(path) and each.detect(path)), None)


def _holds_capture(path: Path) -> bool:
    return _format_of(path) is not None


def _log_poses(path: Path) -> None:
    """Say that poses of another program lie beside photos that are about to be posed anew."""
    found = foreign_poses(path)
    if found is not None:
        log.warning("%s is %s, which is not read: the photos are posed anew (format=photos says that this is "
                    "meant); %s", found[0], found[1].what, found[1].mend)  # fmt: skip
