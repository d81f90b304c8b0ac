"""Photos without poses, posed by pycolmap: SIFT, matching and incremental mapping on the CPU.

Each photo is matched with those that share most coarse features with it
(:mod:`tron.captures.posing.structure_from_motion`).

Features are sought in upright, reduced copies, so that nothing in the files (EXIF orientation, 16 bits,
alpha) can be read in two ways. The copies of photos that one camera and lens took at one size lie in a folder
of their own and share a camera, COLMAP's OPENCV model refined with the poses. Photos of 360 degrees
(:mod:`tron.captures.posing.wide_pictures`) have COLMAP's EQUIRECTANGULAR, and become six views.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
from collections.abc import Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image, ImageOps
from scipy.sparse.csgraph import minimum_spanning_tree

from tron.captures.formats.colmap import INPUT, lens_of
from tron.captures.masks import mask_values
from tron.captures.photos.image_folder import photos_in
from tron.captures.photos.photo_files import (
    PhotoHeader,
    decode_photo,
    exposure_of,
    inspect_photo,
    open_photo,
    require_decoders,
)
from tron.captures.photos.photo_views import mask_of
from tron.captures.photos.photographs import PosedPhoto, PosedPhotos
from tron.captures.posing.wide_pictures import equirectangular, refuse_discs
from tron.captures.settings import PosingSettings
from tron.errors import TronError
from tron.io.colmap import points_of, posed_by, read_model
from tron.lenses import impossible, load_pycolmap
from tron.storage import locked, sha256, write_atomic

if TYPE_CHECKING:
    import pycolmap


log = logging.getLogger(__name__)

WORKSPACE = "structure_from_motion"
_VERSION = 3
_EXIF_FOLDER = 0x8769
_CAMERA_TAGS = (0x010F, 0x0110)  # make, model
_LENS_TAGS = (0x920A, 0xA405, 0xA404)  # focal length, the same for 35 mm film, digital zoom
_FOCAL_35MM = 0xA405
_NEAREST = 16
_FEWEST = 3
_QUALITY = 95
_PANORAMA = "panorama_"
"""Prefix of the folders of equirectangular copies."""
_PANORAMA_SIDE = 3
"""Times the pixels a side of other copies: all around is six usual views wide; features need half of that."""


def has_photos(path: Path) -> bool:
    """Whether a folder, or ``images`` or 3DGS' ``input`` in it, holds photos."""
    return _folder_of_photos(path) is not None


def _folder_of_photos(path: Path) -> Path | None:
    return next((each for each in (path / "images", path, path / INPUT) if photos_in(each)), None)


def pose_photos(path: Path, settings: PosingSettings) -> PosedPhotos:
    """Pose the photos of a folder; the world's scale and axes are arbitrary.

    The result is kept in the workspace and taken from there while photos and settings stay the same. Of
    several models that do not connect the largest is taken; photos outside of it are skipped.

    Args:
        path: holds the photos, itself or in ``images`` or ``input``.
        settings: ``images`` names another folder in it.

    Raises:
        TronError: fewer than three usable photos, or none that could be posed.
    """
    folder = path / settings.images if settings.images else _folder_of_photos(path) or path
    workspace = settings.workspace or folder / WORKSPACE
    skipped: dict[str, str] = {}
    photos: dict[Path, PhotoHeader] = {}
    masks: dict[Path, Path] = {}
    found = photos_in(folder)
    require_decoders(found)
    for path in found:
        try:
            header = inspect_photo(path)
            mask = mask_of(path, header, settings.masks, upright=True)
            photos[path] = header
            if mask is not None and settings.masks == "ignore":
                masks[path] = mask[0]
        except TronError as error:
            skipped[path.name] = error.what
    if len(photos) < _FEWEST:
        raise TronError(
            f"{len(photos)} usable photos{f', {len(skipped)} damaged' if skipped else ''}",
            folder,
            f"posing photos needs at least {_FEWEST}, overlapping",
        )
    exposure = exposure_of(photos, settings.exr_exposure)
    opened = {path: partial(open_photo, path, header, exposure) for path, header in photos.items()}
    refuse_discs(photos, lambda path: opened[path]())
    panoramas = equirectangular(photos, lambda path: opened[path]())
    if panoramas:
        log.info("%d of %d photos show 360 degrees", len(panoramas), len(photos))
    with locked(workspace):
        copies = _posed_copies(photos, panoramas, masks, workspace, settings)
        model = read_model(workspace / "sparse")
    by_name = {path.name: path for path in photos}
    posed = []
    for copy, camera_to_world, lens in posed_by(model):
        name, wrong = copies[copy], impossible(lens)
        posed.append(PosedPhoto(name, by_name.pop(name), camera_to_world, lens_of(lens), refused=wrong))
    skipped |= dict.fromkeys(by_name, "not posed: too few features in common with the others")
    points, colors = points_of(model)
    return PosedPhotos(folder, posed, points, colors, skipped=skipped, upright=True)


