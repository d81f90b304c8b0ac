"""Clips of a capture: photos in a row, and what its surfels show from their places in the capture's light."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

import numpy as np

from datagen.captured_photos import Photo, frame_of, require_size, rows_of_photos, starts
from datagen.captured_reconstruction import Found
from datagen.captured_surfels import CapturedSurfels
from datagen.lights import classify, contrast_share
from datagen.plan import Work, scene_folder
from datagen.settings import Settings
from datagen.spool import Frame, Spool
from tron.cameras import Camera
from tron.captures import Capture, View
from tron.color import luminance
from tron.errors import TronError
from tron.priors.linear_light import decoded, inverse_agx
from tron.shards.schema import TARGET, ClipMeta, color_spaces

OPAQUE = 0.9
"""Opacity of surfels at pixels that the exposure is measured at."""
UNCLIPPED = (0.05, 0.95)
SAMPLES = 4096
"""Such pixels of a photo, at most."""
BLACK = (0.0, 0.0, 0.0)


@contextmanager
def made_clips(
    item: Work, settings: Settings, capture: Capture, found: Found, surfels: CapturedSurfels
) -> Iterator[list[tuple[ClipMeta, Sequence[Frame]]]]:
    """Clips of a capture with their frames, which are read when they are asked for, within the block.

    Each frame holds the schema's members: guidance in the capture's own light, linear, and the photo as rgb,
    display values, or with ``captured.linear`` linear light on the scale of the guidance.

    Args:
        item, settings: the capture and its recipe.
        capture: with photos as large as they are.
        found: its light, and the gains of its photos.
        surfels: its reconstruction.

    Raises:
        TronError: there are too few photos in a row, or they are too small.
    """
    wanted = settings.captured
    rows = usable_rows(item, settings, capture)
    views = [view for row in rows for view in row]
    with Spool(scene_folder(settings.output_dir, item.name), clips=1) as spool:
        cameras, exposure = _film(settings, capture, found, surfels, views, spool)
        about = _About(item, settings, found, exposure, capture.exposure)
        clips, first, frames = [], 0, spool.clip(0)
        for row in rows:
            for start in starts(len(row), wanted.frames):
                which = slice(first + start, first + start + wanted.frames)
                clips.append((about.meta(len(clips), views[which], cameras[which]), frames[which]))
            first += len(row)
        yield clips


def usable_rows(item: Work, settings: Settings, capture: Capture) -> list[list[View]]:
    """Photos in rows that are long enough for a clip.

    Raises:
        TronError: there are none, or a photo of them is smaller than a frame.
    """
    wanted, found = settings.captured, rows_of_photos(capture)
    rows = [row for row in found if len(row) >= wanted.frames]
    if not rows:
        raise TronError(
            f"{max(map(len, found), default=0)} photos are the most in a row, a clip has {wanted.frames}",
            str(settings.captures and settings.captures / item.capture),
            "make captured.frames smaller, or hold out fewer (captured.photos.test_every=0)",
        )
    require_size((view for row in rows for view in row), wanted.width, wanted.height)
    return rows


def _film(
    settings: Settings,
    capture: Capture,
    found: Found,
    surfels: CapturedSurfels,
    views: Sequence[View],
    spool: Spool,
) -> tuple[list[Camera], float]:
    """Put every photo and its guidance into the spool; their cameras, and the exposure of the guidance."""
    wanted, lit = settings.captured, surfels.under(found.environment)
    # A subject without its surroundings is in front of black, in photos and guidance alike.
    alone = any(view.has("mask") and not view.has("sky_mask") for view in views)
    cameras, ratios = [], []
    for view in views:
        gain = found.gains.get(view.name, np.ones(3)) if wanted.balance else np.ones(3)
        photo = frame_of(view, gain, capture.tone_curve, wanted.width, wanted.height)
        guidance = lit.view(photo.camera, view.name, BLACK if alone else None)
        opaque = guidance.mask > 0.5
        seen = (opaque if photo.foreground is None else photo.foreground) & photo.believed
        rgb = photo.shown
        if wanted.linear:
            rgb = decoded(rgb, capture.tone_curve) / np.float32(capture.exposure)
        truth = {TARGET: rgb, "foreground": seen.astype(np.float32)}
        spool.add(0, lit.frame(guidance, photo.camera) | truth)
        ratios.append(light_ratio(photo, guidance.lit * capture.exposure, seen & (guidance.mask > OPAQUE)))
        cameras.append(photo.camera)
    measured = np.concatenate(ratios)
    factor = float(np.exp(np.median(measured))) if measured.size else 1.0
    return cameras, capture.exposure * factor


def light_ratio(photo: Photo, lit: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """(N,) logarithms of what AgX makes a photo of, over ``lit``, at some of the pixels that show surfaces.

    Training and evaluation look at guidance through AgX, at photos as they are. So the exposure that makes
    guidance as bright as the photos is measured against light that AgX would show as them, whatever curve
    they went through.

    Args:
        photo: the truth.
        lit: (H, W, 3) guidance, linear.
        seen: (H, W) bool, pixels that count.
    """
    low, high = UNCLIPPED
    usable = seen & (photo.shown > low).all(-1) & (photo.shown < high).all(-1) & (luminance(lit) > 1e-6)
    places = np.flatnonzero(usable)
    places = places[:: max(1, -(-len(places) // SAMPLES))]
    wanted = luminance(inverse_agx(photo.shown.reshape(-1, 3)[places]))
    shown = luminance(lit.reshape(-1, 3)[places])
    kept = wanted > 1e-6
    return np.log(wanted[kept].astype(np.float64)) - np.log(shown[kept].astype(np.float64))


class _About:
    """Metadata of the clips of a capture."""

    def __init__(
        self, item: Work, settings: Settings, found: Found, exposure: float, own_exposure: float
    ) -> None:
        self.item, self.settings, self.found, self.exposure = item, settings, found, exposure
        self.shared: Mapping[str, object] = {
            "style": "captured",
            "capture": item.capture,
            "contrast": classify(found.environment),
            "contrast_share": contrast_share(found.environment),
            "balanced": settings.captured.balance,
            "light_factor": round(exposure / own_exposure, 6),
        }

    def meta(self, number: int, views: Sequence[View], cameras: Sequence[Camera]) -> ClipMeta:
        """Metadata of one clip."""
        item, wanted = self.item, self.settings.captured
        gains = [self.found.gains.get(view.name, np.ones(3)) for view in views]
        return ClipMeta(
            key=f"{item.name}-l0-c{number:04d}",
            scene=item.name,
            light=f"{item.name}-captured",
            light_family="captured",
            split=item.split,
            frames=len(cameras),
            width=wanted.width,
            height=wanted.height,
            cameras=[camera.to_dict() for camera in cameras],
            exposure=self.exposure,
            color_space={
                **color_spaces(reference=False),
                TARGET: "linear" if wanted.linear else "display",
            },
            seeds={"root": self.settings.seed},
            spp={"guidance": wanted.guidance_spp},
            extra={
                **self.shared,
                "photos": [view.name for view in views],
                "gains": [[float(value) for value in gain] for gain in gains],
            },
        )
