"""Edits as data: each selects surfels of a scene and does one thing to them.

An edit makes another scene, which shares what does not change, and appends what it adds, so that the numbers
of surfels stay until some are removed. What belongs to the whole scene, its spacing above all, stays as it
was: shadows of what nobody touched must not change by it.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from tron.editing.colors import hues, with_hue
from tron.editing.models import MODELS, read_model
from tron.editing.placement import fitted, foot, placed, surface_below
from tron.editing.selections import Axis, ObjectId, Part, Selection, Vector
from tron.editing.views import Views
from tron.errors import TronError
from tron.gaussians.edit import joined, removed
from tron.gaussians.scene import GaussianScene

log = logging.getLogger(__name__)

SURFELS = 20_000
"""Of an inserted mesh, at least, unless it says a spacing."""

Unit = Annotated[float, Field(ge=0, le=1)]
Color = tuple[Unit, Unit, Unit]
Factor = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class _Selecting(Part):
    """An edit of the surfels of a selection."""

    select: Selection

    def selected(self, scene: GaussianScene, views: Views) -> np.ndarray:
        """(M,) bool; TronError where that is nothing."""
        which = self.select.of(scene, views)
        if not which.any():
            raise TronError("no surfel is selected", mend="widen the selection")
        return which

    @property
    def objects(self) -> frozenset[int] | None:
        """Objects that the edit reads and changes; None where it does not name them."""
        return self.select.objects


class _Placing(Part):
    """How surfels are turned, scaled and shifted.

    Attributes:
        by: shift, world units.
        turn: degrees, counter-clockwise about ``axis`` (up by default).
        scale: factor on sizes and distances.
        about: what stays where it is under turn and scale; by default the point that they stand on.
    """

    by: Vector = (0.0, 0.0, 0.0)
    turn: float = 0.0
    axis: Axis | None = None
    scale: float = Field(default=1.0, gt=0)
    about: Vector | None = None

    def place(self, scene: GaussianScene, which: np.ndarray) -> GaussianScene:
        """The scene with the surfels (M,) bool where they go."""
        return placed(
            scene, which, by=np.array(self.by), turn_deg=self.turn, scale=self.scale,
            axis=None if self.axis is None else np.array(self.axis),
            about=None if self.about is None else np.array(self.about),
        )  # fmt: skip


class Remove(_Selecting):
    """Remove surfels from the scene."""

    action: Literal["remove"] = "remove"

    def apply(self, scene: GaussianScene, views: Views) -> GaussianScene:
        """The scene without them."""
        return removed(scene, self.selected(scene, views))


class Move(_Selecting, _Placing):
    """Turn, scale and shift surfels where they are."""

    action: Literal["move"] = "move"

    @model_validator(mode="after")
    def _moves(self) -> Move:
        if not any(self.by) and not self.turn % 360 and self.scale == 1:
            raise ValueError("say how it moves: by, turn or scale")
        return self

    def apply(self, scene: GaussianScene, views: Views) -> GaussianScene:
        """The scene with them elsewhere."""
        return self.place(scene, self.selected(scene, views))


class Duplicate(_Selecting, _Placing):
    """Put a copy of surfels elsewhere, as an object of its own: a number that is free where none is given."""

    action: Literal["duplicate"] = "duplicate"
    object: ObjectId | None = None

    def apply(self, scene: GaussianScene, views: Views) -> GaussianScene:
        """The scene with the copy at its end."""
        which, number = self.selected(scene, views), _free_object(scene, self.object)
        both = joined(scene, _named(removed(scene, ~which) if not which.all() else scene, number))
        return self.place(both, np.arange(len(both)) >= len(scene))

    @property
    def objects(self) -> frozenset[int] | None:
        """Those it copies, and the one it makes."""
        return _with(self.select.objects, self.object)


class Separate(_Selecting):
    """Make surfels an object of their own, which further edits, tron-relight's motion and the viewer name.

        {action: separate, select: {clicks: {view: 0, inside: [[120, 80]], outside: [[30, 200]]}}, object: 8}

    Surfels that were of other objects leave them; their places, materials and radiance stay.

    Attributes:
        object: the number that they get, one that no object has; a free one where none is given.
    """

    action: Literal["separate"] = "separate"
    object: ObjectId | None = None

    def apply(self, scene: GaussianScene, views: Views) -> GaussianScene:
        """The scene with them under another number; nothing that is seen changes."""
        which, number = self.selected(scene, views), _free_object(scene, self.object)
        return replace(scene, object_id=np.where(which, np.int32(number), scene.object_id))

    @property
    def objects(self) -> frozenset[int] | None:
        """Those it takes them from, and the one it makes."""
        return _with(self.select.objects, self.object)


class Insert(Part):
    """Put another scene's surfels, or those of a mesh, in, upright, as one object.

    Attributes:
        file: PLY of the other scene, or a glTF or OBJ model, which becomes surfels and keeps its units.
        spacing: of a model's surfels, world units; by default of 20,000 of them, or the scene's if finer.
        at: point that they stand at, world; or above it, where they stand on what lies straight below.
        standing: whether they are lowered onto the surface below ``at``.
        take: which of the other scene's surfels; all by default.
        turn: degrees about up, counter-clockwise.
        scale: factor on their size.
        object: number of the object that they become; a free one where none is given.
    """

    action: Literal["insert"] = "insert"
    file: Path
    spacing: float | None = Field(default=None, gt=0)
    at: Vector
    standing: bool = True
    take: Selection | None = None
    turn: float = 0.0
    scale: float = Field(default=1.0, gt=0)
    object: ObjectId | None = None

    def apply(self, scene: GaussianScene, views: Views) -> GaussianScene:
        """The scene with them at its end."""
        number = _free_object(scene, self.object)
        other = self._read(scene)
        if self.take is not None:
            taken = self.take.of(other)
            if not taken.any():
                raise TronError("nothing of it is taken", self.file, "widen the selection")
            other = other if taken.all() else removed(other, ~taken)
        at = surface_below(scene, views, np.array(self.at)) if self.standing else np.array(self.at)
        if other.projection != scene.projection:
            said = self.file, scene.projection, other.projection
            log.warning("%s: cameras see it projected as the scene is, %s, and not as %s", *said)
        both = joined(scene, _named(fitted(other, scene), number))
        new = np.arange(len(both)) >= len(scene)
        return placed(both, new, by=at - foot(both, new), turn_deg=self.turn, scale=self.scale)

    def _read(self, scene: GaussianScene) -> GaussianScene:
        if self.file.suffix.lower() not in MODELS:
            if self.spacing is not None:
                raise TronError(
                    "spacing is of meshes: surfels of a PLY have theirs", self.file, "leave it out"
                )
            return GaussianScene.load(self.file)
        parts = read_model(self.file)
        from tron.models.sides import spacing_of, two_sided  # after it has said what is missing
        from tron.models.surfels import MOST, surfels_of_model

        parts = two_sided(parts)
        of_many = spacing_of(parts, SURFELS)
        spacing = max(min(scene.spacing / self.scale, of_many), of_many * (SURFELS / MOST) ** 0.5 * 1.01)
        spacing = spacing if self.spacing is None else self.spacing / self.scale
        made = surfels_of_model(parts, spacing, kernel_degree=scene.kernel_degree)
        size = np.ptp(made.means, axis=0) * self.scale
        log.info("%s is %d surfels, %.3g x %.3g x %.3g", self.file.name, len(made), *size)
        return made

    @property
    def objects(self) -> frozenset[int] | None:
        """The one that it makes; None where it stands on others, or is not named."""
        return None if self.standing else _with(frozenset(), self.object)


class Scale(Part):
    """In place of a value: a factor on what is there; of a color, one for all channels or for each."""

    scale: Factor | tuple[Factor, Factor, Factor]


class ScaleOne(Part):
    """The same of a single channel."""

    scale: Factor


class Turned(Part):
    """In place of a hue: degrees on what is there."""

    turn: float


class Material(_Selecting):
    """Set the materials of surfels, or scale them; all but emission is kept within [0, 1].

    Attributes:
        base_color: linear RGB, or a scale.
        emission: linear radiance that they emit, of any size, or a scale.
        roughness, metallic: a value, or a scale.
        hue: degrees of the color wheel, or a turn; greys have none and stay.
    """

    action: Literal["material"] = "material"
    base_color: Color | Scale | None = None
    emission: tuple[Factor, Factor, Factor] | Scale | None = None
    roughness: Unit | ScaleOne | None = None
    metallic: Unit | ScaleOne | None = None
    hue: float | Turned | None = None

    @model_validator(mode="after")
    def _changes(self) -> Material:
        given = (self.base_color, self.emission, self.roughness, self.metallic, self.hue)
        if all(each is None for each in given):
            raise ValueError("say what changes: base_color, emission, roughness, metallic or hue")
        return self

    def apply(self, scene: GaussianScene, views: Views) -> GaussianScene:
        """The scene with their materials changed; nothing moves."""
        which, changed = self.selected(scene, views), {}
        for name in ("base_color", "emission", "roughness", "metallic"):
            change = getattr(self, name)
            if change is not None:
                values, most = getattr(scene, name).copy(), np.inf if name == "emission" else 1
                scales = isinstance(change, Scale | ScaleOne)
                values[which] = np.clip(values[which] * change.scale, 0, most) if scales else change
                changed[name] = values
        if self.hue is not None:
            values = changed.get("base_color", scene.base_color).copy()
            angle, _ = hues(values[which])
            wanted = angle + self.hue.turn if isinstance(self.hue, Turned) else self.hue
            values[which] = with_hue(values[which], wanted)
            changed["base_color"] = values
        return replace(scene, **changed)


Edit = Annotated[Remove | Move | Duplicate | Separate | Insert | Material, Field(discriminator="action")]
ACTIONS = (Remove, Move, Duplicate, Separate, Insert, Material)


def _free_object(scene: GaussianScene, wanted: int | None) -> int:
    """A number for a new object; TronError where the wanted one is another's."""
    if wanted is None:
        return max(int(scene.object_id.max()) + 1, 1)
    if (scene.object_id == wanted).any():
        raise TronError(f"there is an object {wanted} already", mend="give a number that is free")
    return wanted


def _named(scene: GaussianScene, number: int) -> GaussianScene:
    return replace(scene, object_id=np.full(len(scene), number, np.int32))


def _with(objects: frozenset[int] | None, new: int | None) -> frozenset[int] | None:
    return None if objects is None or new is None else objects | {new}
