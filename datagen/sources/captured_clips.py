"""Clips of a capture: consecutive photos, and guidance of its surfels from their cameras in its light."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from PIL import Image

from datagen.dataset.records import Work, scene_folder, starts
from datagen.dataset.spool import Frame, Spool, stored_guidance
from datagen.settings.command import Settings
from datagen.sources.captured_reconstruction import Found
from datagen.world.lights import classify, contrast_share
from tron.cameras import Camera
from tron.captures import Capture, View
from tron.captures.photos.photo_files import SUFFIXES
from tron.captures.view import ToneCurve, decoded, encoded, inverse_agx
from tron.color import luminance
from tron.errors import TronError
from tron.relighting import EnvironmentMap, Guidance, Illumination, Relighter
from tron.seeds import integer
from tron.shards.schema import TARGET, ClipMeta, color_spaces

OPAQUE = 0.9
"""Opacity of surfels at pixels that the exposure is measured at."""
UNCLIPPED = (0.05, 0.95)
SAMPLES = 4096
"""Such pixels of a photo, at most."""
BLACK = (0.0, 0.0, 0.0)
Box = tuple[float, float, float, float]
"""Left, top, right and bottom, pixels."""


@contextmanager
def made_clips(
    item: Work, settings: Settings, capture: Capture, found: Found, surfels: CapturedSurfels
) -> Iterator[list[tuple[ClipMeta, Sequence[Frame]]]]:
    """Yield clips of a capture; their frames are read on demand, within the block only.

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
    lit = surfels.under(found.environment)
    with Spool(scene_folder(settings.output_dir, item.name), clips=1) as spool:
        cameras, exposure = _film(settings, capture, found, lit, views, spool)
        clips, first, frames = [], 0, spool.clip(0)
        for row in rows:
            for start in starts(len(row), wanted.frames):
                which = slice(first + start, first + start + wanted.frames)
                names = [view.name for view in views[which]]
                meta = lit.meta(
                    "captured",
                    0,
                    len(clips),
                    cameras[which],
                    exposure,
                    display=not wanted.linear,
                    balanced=wanted.balance,
                    light_factor=round(exposure / capture.exposure, 6),
                    photos=names,
                    gains=[[float(value) for value in found.gains.get(name, np.ones(3))] for name in names],
                )
                clips.append((meta, frames[which]))
            first += len(row)
        yield clips


def usable_rows(item: Work, settings: Settings, capture: Capture) -> list[list[View]]:
    """Return rows of photos that are long enough for a clip.

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
    lit: LitSurfels,
    views: Sequence[View],
    spool: Spool,
) -> tuple[list[Camera], float]:
    """Write every photo and its guidance to the spool; return cameras, and the exposure of the guidance."""
    wanted = settings.captured
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
    """Return log ratios (N,) of photo radiance, by inverse AgX, over ``lit`` at some surface pixels.

    Training and evaluation look at guidance through AgX, at photos as they are. So the exposure that makes
    guidance as bright as the photos is measured against radiance that AgX would display as the photos,
    whatever their real tone curve.

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


