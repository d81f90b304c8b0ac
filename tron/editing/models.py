"""Models of meshes that are put into a scene: read, measured, and stood where they are to be."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field, model_validator

from tron.editing.selections import Part, Vector
from tron.errors import TronError
from tron.framing import find_subject, upright
from tron.termination import termination_noted

if TYPE_CHECKING:
    from tron.gaussians.scene import GaussianScene
    from tron.models.parts import Part as MeshPart

log = logging.getLogger(__name__)

MODELS = (".gltf", ".glb", ".obj")
"""Suffixes of meshes."""
SMALLEST, LARGEST = 1e-3, 100.0
"""Sizes of a model over the radius of what a scene is about, within which units are no mistake."""


def read_model(file: Path) -> list[MeshPart]:
    """Parts of a model, z up, in its own place and units.

    Raises:
        TronError: it cannot be read, or what reads it is not installed.
    """
    try:
        with termination_noted():  # trimesh takes an end amid its imports for a library that is missing
            from tron.models.load import load_model
    except ModuleNotFoundError as error:
        what = f"reading a model needs {error.name}"
        raise TronError(what, file, "pip install 'tron-relight[models]'") from error
    return load_model(file, fitted=False)


class PlacedModel(Part):
    """A model that stands in a scene as a mesh, upright; keys as of the edit ``insert``."""

    file: Path = Field(description="glTF or OBJ model")
    at: Vector = Field(
        description="point that it stands at, in the scene's units; or above it: it is lowered onto the "
        "surface, or the ground, straight below"
    )
    standing: bool = Field(True, description="whether it is lowered")
    turn: float = Field(0.0, description="degrees about up, counter-clockwise")
    scale: float = Field(1.0, gt=0, description="factor on its size")
    height: float | None = Field(None, gt=0, description="its height, in place of a scale")

    @model_validator(mode="after")
    def _has_one_size(self) -> PlacedModel:
        if self.height is not None and "scale" in self.model_fields_set:
            raise ValueError("scale and height both say its size: leave one of the two out")
        return self

    def stood(
        self,
        parts: Sequence[MeshPart],
        scene: GaussianScene,
        turn: np.ndarray | None = None,
        ground: float | None = None,
    ) -> list[MeshPart]:
        """Its parts where it stands, in the world of a scene.

        Args:
            parts: of :func:`read_model`.
            scene: the surfels.
            turn: (3, 3) that takes the world of ``at`` to the scene's; none by default.
            ground: height along the scene's up of a plane to stand on where no surfel lies below; None: there
                is none.

        Raises:
            TronError: nothing lies below, or its size and the scene's cannot be meant.
        """
        from scipy.spatial.transform import Rotation

        corners = np.concatenate([part.vertices for part in parts])
        low, high = corners.min(axis=0), corners.max(axis=0)
        scale = self.scale if self.height is None else self.height / max(high[2] - low[2], 1e-300)
        size = scale * (high - low)
        subject = find_subject(scene).radius
        if not SMALLEST <= size.max() / subject <= LARGEST:
            raise TronError(
                f"it would be {size.max():.3g} long in a scene of {2 * subject:.3g}",
                self.file,
                "say how high it is, such as height: 0.5, in the scene's units",
            )
        at = np.array(self.at, np.float64) if turn is None else turn @ np.array(self.at)
        matrix = np.eye(4)
        upward = upright(scene.up).T  # from z up
        matrix[:3, :3] = upward @ Rotation.from_euler("z", self.turn, degrees=True).as_matrix()
        foot = scale * foot_of(parts, np.array([0.0, 0.0, 1.0]))
        stands = self._stood(scene, at, ground)
        matrix[:3, 3] = stands - matrix[:3, :3] @ foot
        log.info(
            "%s stands at %s as a mesh, %.3g x %.3g x %.3g",
            self.file.name, np.round(stands if turn is None else turn.T @ stands, 4).tolist(), *size,
        )  # fmt: skip
        return [part.moved(matrix, scale) for part in parts]

    def _stood(self, scene: GaussianScene, at: np.ndarray, ground: float | None) -> np.ndarray:
        if not self.standing:
            return at
        from tron.editing.placement import surface_below
        from tron.editing.views import Views

        try:
            return surface_below(scene, Views(), at)
        except TronError as error:
            if ground is None:
                raise TronError(error.what, self.file, error.mend) from error
            return at + (ground - at @ scene.up) * scene.up


def foot_of(parts: Sequence[MeshPart], up: np.ndarray) -> np.ndarray:
    """(3,) the point that a model stands on: below the centre of its area, at its lowest along ``up``."""
    middle = _middle(parts)
    lowest = min(float((part.vertices @ up).min()) for part in parts)
    return middle + (lowest - middle @ up) * up


def _middle(parts: Sequence[MeshPart]) -> np.ndarray:
    """(3,) centre of the triangles' area."""
    from tron.models.surfels import areas

    sizes = [areas(part) for part in parts]
    middles = [part.vertices[part.faces].mean(axis=1) for part in parts]
    total = sum((size[:, None] * middle).sum(axis=0) for size, middle in zip(sizes, middles))
    return np.asarray(total) / sum(size.sum() for size in sizes)
