"""The scale of a capture in metres: by two cameras whose distance is known, or by the photos' GPS.

Photos alone fix a scene up to its size. Only the size is changed: which way is up, and where zero lies, stay.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from tron.captures.photos.photographs import PosedPhoto, PosedPhotos
from tron.errors import TronError

log = logging.getLogger(__name__)

Scale = Literal["gps"] | tuple[str, str, float]
_GPS_IFD = 0x8825
_EQUATOR, _FLATTENING = 6_378_137.0, 1 / 298.257223563
"""Of WGS84: metres, and the share by which the poles are nearer."""
_LEAST = 4
_OUTLIER, _ROUNDS = 3.0, 3
_WORST = 0.3
"""Largest median distance from GPS to the fitted cameras, as a share of their spread."""


def in_metres(posed: PosedPhotos, scale: Scale) -> PosedPhotos:
    """The photos, their depths and the points in a world whose unit is the metre.

    Args:
        posed: as the file has it.
        scale: ``gps``, or the names of two photos and the metres between their cameras.

    Raises:
        TronError: no such photo, no distance, too few photos with GPS, or GPS that fits no scale.
    """
    posed_ones = [photo for photo in posed.photos if photo.refused is None]
    factor = _by_gps(posed_ones, posed.source) if scale == "gps" else _by_two(posed_ones, scale)
    log.info("%s: one unit of the file is %.4g metres", posed.source, factor)
    photos = [photo if photo.refused is not None else _grown(photo, factor) for photo in posed.photos]
    points = None if posed.points is None else np.asarray(posed.points, np.float64) * factor
    grow = np.diag([factor, factor, factor, 1.0])
    return replace(posed, photos=photos, points=points, transform=grow @ posed.transform)


def _grown(photo: PosedPhoto, factor: float) -> PosedPhoto:
    matrix = np.array(photo.camera_to_world, np.float64)
    matrix[:3, 3] *= factor
    return replace(photo, camera_to_world=matrix, depth_scale=photo.depth_scale * factor)


def _position(photo: PosedPhoto) -> np.ndarray:
    return np.array(photo.camera_to_world, np.float64)[:3, 3]


def _by_two(photos: Sequence[PosedPhoto], scale: tuple[str, str, float]) -> float:
    first, second, metres = scale
    places = []
    for name in (first, second):
        found = [p for p in photos if name in (p.name, Path(p.name).name, Path(p.name).stem)]
        if len(found) != 1:
            what = "no photo" if not found else f"{len(found)} photos"
            raise TronError(f"{what} of the name {name}", "scale", "give the names of two photos, and metres")
        places.append(_position(found[0]))
    apart = float(np.linalg.norm(places[0] - places[1]))
    if not (apart > 0 and np.isfinite(metres) and metres > 0):
        raise TronError(f"{apart:g} units between the cameras are to be {metres:g} metres", "scale")
    return metres / apart


def _by_gps(photos: Sequence[PosedPhoto], source: Path) -> float:
    """Scale of the similarity from cameras to GPS (least squares; Umeyama 1991), outliers left out."""
    pairs = [(_position(p), at) for p in photos if p.path is not None and (at := gps_of(p.path)) is not None]
    if len(pairs) < _LEAST:
        mend = "give scale=[PHOTO,PHOTO,METRES]"
        raise TronError(f"{len(pairs)} of {len(photos)} photos have GPS, {_LEAST} are needed", source, mend)
    cameras = np.array([camera for camera, _ in pairs])
    places = earth_centred(np.array([at for _, at in pairs]))
    kept = np.ones(len(cameras), bool)
    factor, away = 0.0, np.zeros(len(cameras))
    for _ in range(_ROUNDS):
        a, b = cameras - cameras[kept].mean(0), places - places[kept].mean(0)
        turn = Rotation.align_vectors(b[kept], a[kept])[0]
        turned = turn.apply(a)
        factor = float((turned[kept] * b[kept]).sum() / max((a[kept] ** 2).sum(), 1e-300))
        away = np.linalg.norm(b - factor * turned, axis=1)
        kept = away <= max(_OUTLIER * float(np.median(away)), 1e-9)
    spread = float(np.sqrt(((places[kept] - places[kept].mean(0)) ** 2).sum(1).mean()))
    error = float(np.median(away))
    if not (factor > 0 and error < _WORST * spread):
        mend = "walk further, or give scale=[PHOTO,PHOTO,METRES]"
        raise TronError(
            f"GPS is off by {error:.2g} m over {spread:.2g} m, so it tells no scale", source, mend
        )
    log.info("%s: GPS of %d photos is off by %.2g m (median) over %.3g m", source, len(pairs), error, spread)
    return factor


def gps_of(path: Path) -> tuple[float, float, float] | None:
    """Latitude and longitude in degrees and metres of height of a photo's EXIF; None where it has none."""
    try:
        with Image.open(path) as picture:
            gps = picture.getexif().get_ifd(_GPS_IFD)
        degrees = [sum(float(part) / 60**k for k, part in enumerate(gps[tag])) for tag in (2, 4)]
        height = float(gps.get(6, 0.0)) * (-1 if gps.get(5) in (1, b"\x01") else 1)
        latitude = -degrees[0] if str(gps.get(1, "N")).upper().startswith("S") else degrees[0]
        longitude = -degrees[1] if str(gps.get(3, "E")).upper().startswith("W") else degrees[1]
    except (OSError, SyntaxError, KeyError, TypeError, ValueError, ZeroDivisionError):
        return None
    return (latitude, longitude, height) if np.isfinite([latitude, longitude, height]).all() else None


def earth_centred(places: np.ndarray) -> np.ndarray:
    """(N, 3) metres from the centre of WGS84's ellipsoid, of latitudes, longitudes and heights (N, 3)."""
    latitude, longitude, height = np.radians(places[:, 0]), np.radians(places[:, 1]), places[:, 2]
    square = _FLATTENING * (2 - _FLATTENING)
    normal = _EQUATOR / np.sqrt(1 - square * np.sin(latitude) ** 2)
    out = (normal + height) * np.cos(latitude)
    up = (normal * (1 - square) + height) * np.sin(latitude)
    return np.stack([out * np.cos(longitude), out * np.sin(longitude), up], axis=1)