@dataclass(frozen=True)
class LitSurfels:
    """Surfels of a capture under one light.

    Attributes:
        item, settings: the capture and its recipe.
        light: that they are under.
        streams: words that name the light's random streams.
        contrast: class of the light, and the share that it is told by.
    """

    item: Work
    settings: Settings
    light: Illumination
    streams: tuple[int | str, ...]
    contrast: tuple[str, float]

    def view(self, camera: Camera, name: str, background: Sequence[float] | None = None) -> Guidance:
        """Trace the guidance of one view, by its name; ``background`` as in ``Illumination.render``."""
        seed = integer(self.settings.seed, *self.streams, "frame", name, "guidance")
        return self.light.render(camera, seed, background)

    def frame(self, guidance: Guidance, camera: Camera) -> Frame:
        """Return the members of one view from surfels and from its guidance by :meth:`view`."""
        (maps,) = self.light.relighter.surface_maps(camera, self.light.estimation)
        return stored_guidance(guidance) | maps

    def meta(
        self,
        family: str,
        light: int,
        clip: int,
        cameras: Sequence[Camera],
        exposure: float,
        display: bool = False,
        **extra: object,
    ) -> ClipMeta:
        """Return the metadata of one clip.

        Args:
            family, light: of the light, and its number; 0 is the capture's own.
            clip: its number under that light.
            cameras: of its frames.
            exposure: of its guidance.
            display: whether its photos are display values.
            extra: what else is said of it.
        """
        item, wanted, estimation = self.item, self.settings.captured, self.light.estimation
        contrast, share = self.contrast
        spp = {"guidance": estimation.rays}
        if estimation.reflections:
            spp["reflections"] = estimation.reflections
        return ClipMeta(
            key=f"{item.name}-l{light}-c{clip:04d}",
            scene=item.name,
            light=f"{item.name}-{family}{light or ''}",
            light_family=family,
            split=item.split,
            frames=len(cameras),
            width=wanted.width,
            height=wanted.height,
            cameras=[camera.to_dict() for camera in cameras],
            exposure=exposure,
            color_space={**color_spaces(reference=False), TARGET: "display" if display else "linear"},
            seeds={"root": self.settings.seed},
            spp=spp,
            extra={
                "style": "captured",
                "capture": item.capture,
                "contrast": contrast,
                "contrast_share": share,
                "filtered": estimation.filtered,
                "sub_pixels": estimation.supersample,
                **extra,
            },
        )


class CapturedSurfels:
    """Surfels of a capture, ready to be lit.

    Args:
        item, settings: the capture and its recipe.
        found: its surfels.
        cameras: that they were found from, in their world; None: not known.
    """

    def __init__(
        self, item: Work, settings: Settings, found: Found, cameras: Sequence[Camera] | None = None
    ) -> None:
        self._item, self._settings, self._streams = item, settings, ("captured", item.capture)
        seed = integer(settings.seed, *self._streams, "bounce")
        estimation = settings.estimation(item.split)
        self._relighter = Relighter(found.scene, estimation, seed, cameras=cameras).prepare()

    def under(self, environment: EnvironmentMap, *light: int | str) -> LitSurfels:
        """Light the surfels; words of the light name its random streams, none for the capture's own."""
        streams = (*self._streams, *light)
        lit = self._relighter.under(environment, integer(self._settings.seed, *streams, "light", "bounce"))
        contrast = classify(environment), contrast_share(environment)
        return LitSurfels(self._item, self._settings, lit, streams, contrast)


@dataclass(frozen=True)
class Photo:
    """A photo at the size of a frame.

    Attributes:
        camera: of the frame.
        shown: (H, W, 3) float32 display values; black where the subject's mask is 0.
        foreground: (H, W) bool, on the subject, where the capture says so; None where it does not.
        believed: (H, W) bool, pixels that are not a passer-by's.
    """

    camera: Camera
    shown: np.ndarray
    foreground: np.ndarray | None
    believed: np.ndarray


def rows_of_photos(capture: Capture) -> list[list[View]]:
    """Return training views in rows without gaps, in the natural order of their names.

    A photo that was skipped or held out ends a row.
    """
    learnt = {view.name: view for view in capture.train_views}
    lost = {
        _without_suffix(name) for name, why in capture.skipped.items() if not why.startswith("named more")
    }
    rows: list[list[View]] = [[]]
    for name in sorted({*learnt, *capture.test, *lost}, key=in_order):
        if name in learnt:
            rows[-1].append(learnt[name])
        elif rows[-1]:
            rows.append([])
    return [row for row in rows if row]


def in_order(name: str) -> tuple[tuple[int, int, str], ...]:
    """Return a key for natural order of names: img_9 before img_10."""
    parts = [part for part in re.split(r"([0-9]+)", name) if part]
    return tuple((0, int(part), part) if part.isdecimal() else (1, 0, part) for part in parts)


