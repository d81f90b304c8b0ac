"""Maps that another program has made: DiffusionRenderer's, RGB<->X's, or your own, from a folder.

What those programs write, read in their sources and issues:

- DiffusionRenderer (Liang et al. 2025): basecolor, normal, roughness, metallic (and depth), 8-bit PNG or
  JPEG; base color as it looks, sRGB; normals (n + 1) / 2 in camera space, x right, y up, z towards the viewer
  (the authors, nv-tlabs/cosmos-transfer1-diffusion-renderer issue 24). No irradiance. Pictures are stretched
  to 1280 x 704, or rounded to multiples of 64: ``stretched=True`` says so.
- RGB<->X (Zeng et al. 2024): albedo and irradiance with a 1/2.2 curve, roughness, metallic, normals in the
  same camera space. Its irradiance is clipped at 1 and of unknown scale: the environment's shape can be
  fitted to it, its brightness comes from the photos.

Maps must show the pixels of the view: where photos were undistorted, run the prior on the undistorted ones.

A file is known by its relative path alone, field and view in any of these places (FIELD in any spelling of
``ALIASES``, suffix of :mod:`tron.io.images`):

    FIELD/NAME.png                  one folder a field
    NAME/FIELD.png                  one folder a view
    NAME.FIELD.png, NAME-FIELD.png, NAME_FIELD.png
    NAME/0000.0000.FIELD.jpg        DiffusionRenderer, one frame a clip: chunk, frame, field
    CLIP/0000.0017.FIELD.png        DiffusionRenderer, many frames a clip: known by order only

The last two are what nv-tlabs' inference_inverse_renderer.py and inference_svd_rgbx.py write. RGB<->X's
program shows its maps and saves none; its examples are named NAME-FIELD.png.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path, PurePosixPath
from typing import Annotated, Literal

import numpy as np
import pydantic
from pydantic import Field

from tron.captures import Capture, View
from tron.captures.view import Pixels
from tron.color import srgb_to_linear
from tron.errors import TronError
from tron.io.images import SUFFIXES, read_image
from tron.reconstruction.priors.prior import (
    CONFIG,
    FIELDS,
    MapPrior,
    Maps,
    NormalFrame,
    resized,
    same_aspect,
    world_normals,
)

FileSpace = Literal["srgb", "linear"]

_LINEAR_SUFFIXES = (".exr", ".hdr")
ALIASES = {
    "normal": ("normal", "normals"),
    "base_color": ("basecolor", "base_color", "albedo", "diffuse_albedo"),
    "roughness": ("roughness",),
    "metallic": ("metallic", "metalness", "metallicness", "metallicity"),
    "irradiance": ("irradiance",),
    "sky_mask": ("sky_mask", "skymask", "sky"),
}
"""Spellings of each field, the preferred first where a folder holds several."""
_FIELD_OF = {alias: field for field, aliases in ALIASES.items() for alias in aliases}
_NAMED = re.compile(rf"(.*)[._-]({'|'.join(sorted(_FIELD_OF, key=len, reverse=True))})", re.IGNORECASE)
_NUMBERED = re.compile(r"\d{4,}\.\d{4,}")


@pydantic.dataclasses.dataclass(frozen=True, config=CONFIG)
class Precomputed(MapPrior):
    """Reads a folder of maps, each when it is asked for; layouts and names stand above.

    Attributes:
        folder: where the maps lie.
        color_space: of base color in PNG and JPEG; EXR and HDR are linear always.
        irradiance_space: of irradiance in PNG and JPEG, likewise.
        irradiance_scale: what linear irradiance is multiplied by; 1 where the file holds E / pi or a value of
            unknown scale, 1 / pi where it holds E.
        normal_frame: axes of the normals; (n + 1) / 2 in PNG and JPEG, signed in EXR.
        match: "name" finds a view's maps by its name; "order" takes the n-th map of each field for the n-th
            view of the capture, for clips whose frames are numbered.
        stretched: maps of other proportions than the view show the whole of it, stretched; else they are
            refused, since they may as well be cropped.

    Raises:
        ValidationError: an option that there is not.
        TronError: no such folder.
    """

    folder: str | Path
    color_space: FileSpace = "srgb"
    irradiance_space: FileSpace = "srgb"
    irradiance_scale: Annotated[float, Field(gt=0)] = 1.0
    normal_frame: NormalFrame = "camera_opengl"
    match: Literal["name", "order"] = "name"
    stretched: bool = False

    def __post_init__(self) -> None:
        find_maps(Path(self.folder))  # a folder that is not there is told before photos are posed

    @cached_property
    def _files(self) -> list[MapFile]:
        return find_maps(Path(self.folder))

    def _matched(self, capture: Capture) -> Mapping[str, Mapping[str, Path]]:
        names = [view.name for view in capture.views]
        match = match_by_name if self.match == "name" else match_by_order
        return match(self._files, names)

    def fields(self, capture: Capture) -> Mapping[str, str]:
        """The fields that any training view has a file of, and for how many.

        Raises:
            TronError: the folder holds no map of any training view.
        """
        matched = self._matched(capture)
        train = [matched[view.name] for view in capture.train_views]
        counts = {field: sum(field in files for files in train) for field in FIELDS}
        if not any(counts.values()):
            found = f"{len(self._files)} maps of other names" if self._files else "no maps"
            raise TronError(
                f"{found} for {len(train)} views such as {capture.train_views[0].name}",
                self.folder,
                "name them FIELD/NAME.png, or match by order; fields are " + ", ".join(FIELDS),
            )
        return {field: f"files of {n} of {len(train)} views" for field, n in counts.items() if n}

    def prepare(self, capture: Capture, fields: Collection[str]) -> Maps:
        """Nothing is read before a map is asked for."""
        matched = self._matched(capture)

        def maps(view: View) -> Mapping[str, Pixels]:
            files = matched[view.name]
            return {f: partial(self._read, f, files[f], view) for f in fields if f in files}

        return maps

    def _read(self, field: str, path: Path, view: View) -> np.ndarray:
        """One map in the view's pixels and in the space that View states."""
        linear = path.suffix.lower() in _LINEAR_SUFFIXES
        space = {"base_color": self.color_space, "irradiance": self.irradiance_space}.get(field)
        # Tags of a PNG are of display values: where its values are called linear they are taken as they are.
        pixels = read_image(path, None, color=space is not None and (linear or space != "linear"))
        if not np.isfinite(pixels).all():
            raise TronError(f"{field} map holds values that are NaN or infinite", path)
        camera = view.camera
        if not self.stretched and not same_aspect(pixels, camera):
            raise TronError(
                f"{field} map of {pixels.shape[1]} x {pixels.shape[0]} pixels does not fit the view's "
                f"{camera.width} x {camera.height}",
                path,
                "make it of the whole view, and if it is only stretched, set stretched=true",
            )
        color = pixels[..., : 3 if pixels.shape[2] >= 3 else 1]  # alpha is not part of a map
        if field == "normal":
            if color.shape[2] != 3:
                raise TronError("normal map is grey", path, "normals need three channels")
            unit = world_normals(color if linear else 2 * color - 1, camera, self.normal_frame)
            return world_normals(resized(unit, camera.width, camera.height), camera, "world")
        if field in ("roughness", "metallic", "sky_mask"):
            return resized(color.mean(axis=-1), camera.width, camera.height).clip(0, 1)
        rgb = color if linear or space == "linear" else srgb_to_linear(color)
        rgb = resized(np.broadcast_to(rgb, (*rgb.shape[:2], 3)), camera.width, camera.height)
        if field == "base_color":
            return rgb.clip(0, 1)
        return rgb.clip(0, None) * np.float32(self.irradiance_scale)


