"""A video as a capture: the sharpest frame of each interval becomes a photo, posed as photos are."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from tron.captures.photos.photographs import PosedPhotos
from tron.captures.photos.video_frames import FRAMES, WIDTH, holds_frames, keep_frames, sharpest
from tron.captures.posing.structure_from_motion import pose_photos
from tron.captures.posing.wide_pictures import refuse_video
from tron.captures.settings import FEWEST, FrameSettings, PosingSettings
from tron.errors import TronError
from tron.io.recognised import VIDEOS
from tron.io.video import duration_of, frames_of
from tron.storage import locked, sha256

log = logging.getLogger(__name__)

_VERSION = 2
_CORNERS = 200
_STILL = 0.004
"""Share of a picture's width that something must have moved by, from one chosen frame to another."""


class VideoSettings(FrameSettings, PosingSettings):
    """Frames of a video, and how they are posed."""


def is_video(path: Path) -> bool:
    """Whether a path is a video file, by its name."""
    return path.is_file() and path.suffix.lower() in VIDEOS


def read_video(path: Path, settings: VideoSettings) -> PosedPhotos:
    """Pose the sharpest frames of a video; they are kept in the workspace, and so are their poses.

    Neighbours in time are matched, unless ``matching`` says otherwise.

    Args:
        path: the video.
        settings: see there; the workspace is by default a folder beside the video, named after it.

    Raises:
        TronError: no readable video, one of fewer than three frames or in which nothing moves, or photos that
            cannot be posed.
    """
    refuse_video(path)
    workspace = settings.workspace or path.with_name(f"{path.stem}_frames")
    with locked(workspace):
        folder = _kept_frames(path, settings.frames, workspace)
    matching = "sequential" if settings.matching == "auto" else settings.matching
    return pose_photos(folder, settings.model_copy(update={"workspace": workspace, "matching": matching}))


def choose_frames(path: Path, count: int) -> list[np.ndarray]:
    """The sharpest frame of each of ``count`` even intervals of a video, (H, W, 3) uint8 each; all, if fewer.

    Raises:
        TronError: no readable video, or one whose header does not say how long it is.
    """
    seconds = duration_of(path)
    if not seconds > 0:
        mend = f"ffmpeg -i {path.name} -c copy new.mp4"
        raise TronError("video does not say how long it lasts", path, mend)
    chosen = sharpest(frames_of(path), lambda _, frame: min(int(frame.seconds / seconds * count), count - 1))
    return [frame.rgb() for _, frame in chosen]


def motion(frames: Sequence[np.ndarray]) -> float:
    """Largest median distance that corners move by between neighbouring frames, over the frames' width.

    Corners are followed from frame to frame (Lucas and Kanade 1981, Bouguet's pyramids). Frames without
    corners, or whose corners are lost, count as moved: whether they can be posed is another question.
    """
    import cv2

    greys = [_small(frame) for frame in frames]
    largest = 0.0
    for before, after in pairwise(greys):
        corners = cv2.goodFeaturesToTrack(before, _CORNERS, 0.01, 5)
        if corners is None:
            return 1.0
        moved, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, None)  # type: ignore[call-overload]
        kept = found.ravel() == 1
        if not kept.any():
            return 1.0
        distances = np.linalg.norm((moved - corners)[kept].reshape(-1, 2), axis=1)
        largest = max(largest, float(np.median(distances)) / before.shape[1])
    return largest


def _small(frame: np.ndarray) -> np.ndarray:
    import cv2

    grey = cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)
    width = min(WIDTH, grey.shape[1])
    return cv2.resize(grey, (width, max(2, round(grey.shape[0] * width / grey.shape[1]))))


def _kept_frames(path: Path, count: int, workspace: Path) -> Path:
    """Folder of the chosen frames, made unless it is there from the same video."""
    folder = workspace / FRAMES
    wanted = {"version": _VERSION, "video": sha256(path), "frames": count}
    if holds_frames(folder, wanted):
        return folder
    log.info("%s: looking for the sharpest frames of %d intervals", path, count)
    frames = choose_frames(path, count)
    if len(frames) < FEWEST:
        raise TronError(f"video has {len(frames)} frames, at least {FEWEST} are needed", path)
    if motion(frames) < _STILL:
        raise TronError(
            "nothing moves in the video: all its frames show one view",
            path,
            "walk around the scene as you film it",
        )
    keep_frames(folder, wanted, ((f"{index:05d}", frame) for index, frame in enumerate(frames)))
    log.info("%s: %d frames of %d x %d taken", path, len(frames), frames[0].shape[1], frames[0].shape[0])
    return folder
