"""Windows of larger pictures as frames: many scales at the cost of small frames.

A window is a camera with another principal point. Where it lies follows from a seed and from what the picture
shows. Filters of guidance look beyond a window's edge as they do in the picture:
it is traced with a margin, and cut.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datagen.dataset.spool import Frame
from datagen.settings.split import SplitSettings
from datagen.truth.build import FIRST_ID, Geometry
from datagen.truth.pathtrace import gbuffers
from datagen.world.scene import SceneSpec
from tron.cameras import Camera
from tron.seeds import generator
from tron.shading.direct.visibility import FILTER_REACH

MARGIN = FILTER_REACH
"""Pixels around a window that guidance is traced of too."""
OF_OBJECTS = 0.5
"""Share of the windows that are about an object."""
COARSE = 64
"""Width, in pixels, of the view that tells where a picture shows something."""


@dataclass(frozen=True)
class Window:
    """Part of a picture, in its pixels.

    Attributes:
        picture: camera of the whole.
        x, y: upper left pixel. width, height: of the part.
    """

    picture: Camera
    x: int
    y: int
    width: int
    height: int

    @property
    def camera(self) -> Camera:
        """Camera of the part."""
        return self.picture.window(self.x, self.y, self.width, self.height)

    def with_margin(self) -> Window:
        """Return the window with :data:`MARGIN` around it, inside the picture."""
        left, top = max(self.x - MARGIN, 0), max(self.y - MARGIN, 0)
        right = min(self.x + self.width + MARGIN, self.picture.width)
        bottom = min(self.y + self.height + MARGIN, self.picture.height)
        return Window(self.picture, left, top, right - left, bottom - top)

    def cut(self, frame: Frame) -> Frame:
        """Images (H, W, ...) of :meth:`with_margin`, without the margin."""
        wide = self.with_margin()
        rows = slice(self.y - wide.y, self.y - wide.y + self.height)
        columns = slice(self.x - wide.x, self.x - wide.x + self.width)
        return {name: image[rows, columns] for name, image in frame.items()}


def draw_windows(spec: SceneSpec, geometry: Geometry, recipe: SplitSettings, light: int) -> list[Window]:
    """Draw the windows of a clip, one per frame; whole pictures if the recipe has no windows.

    Frames that are neighbours of one clip (``window_each=clip``) follow one point of the scene in pictures of
    one size, as far as the picture goes; else each frame draws its own.

    Args:
        spec, geometry: the scene, its objects where they are at first.
        recipe: of its split.
        light: number of the first of the lights that the clip is filmed under.
    """
    windows: list[Window] = []
    width, height, point = recipe.width, recipe.height, None
    for i in range(recipe.frames):
        draw = generator(spec.seed, spec.split, spec.index, "window", light, i)
        drawn = i == 0 or recipe.window_each == "frame"
        if drawn:
            width, height = recipe.pictures[int(draw.integers(len(recipe.pictures)))]
        picture = spec.clip(light, recipe.frames, width, height)[i]
        if drawn and (width, height) != (recipe.width, recipe.height):
            point = _point(picture, geometry, len(spec.surroundings), draw)
        middle = np.array([width, height]) / 2
        if point is not None:
            places, depths = picture.project(point[None])
            middle = places[0] if depths[0] > 0 else middle
        corner = np.round(middle - np.array([recipe.width, recipe.height]) / 2)
        x, y = np.clip(corner, 0, [width - recipe.width, height - recipe.height]).astype(int).tolist()
        windows.append(Window(picture, x, y, recipe.width, recipe.height))
    return windows


def _point(
    picture: Camera, geometry: Geometry, surroundings: int, draw: np.random.Generator
) -> np.ndarray | None:
    """Return a random visible surface point (3,), world; None if no surface is visible.

    Half of them lie on an object where one is seen: floors and skies teach little.
    """
    rows = max(1, round(COARSE * picture.height / picture.width))
    (seen,) = gbuffers(geometry, [picture.resized(COARSE, rows)])
    objects = seen.valid & (seen.object_id >= FIRST_ID + surroundings)
    wanted = objects if draw.random() < OF_OBJECTS and objects.any() else seen.valid
    points = seen.position[wanted]
    return points[int(draw.integers(len(points)))] if len(points) else None