@dataclass(frozen=True)
class MapFile:
    """One file: which field it shows, of what, and how much it is preferred (least is best).

    ``view`` is the view's name without its suffix, or the name of the clip where ``frame`` says which.
    """

    path: Path
    field: str
    view: str
    frame: str | None
    rank: tuple[int, int]


def find_maps(folder: Path) -> list[MapFile]:
    """Every map below a folder, sorted by path.

    Raises:
        TronError: the folder is missing.
    """
    if not folder.is_dir():
        raise TronError("folder of prior maps not found", folder, "give the folder that the prior wrote")
    paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES and path.is_file())
    known = (_known(path, PurePosixPath(path.relative_to(folder).as_posix())) for path in paths)
    return [file for file in known if file is not None]


def _known(path: Path, relative: PurePosixPath) -> MapFile | None:
    folders, stem = list(relative.parts[:-1]), relative.stem
    alias, frame = None, None
    for i, folder in enumerate(folders):
        if folder.lower() in _FIELD_OF:
            alias = folder.lower()
            name = [*folders[:i], *folders[i + 1 :], stem]
            break
    else:
        if stem.lower() in _FIELD_OF and folders:
            alias, name = stem.lower(), folders
        elif match := _NAMED.fullmatch(stem):
            alias, name = match[2].lower(), [*folders, match[1]]
            if _NUMBERED.fullmatch(match[1]):
                name, frame = folders, match[1]
    if alias is None:
        return None
    field = _FIELD_OF[alias]
    rank = (ALIASES[field].index(alias), SUFFIXES.index(path.suffix.lower()))
    return MapFile(path, field, "/".join(name), frame, rank)