def _posed_copies(
    photos: Mapping[Path, PhotoHeader],
    panoramas: Collection[Path],
    masks: Mapping[Path, Path],
    workspace: Path,
    settings: PosingSettings,
) -> dict[str, str]:
    """Names of photos by those of their posed copies; makes the model unless it is kept."""
    record = workspace / "photos.json"
    wanted = {
        "version": _VERSION,
        "photos": {path.name: sha256(path) for path in photos},
        "masks": {path.name: sha256(mask) for path, mask in masks.items()},
        "matching": settings.matching,
        "max_side": settings.feature_side,
        "features": settings.features,
        "seed": settings.seed,
        **({"panoramas": sorted(path.name for path in panoramas)} if panoramas else {}),
    }
    kept = _kept(record)
    if kept.get("wanted") == wanted and (workspace / "sparse").is_dir():
        log.info("poses of %d photos taken from %s", len(photos), workspace)
        return kept["copies"]
    record.unlink(missing_ok=True)
    _clear(workspace, "images", "masks", "models", "sparse")
    log.info("copying %d photos for feature extraction", len(photos))
    copies = _copy(photos, workspace / "images", settings.feature_side, settings.exr_exposure, panoramas)
    if masks:
        _copy_masks({copies[name]: name for name in copies}, masks, workspace)
    _map(workspace, len(photos), settings)
    write_atomic(record, json.dumps({"wanted": wanted, "copies": copies}, indent=1))
    _clear(workspace, "images", "masks", "models")
    return copies


def _clear(workspace: Path, *folders: str) -> None:
    for name in folders:
        shutil.rmtree(workspace / name, ignore_errors=True)
    for stale in (*workspace.glob("database.db*"), *workspace.glob("pairs.txt")):
        stale.unlink()


def _kept(record: Path) -> dict[str, Any]:
    try:
        kept = json.loads(record.read_text("utf-8"))
    except (OSError, ValueError):
        return {}
    return kept if isinstance(kept, dict) and isinstance(kept.get("copies"), dict) else {}


def _copy(
    photos: Mapping[Path, PhotoHeader],
    folder: Path,
    max_side: int,
    exr_exposure: float | None = None,
    panoramas: Collection[Path] = (),
) -> dict[str, str]:
    """Write upright 8-bit copies, one folder per camera; return their names below ``folder``."""
    exposure = exposure_of(photos, exr_exposure)
    cameras: dict[tuple[Any, ...], str] = {}
    copies = {}
    for index, (path, header) in enumerate(photos.items()):
        with open_photo(path, header, exposure) as picture:
            exif = picture.getexif()
            lens = exif.get_ifd(_EXIF_FOLDER)
            upright = ImageOps.exif_transpose(picture)
            whole = path in panoramas
            key = (
                whole,
                upright.size,
                *(exif.get(t) for t in _CAMERA_TAGS),
                *(str(lens.get(t)) for t in _LENS_TAGS),
            )
            group = cameras.setdefault(key, f"{_PANORAMA if whole else 'camera_'}{len(cameras):03d}")
            upright = _eight_bits(upright)
            side = max_side * (_PANORAMA_SIDE if whole else 1)
            upright.thumbnail((side, side), Image.Resampling.LANCZOS, reducing_gap=None)
            kept = Image.Exif()
            if lens.get(_FOCAL_35MM):
                kept.get_ifd(_EXIF_FOLDER)[_FOCAL_35MM] = lens[_FOCAL_35MM]
            copy = f"{group}/{index:05d}.jpg"
            (folder / group).mkdir(parents=True, exist_ok=True)
            upright.save(folder / copy, quality=_QUALITY, exif=kept)
            copies[copy] = path.name
    return copies


