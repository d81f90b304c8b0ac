"""A capture: named views of one scene, some of them held out, with what was found of its geometry."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from tron.cameras import Camera
from tron.captures.view import MAPS, ToneCurve, View
from tron.errors import TronError
from tron.gaussians.scene import GaussianScene


@dataclass(frozen=True, eq=False)
class Capture:
    """Posed views of one scene under one light.

    Attributes:
        views: in the order of their names or of time; names are unique.
        test: names of the views that are held out; the others train.
        points: (N, 3) float32 points on surfaces, world, if some are known.
        point_colors: (N, 3) float32 of the points, display space.
        up: (3,) float64 unit up direction, world.
        transform: (4, 4) float64 from the world of the files that the capture was read from to its world.
        offset: (3,) float64 what was taken away from large coordinates, such as those of UTM, to be added
            again (:mod:`tron.io.local_frame`); zero in most captures.
        exposure: what linear radiance is multiplied by before AgX to look like the images; one number for
            all, because all show one light. Radiance of unknown scale has 1.
        skipped: what the files name and the capture lacks: name -> why, such as "image not found".
        tone_curve: that display images went through.
        scan: surfels that were filmed and are to stay; None: a reconstruction makes its own.

    Raises:
        TronError: no views, names that repeat, a held-out name that no view has, no view left to train on,
            points or an up direction that are not what is said above.
    """

    views: tuple[View, ...]
    test: frozenset[str] = frozenset()
    points: np.ndarray | None = None
    point_colors: np.ndarray | None = None
    up: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    exposure: float = 1.0
    transform: np.ndarray = field(default_factory=lambda: np.eye(4))
    skipped: Mapping[str, str] = field(default_factory=dict)
    tone_curve: ToneCurve = "srgb"
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))
    scan: GaussianScene | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "views", tuple(self.views))
        object.__setattr__(self, "test", frozenset(self.test))
        object.__setattr__(self, "up", np.asarray(self.up, np.float64))
        object.__setattr__(self, "transform", np.asarray(self.transform, np.float64))
        object.__setattr__(self, "offset", np.asarray(self.offset, np.float64))
        self._check_names()
        if self.transform.shape != (4, 4) or not np.isfinite(self.transform).all():
            raise TronError("transform of a capture is not a finite 4 x 4 matrix")
        if self.up.shape != (3,) or not abs(np.linalg.norm(self.up) - 1) < 1e-3:
            raise TronError(f"up of a capture is {self.up.tolist()}", mend="give a unit vector")
        if not (np.isfinite(self.exposure) and self.exposure > 0):
            raise TronError(f"exposure of a capture is {self.exposure}", mend="give a positive number")
        for name in ("points", "point_colors"):
            value = getattr(self, name)
            if value is None:
                continue
            value = np.ascontiguousarray(value, np.float32)
            if value.ndim != 2 or value.shape[1] != 3 or not np.isfinite(value).all():
                raise TronError(f"{name} of a capture must be finite (N, 3), not {value.shape}")
            object.__setattr__(self, name, value)
        if self.point_colors is not None and (
            self.points is None or len(self.points) != len(self.point_colors)
        ):
            raise TronError("point_colors of a capture do not match its points")

    def _check_names(self) -> None:
        if not self.views:
            raise TronError("a capture has no views")
        counts = Counter(view.name for view in self.views)
        name, times = counts.most_common(1)[0]
        if times > 1:
            raise TronError(f"{times} views of a capture are named {name!r}", mend="names must be unique")
        unknown = sorted(self.test - counts.keys())
        if unknown:
            raise TronError(f"held-out view {unknown[0]!r} is not among the views")
        if len(self.test) == len(self.views):
            raise TronError("all views of a capture are held out", mend="leave some to train on")

    @property
    def train_views(self) -> Sequence[View]:
        """The views that are learnt from, in order."""
        return [view for view in self.views if view.name not in self.test]

    @property
    def train_cameras(self) -> list[Camera]:
        """Cameras of the views that are learnt from, in order."""
        return [view.camera for view in self.train_views]

    @cached_property
    def content(self) -> str:
        """Hash of all that the training views show (see :func:`content_hash`)."""
        return content_hash(self.train_views)

    @property
    def test_views(self) -> Sequence[View]:
        """The held-out views, in order."""
        return [view for view in self.views if view.name in self.test]


def content_hash(views: Iterable[View]) -> str:
    """SHA-256 of the views' names, cameras, images and maps, as 64 hexadecimal digits.

    Values are hashed as they are read, so that whatever changes them counts: a file that was replaced, its
    size, the exposure of an EXR, the way that masks are taken.

    Raises:
        TronError: an image or map that cannot be read.
    """
    digest = hashlib.sha256()
    for view in views:
        digest.update(repr((view.name, view.camera.to_dict(), view.space)).encode())
        for name in MAPS:
            if view.has(name):
                digest.update(name.encode())
                digest.update(view.read(name).tobytes())
    return digest.hexdigest()