def frame_of(view: View, gain: np.ndarray, curve: ToneCurve, width: int, height: int) -> Photo:
    """Resize and crop a photo to a frame.

    It is made smaller, by Pillow's Hamming filter in display space, until it just covers the frame, and what
    stands over at two edges is cut off.

    Args:
        view: the photo, display values.
        gain: (3,) its exposure and white balance over those of the mean photo, linear; it is shown without.
        curve: that its display values went through.
        width, height: of the frame, pixels.

    Raises:
        TronError: the photo is smaller than the frame, or cannot be read.
    """
    box = _covered(view.camera, width, height, view.name)
    mask = view.read("mask") if view.has("mask") and not view.has("sky_mask") else None
    shown = balanced(view.read(), gain, curve, mask)
    if view.has("mask"):
        foreground = _resized(view.read("mask"), box, width, height) > 0.5
    else:
        foreground = None
    believed = _resized(view.believed().astype(np.float32), box, width, height) > 0.99
    shown = np.clip(_resized(shown, box, width, height), 0.0, 1.0)
    return Photo(_cut(view.camera, box, width, height), shown, foreground, believed)


def resized_view(
    camera: Camera, images: Sequence[np.ndarray], width: int, height: int
) -> tuple[Camera, list[np.ndarray]]:
    """Resize and crop a camera and its images (H, W) or (H, W, C) to a frame, as :func:`frame_of` does.

    Raises:
        TronError: they are smaller than the frame.
    """
    box = _covered(camera, width, height)
    return _cut(camera, box, width, height), [_resized(image, box, width, height) for image in images]


def balanced(
    display: np.ndarray, gain: np.ndarray, curve: ToneCurve, mask: np.ndarray | None = None
) -> np.ndarray:
    """(H, W, 3) display values of a photo without its gain, in front of black where it has a mask (H, W).

    Both are done in linear light. A gain of one changes no bit.
    """
    linear = np.asarray(decoded(display, curve), np.float32)
    moved = encoded((linear / gain).astype(np.float32), curve) - encoded(linear, curve)
    shown = np.clip(display + moved, 0.0, 1.0)
    if mask is not None and (mask < 1).any():
        over = encoded(np.asarray(decoded(shown, curve), np.float32) * mask[..., None], curve)
        shown = np.where(mask[..., None] < 1, over, shown)
    return np.asarray(shown, np.float32)


def require_size(views: Iterable[View], width: int, height: int) -> None:
    """Raise TronError with the first photo that is smaller than a frame."""
    for view in views:
        _covered(view.camera, width, height, view.name)


def _covered(camera: Camera, width: int, height: int, name: str = "") -> Box:
    """Return left, top, right and bottom of a frame's crop, pixels of the photo."""
    shrink = min(camera.width / width, camera.height / height)
    if shrink < 1:
        raise TronError(
            f"a photo has {camera.width} x {camera.height} pixels, fewer than a frame, {width} x {height}",
            f"view {name}" if name else None,
            "make captured.width and captured.height smaller",
        )
    left, top = (camera.width - shrink * width) / 2, (camera.height - shrink * height) / 2
    if shrink == 1:  # whole pixels, which nothing blurs
        left, top = float(int(left)), float(int(top))
    return left, top, left + shrink * width, top + shrink * height


def _cut(camera: Camera, box: Box, width: int, height: int) -> Camera:
    left, top, right, _ = box
    scale = width / (right - left)
    return replace(
        camera,
        fx=camera.fx * scale,
        fy=camera.fy * scale,
        cx=(camera.cx - left) * scale,
        cy=(camera.cy - top) * scale,
        width=width,
        height=height,
    )


def _resized(image: np.ndarray, box: Box, width: int, height: int) -> np.ndarray:
    channels = np.atleast_3d(np.asarray(image, np.float32))
    made = [
        Image.fromarray(np.ascontiguousarray(channels[..., k])).resize(
            (width, height), Image.Resampling.HAMMING, box=box
        )
        for k in range(channels.shape[2])
    ]
    return np.stack([np.asarray(each, np.float32) for each in made], -1).reshape(
        (height, width, *np.shape(image)[2:])
    )


def _without_suffix(name: str) -> str:
    stem, dot, suffix = name.rpartition(".")
    return stem if dot and stem and f".{suffix.lower()}" in SUFFIXES else name