def _copy_masks(copies: Mapping[str, str], masks: Mapping[Path, Path], workspace: Path) -> None:
    """Write a mask beside each copy, by the photos' names: features are sought where it is not black."""
    by_photo = {photo.name: mask for photo, mask in masks.items()}
    for photo, copy in copies.items():
        with Image.open(workspace / "images" / copy) as picture:
            size = picture.size
        mask = Image.new("L", size, 255)
        if photo in by_photo:
            values = mask_values(
                decode_photo(by_photo[photo], inspect_photo(by_photo[photo], color=False)), "ignore"
            )
            mask = Image.fromarray(values[..., 0]).resize(size, Image.Resampling.NEAREST)
        path = workspace / "masks" / f"{copy}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        mask.save(path)


def _eight_bits(picture: Image.Image) -> Image.Image:
    if picture.mode.startswith(("I", "F")):  # 16 bits of grey, which Pillow would clip
        return picture.point(lambda value: value / 257).convert("L").convert("RGB")
    return picture.convert("RGB")


def _map(workspace: Path, count: int, settings: PosingSettings) -> None:
    """Make ``workspace/sparse`` of ``workspace/images``: the largest model."""
    pycolmap = load_pycolmap()
    pycolmap.set_random_seed(settings.seed)
    threads = settings.threads or (os.cpu_count() or 1)
    database, images = workspace / "database.db", workspace / "images"
    reader = pycolmap.ImageReaderOptions()
    if (workspace / "masks").is_dir():
        reader.mask_path = workspace / "masks"
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads, extraction.use_gpu = threads, False
    extraction.sift.max_num_features = settings.features
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads, matching.use_gpu = threads, False
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = settings.seed
    try:
        log.info("extracting features of %d photos", count)
        names = sorted(each.relative_to(images).as_posix() for each in images.rglob("*.jpg"))
        for reader.camera_model, whole in (("OPENCV", False), ("EQUIRECTANGULAR", True)):
            if not (some := [name for name in names if name.startswith(_PANORAMA) == whole]):
                continue
            pycolmap.extract_features(
                database,
                images,
                image_names=some,
                camera_mode=pycolmap.CameraMode.PER_FOLDER,
                reader_options=reader,
                extraction_options=extraction,
                device=pycolmap.Device.cpu,
            )
        options = {
            "matching_options": matching,
            "verification_options": verification,
            "device": pycolmap.Device.cpu,
        }
        if settings.matching == "sequential":
            log.info("matching features of neighbours in time")
            pycolmap.match_sequential(database, **options)
        elif settings.matching == "exhaustive":
            log.info("matching features of every pair")
            pycolmap.match_exhaustive(database, **options)
        else:
            pairs = _write_pairs(database, workspace / "pairs.txt")
            log.info("matching features of %d pairs out of %d", pairs, count * (count - 1) // 2)
            pairing = pycolmap.ImportedPairingOptions()
            pairing.match_list_path = workspace / "pairs.txt"
            pycolmap.match_image_pairs(database, pairing_options=pairing, **options)
        log.info("finding cameras and points")
        models = pycolmap.incremental_mapping(
            database, images, workspace / "models", options=_mapping_options(count, threads, settings.seed)
        )
    except Exception as error:  # pycolmap raises ValueError, RuntimeError, OSError and its own
        raise TronError(f"structure from motion failed: {error}", workspace) from error
    if not models:
        raise TronError(
            f"none of {count} photos could be posed",
            images,
            "take more photos that overlap by half or more, from different places, of a textured scene",
        )
    largest = max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()))
    posed, points = largest.num_reg_images(), largest.num_points3D()
    log.info("%d of %d photos posed, %d points", posed, count, points)
    (workspace / "sparse").mkdir()
    largest.write_binary(workspace / "sparse")