def view_key(name: str) -> str:
    """The name of a view as map files know it: forward slashes, no image suffix."""
    path = PurePosixPath(name.replace("\\", "/"))
    return str(path.with_suffix("")) if path.suffix.lower() in SUFFIXES else str(path)


def match_by_name(files: Sequence[MapFile], views: Sequence[str]) -> Mapping[str, Mapping[str, Path]]:
    """view -> field -> file, by the whole name, or by its last part where that tells all views apart.

    Raises:
        TronError: two files are equally good for one field of one view.
    """
    keys = {view: view_key(view) for view in views}
    last = [key.rsplit("/", 1)[-1] for key in keys.values()]
    short = len(set(last)) == len(last)
    by_name: dict[tuple[str, str], list[MapFile]] = {}
    counts: dict[tuple[str, str], int] = {}
    for file in files:
        if file.frame is not None:
            counts[file.view, file.field] = counts.get((file.view, file.field), 0) + 1
        for name in {file.view, file.view.rsplit("/", 1)[-1]} if short else {file.view}:
            by_name.setdefault((name, file.field), []).append(file)
    matched: dict[str, dict[str, Path]] = {view: {} for view in views}
    for view, key in keys.items():
        for field in ALIASES:
            names = (key, key.rsplit("/", 1)[-1]) if short else (key,)
            found = next((by_name[name, field] for name in names if (name, field) in by_name), [])
            # A clip of many frames that happens to bear the name of a view is not that view.
            found = [file for file in found if file.frame is None or counts[file.view, field] == 1]
            if found:
                matched[view][field] = _best(found, view)
    return matched


def match_by_order(files: Sequence[MapFile], views: Sequence[str]) -> Mapping[str, Mapping[str, Path]]:
    """view -> field -> file, the files of a field in the order of their paths, the views in theirs.

    Raises:
        TronError: a field has more or fewer files than there are views.
    """
    matched: dict[str, dict[str, Path]] = {view: {} for view in views}
    for field in ALIASES:
        ranks = sorted({file.rank for file in files if file.field == field})
        chosen = [file for file in files if file.field == field and file.rank == ranks[0]]
        if chosen and len(chosen) != len(views):
            raise TronError(
                f"{len(chosen)} {field} maps for {len(views)} views",
                chosen[0].path.parent,
                "matching by order needs one each; let chunks neither overlap nor be padded",
            )
        for view, file in zip(views, chosen, strict=False):
            matched[view][field] = file.path
    return matched


def _best(files: Sequence[MapFile], view: str) -> Path:
    first, *others = sorted(files, key=lambda file: file.rank)
    if others and others[0].rank == first.rank:
        raise TronError(
            f"two files are the {first.field} of view {view}: {first.path.name} and {others[0].path.name}",
            first.path.parent,
            "keep one",
        )
    return first.path
