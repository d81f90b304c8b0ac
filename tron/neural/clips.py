"""Clips: windows of frames for a renderer, and averages of frames along exact motion. Loads no torch.

Rays that differ from frame to frame, edges that fall on pixels otherwise each time, what a network makes of
both: it flickers, and the mean over frames is nearer to the truth than each of them. A neighbour's picture is
sampled where it shows the surface of each pixel (:mod:`tron.flow`: cameras and depth are known, nothing is
estimated), by bicubic interpolation, as a bilinear one blurs. Where the neighbour does not see that surface
it is left out. What moves otherwise than the surface, as reflections, shadows and highlights, is held to the
colours around the pixel: to their mean and DEVIATIONS standard deviations of 3 x 3 pixels (variance clipping:
Salvi 2016, "An Excursion in Temporal Supersampling"; the method as a whole: Yang, Liu and Salvi 2020, "A
Survey of Temporal Antialiasing Techniques"). dev/LOG.md says how the numbers were chosen.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Literal, NamedTuple, get_args

import numpy as np

from tron.errors import TronError

DEVIATIONS = 1.0
"""Variance clipping: most standard deviations from the mean colour around a pixel."""
OWN_WEIGHT = 2.0
"""Weight of the frame itself; a neighbour has weight 1."""
Motion = Callable[[int, int], tuple[np.ndarray, np.ndarray]]
"""Frame and other frame of a clip, by number -> where each pixel's surface is in the other frame:

(H, W, 2) displacement in pixels, x then y, and (H, W) bool whether it is seen there
(`tron.flow.surface_motion`).
"""


def averaged_frames(
    pictures: Iterable[np.ndarray], frames: int, size: int, motion: Motion, overlap: Overlap = "anchor"
) -> Iterator[np.ndarray]:
    """Average each frame of a clip with its neighbours, in the memory of ``size`` frames.

    Args:
        pictures: of the clip, in order, (H, W, 3) display values in [0, 1].
        frames: how many they are.
        size: frames that one is made of, itself among them.
        motion: of the clip.
        overlap: newest: those before it (and, of the first ones, behind it); else those around it.

    Yields:
        (H, W, 3) float32 in [0, 1], in order, each as soon as the frames that it is made of are there.
    """
    source, held = iter(enumerate(pictures)), dict[int, np.ndarray]()
    for this in windows(frames, size, 1, "newest" if overlap == "newest" else "anchor"):
        held = {index: picture for index, picture in held.items() if index >= this.frames.start}
        while this.frames[-1] not in held:
            index, picture = next(source)
            held[index] = picture
        for index in this.kept:
            yield averaged(held, index, motion)


def averaged(pictures: Mapping[int, np.ndarray], index: int, motion: Motion) -> np.ndarray:
    """Return the mean of a frame and of other frames that were warped to its pixels.

    Args:
        pictures: by number in the clip, (H, W, 3) display values in [0, 1].
        index: the frame that is wanted, one of them.
        motion: of the clip.

    Returns:
        (H, W, 3) float32 in [0, 1]; the picture itself where no other frame sees the surface.
    """
    own = np.asarray(pictures[index], np.float32)
    least, most = _bounds(own)
    total = OWN_WEIGHT * own
    weight = np.full((*own.shape[:2], 1), OWN_WEIGHT, np.float32)
    for other, picture in pictures.items():
        if other != index:
            displacement, seen = motion(index, other)
            there = np.clip(_sampled(picture, displacement), least, most)
            total += np.where(seen[..., None], there, 0)
            weight += seen[..., None]
    return np.clip(total / weight, 0, 1)


def _sampled(picture: np.ndarray, displacement: np.ndarray) -> np.ndarray:
    """(H, W, 3) float32: bicubic samples of a picture; beyond its border, and at NaN, its nearest pixels."""
    import cv2

    height, width = displacement.shape[:2]
    place = np.nan_to_num(displacement, nan=0.0) + np.stack(np.meshgrid(range(width), range(height)), -1)
    x, y = np.moveaxis(np.clip(place, -1, (picture.shape[1], picture.shape[0])).astype(np.float32), -1, 0)
    image = np.asarray(picture, np.float32)
    return cv2.remap(image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def _bounds(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least and most that another frame's colours count as, (H, W, 3) each."""
    import cv2

    around = {"ksize": (3, 3), "borderType": cv2.BORDER_REPLICATE}
    mean = cv2.blur(picture, **around)
    spread = DEVIATIONS * np.sqrt(np.maximum(cv2.blur(picture * picture, **around) - mean * mean, 0))
    return mean - spread, mean + spread


# A window of K frames slides over the clip with stride 1, so that most frames lie in K windows. Which of
# those draws a frame is the choice of the overlap:
#
#     newest  the window that ends with it, as a live renderer would; the first window draws all its frames
#     anchor  the window in whose middle it stands, frames before it and after it; at the ends the nearest
#     mean    all of them: their mean

TEMPORAL_FACTOR = 4
"""Frames per latent frame in codecs that compress time; the first latent frame holds one."""

Overlap = Literal["newest", "mean", "anchor"]


class Window(NamedTuple):
    """One pass: frames of the clip that go through the network, and frames that are kept."""

    frames: range
    kept: range


def check_frames(frames: int, temporal_factor: int = TEMPORAL_FACTOR) -> None:
    """TronError unless a clip has 1 + temporal_factor * n frames: a codec would silently drop the rest."""
    if frames < 1 or (frames - 1) % temporal_factor:
        counts = ", ".join(str(1 + temporal_factor * n) for n in range(3))
        mend = f"give {counts}, ... frames (1 + {temporal_factor}n)"
        raise TronError(f"a window has {frames} frames", mend=mend)


def windows(
    frames: int, size: int, temporal_factor: int = TEMPORAL_FACTOR, overlap: Overlap = "anchor"
) -> list[Window]:
    """Return passes over a clip, in order; each frame is kept once, with overlap=mean at least once.

    Stride 1, as the paper has it; a clip shorter than the window is cut into the largest windows that fit.
    Raises TronError for another overlap.
    """
    if overlap not in get_args(Overlap):
        raise TronError(f"no overlap is called {overlap!r}", mend=f"they are {', '.join(get_args(Overlap))}")
    size = min(size, frames - (frames - 1) % temporal_factor)
    last = frames - size
    before = {"newest": size - 1, "anchor": (size - 1) // 2, "mean": 0}[overlap]
    passes = []
    for start in range(last + 1):
        covered = range(start, start + size)
        first, end = start + before, start + before + 1
        if overlap == "mean":
            first, end = covered.start, covered.stop
        # The ends of the clip stand in no window as they would have to.
        kept = range(0 if start == 0 else first, frames if start == last else end)
        passes.append(Window(covered, kept))
    return passes