def _write_pairs(database: Path, file: Path) -> int:
    """Write COLMAP's list of the pairs that are likely to overlap; return their number."""
    descriptors = coarse_descriptors(database)
    names = list(descriptors)
    pairs = overlapping_pairs(list(descriptors.values()), _NEAREST)
    file.write_text("".join(f"{names[i]} {names[j]}\n" for i, j in pairs), "utf-8")
    return len(pairs)


def _mapping_options(count: int, threads: int, seed: int) -> pycolmap.IncrementalPipelineOptions:
    pycolmap = load_pycolmap()
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = threads, seed
    options.mapper.num_threads, options.mapper.random_seed = threads, seed
    options.triangulation.random_seed = seed
    options.min_model_size = min(options.min_model_size, count)
    return options


# Comparing all features of all pairs takes most of the time of structure from motion, and most pairs of a
# walk around something show nothing in common. Features of the largest scales are few and are found again
# from elsewhere more often than fine ones; photos that overlap share some of them (preemptive feature
# matching, Wu 2013, "Towards linear-time incremental structure from motion").

_COARSEST = 250
_RATIO = 0.8  # of the distances to the nearest and the second nearest descriptor (Lowe 2004)


def coarse_descriptors(database: Path) -> dict[str, np.ndarray]:
    """Descriptors (at most 250, 128) float32 of unit length of each image's largest features, by its name.

    Args:
        database: COLMAP's, with SIFT features.
    """
    import pycolmap

    found = {}
    store = pycolmap.Database.open(database)
    try:
        for image in store.read_all_images():
            keypoints = store.read_keypoints(image.image_id)
            area = np.abs(keypoints[:, 2] * keypoints[:, 5] - keypoints[:, 3] * keypoints[:, 4])
            largest = np.sort(np.argsort(-area, kind="stable")[:_COARSEST])
            values = store.read_descriptors(image.image_id).data[largest].astype(np.float32)
            found[image.name] = values / np.linalg.norm(values, axis=1, keepdims=True).clip(1e-6)
    finally:
        store.close()
    return found


def overlapping_pairs(descriptors: Sequence[np.ndarray], nearest: int) -> list[tuple[int, int]]:
    """Pairs (i < j) of photos, each with those ``nearest`` that share most descriptors with it.

    Pairs that connect all photos, of those that share most (the maximum spanning tree), are among them.

    Args:
        descriptors: (N, 128) of unit length, of each photo.
        nearest: photos of each; where there are hardly more, all pairs are given.
    """
    count = len(descriptors)
    if count <= nearest + 1:
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    shared = np.zeros((count, count), int)
    for i in range(count):
        for j in range(i + 1, count):
            shared[i, j] = shared[j, i] = _matches(descriptors[i], descriptors[j])
    chosen = np.zeros((count, count), bool)
    ranked = shared - count * np.eye(count, dtype=int)
    best = np.argsort(-ranked, axis=1, kind="stable")[:, :nearest]
    np.put_along_axis(chosen, best, values=True, axis=1)
    chosen |= minimum_spanning_tree(1 / (1.0 + shared) * (1 - np.eye(count))).toarray() > 0
    i, j = np.nonzero(np.triu(chosen | chosen.T, 1))
    return list(zip(i.tolist(), j.tolist()))


def _matches(a: np.ndarray, b: np.ndarray) -> int:
    """Number of descriptors that are each other's nearest and stand out from the second nearest."""
    if len(a) < 2 or len(b) < 2:
        return 0
    cosine = a @ b.T
    forth, back = cosine.argmax(1), cosine.argmax(0)
    mutual = back[forth] == np.arange(len(a))
    second, first = np.partition(cosine, -2, axis=1)[:, -2:].T
    distance, next_distance = (np.arccos(np.clip(value, -1, 1)) for value in (first, second))
    return int((mutual & (distance < _RATIO * next_distance)).sum())
