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
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import pydantic
from pydantic import Field

from tron.captures import Capture, View
from tron.captures.view import Pixels
from tron.color import srgb_to_linear
from tron.errors import TronError
from tron.images import read_image
from tron.priors.map_files import MapFile, find_maps, match_by_name, match_by_order
from tron.priors.map_geometry import NormalFrame, resized, same_aspect, world_normals
from tron.priors.prior import CONFIG, FIELDS, Maps, Request

FileSpace = Literal["srgb", "linear"]

_LINEAR_SUFFIXES = (".exr", ".hdr")


@pydantic.dataclasses.dataclass(frozen=True, config=CONFIG)
class Precomputed:
    """Reads a folder of maps, each when it is asked for; layouts and names: :mod:`tron.priors.map_files`.

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

    folder: str
    color_space: FileSpace = "srgb"
    irradiance_space: FileSpace = "srgb"
    irradiance_scale: Annotated[float, Field(gt=0)] = 1.0
    normal_frame: NormalFrame = "camera_opengl"
    match: Literal["name", "order"] = "name"
    stretched: bool = False

    def __post_init__(self) -> None:
        find_maps(Path(self.folder))  # a folder that is not there is told before photos are posed

    @property
    def needs_geometry(self) -> frozenset[str]:
        """None: the files are there already."""
        return frozenset()

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

    def prepare(self, request: Request) -> Maps:
        """Nothing is read before a map is asked for."""
        matched = self._matched(request.capture)

        def maps(view: View) -> Mapping[str, Pixels]:
            files = matched[view.name]
            return {f: partial(self._read, f, files[f], view) for f in request.fields if f in files}

        return maps

    def _read(self, field: str, path: Path, view: View) -> np.ndarray:
        """One map in the view's pixels and in the space that View states."""
        pixels = read_image(path, channels=None)
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
        linear = path.suffix.lower() in _LINEAR_SUFFIXES
        color = pixels[..., : 3 if pixels.shape[2] >= 3 else 1]  # alpha is not part of a map
        if field == "normal":
            if color.shape[2] != 3:
                raise TronError("normal map is grey", path, "normals need three channels")
            unit = world_normals(color if linear else 2 * color - 1, camera, self.normal_frame)
            return world_normals(resized(unit, camera.width, camera.height), camera, "world")
        if field in ("roughness", "metallic", "sky_mask"):
            return resized(color.mean(axis=-1), camera.width, camera.height).clip(0, 1)
        space = self.color_space if field == "base_color" else self.irradiance_space
        rgb = color if linear or space == "linear" else srgb_to_linear(color)
        rgb = resized(np.broadcast_to(rgb, (*rgb.shape[:2], 3)), camera.width, camera.height)
        if field == "base_color":
            return rgb.clip(0, 1)
        return rgb.clip(0, None) * np.float32(self.irradiance_scale)
