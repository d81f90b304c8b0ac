"""Selections as data: which surfels of a scene an edit is about.

All that a selection says holds together: ``{object: 3, material: {metallic: [0.5, 1]}}`` is the metal of
object 3. ``any`` joins selections, ``but_not`` takes one away.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, field_validator, model_validator

from tron.color import luminance
from tron.errors import TronError

if TYPE_CHECKING:
    from tron.editing.views import Views
    from tron.gaussians.scene import GaussianScene

Vector = tuple[float, float, float]


def _with_a_length(axis: Vector) -> Vector:
    if not any(axis):
        raise ValueError("an axis has a length: give three numbers that are not all 0")
    return axis


Axis = Annotated[Vector, AfterValidator(_with_a_length)]
"""Direction of any length but 0, world."""
Range = tuple[float, float]
ObjectId = Annotated[int, Field(ge=0, lt=2**31)]
Picked = Annotated[int, Field(ge=0)] | tuple[float, float]
"""Number of a surfel, or a pixel (x, y) from the upper left corner of a view."""


class Part(BaseModel):
    """What all data of an edit share: no unknown key, no NaN, no change."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Box(Part):
    """Surfels whose centres lie in an axis-aligned box, world; its faces belong to it."""

    low: Vector
    high: Vector

    @model_validator(mode="after")
    def _is_upright(self) -> Box:
        for axis, low, high in zip("xyz", self.low, self.high):
            if low > high:
                raise ValueError(f"the box is inverted: {axis} goes from {low:g} to {high:g}")
        return self

    def of(self, scene: GaussianScene) -> np.ndarray:
        """(M,) bool."""
        return np.all((scene.means >= self.low) & (scene.means <= self.high), axis=1)


class Sphere(Part):
    """Surfels whose centres lie in a sphere, world; its surface belongs to it."""

    center: Vector
    radius: float = Field(gt=0)

    def of(self, scene: GaussianScene) -> np.ndarray:
        """(M,) bool."""
        return np.linalg.norm(scene.means.astype(np.float64) - self.center, axis=1) <= self.radius


class MaterialRange(Part):
    """Surfels whose channels lie in ranges, ends included; a hue, degrees, may go through 360: [340, 20].

    ``luminance`` is that of the linear base color; ``hue`` that of its display values.
    """

    roughness: Range | None = None
    metallic: Range | None = None
    luminance: Range | None = None
    hue: Range | None = None

    @field_validator("roughness", "metallic", "luminance")
    @classmethod
    def _is_upright(cls, ends: Range | None) -> Range | None:
        if ends is not None and ends[0] > ends[1]:
            raise ValueError(f"the range is inverted: from {ends[0]:g} to {ends[1]:g}")
        return ends

    @model_validator(mode="after")
    def _names_a_channel(self) -> MaterialRange:
        return _require_one(self)

    def of(self, scene: GaussianScene) -> np.ndarray:
        """(M,) bool."""
        from tron.editing.colors import hues

        within = np.ones(len(scene), bool)
        channels = {
            "roughness": scene.roughness,
            "metallic": scene.metallic,
            "luminance": luminance(scene.base_color),
        }
        for name, values in channels.items():
            if (ends := getattr(self, name)) is not None:
                within &= (values >= ends[0]) & (values <= ends[1])
        if self.hue is not None:
            low, high = (end % 360 for end in self.hue)
            angle, colored = hues(scene.base_color)
            between = (angle >= low) & (angle <= high) if low <= high else (angle >= low) | (angle <= high)
            within &= colored & between
        return within


class Grown(Part):
    """Surfels that hang together with picked ones: neighbours whose normals and colours are alike."""

    at: tuple[Picked, ...] = Field(min_length=1)
    view: str | int | None = None
    angle: float = Field(default=40.0, gt=0, le=180)
    """Most degrees between the normals of two neighbours."""
    color: float = Field(default=2.0, gt=0)
    """Most distance between their colours, as cube roots of base color; the default joins all colours."""

    @model_validator(mode="after")
    def _can_be_picked(self) -> Grown:
        _require_view(self.view, self.at)
        return self

    def of(self, scene: GaussianScene, views: Views) -> np.ndarray:
        """(M,) bool."""
        from tron.editing.regions import grown

        return grown(scene, _surfels(scene, views, self.view, self.at), self.angle, self.color)


class Clicks(Part):
    """Surfels that are nearer to clicks inside than to those outside, along the surface."""

    inside: tuple[Picked, ...] = ()
    outside: tuple[Picked, ...] = ()
    view: str | int | None = None

    @model_validator(mode="after")
    def _can_be_picked(self) -> Clicks:
        _require_view(self.view, (*self.inside, *self.outside))
        return self


class Selection(Part):
    """Surfels of which all that is given holds.

    Attributes:
        object: their object id, or one of several.
        box, sphere, material, grow: see the classes.
        clicks: inside and outside, in one view or in several: of all together.
        masks: image of each view, by the view's name or number, white where it is selected.
        any: selections of which one holds.
        but_not: selection that does not hold.
    """

    object: ObjectId | tuple[ObjectId, ...] | None = None
    box: Box | None = None
    sphere: Sphere | None = None
    material: MaterialRange | None = None
    grow: Grown | None = None
    clicks: Clicks | tuple[Clicks, ...] | None = None
    masks: dict[str, Path] | None = None
    any: tuple[Selection, ...] | None = Field(default=None, min_length=1)
    but_not: Selection | None = None

    @field_validator("object")
    @classmethod
    def _names_each_once(cls, named: int | tuple[int, ...] | None) -> int | tuple[int, ...] | None:
        ids = named if isinstance(named, tuple) else ()
        twice = sorted({each for each in ids if ids.count(each) > 1})
        if twice:
            raise ValueError(f"object {twice[0]} is named twice")
        return named

    @field_validator("masks", mode="before")
    @classmethod
    def _views_are_texts(cls, masks: Any) -> Any:
        """YAML reads 3: as a number."""
        return {str(view): path for view, path in masks.items()} if isinstance(masks, dict) else masks

    @field_validator("clicks")
    @classmethod
    def _are_of_both_kinds(cls, clicks: Clicks | tuple[Clicks, ...] | None) -> Any:
        every = clicks if isinstance(clicks, tuple) else () if clicks is None else (clicks,)
        if clicks is not None and not (any(c.inside for c in every) and any(c.outside for c in every)):
            raise ValueError("clicks are inside and outside, one of each at least; grow needs inside alone")
        return clicks

    @model_validator(mode="after")
    def _selects(self) -> Selection:
        return _require_one(self)

    @property
    def objects(self) -> frozenset[int] | None:
        """Ids of the objects that all selected surfels belong to; None where nothing says so."""
        if self.object is not None:
            return frozenset(self.object if isinstance(self.object, tuple) else (self.object,))
        if self.any is None:
            return None
        each = [one.objects for one in self.any]
        return None if None in each else frozenset().union(*(ids for ids in each if ids is not None))

    @property
    def asks_views(self) -> bool:
        """Whether it names pixels, clicks, masks, or surfels by number."""
        parts = [*(self.any or ()), *([self.but_not] if self.but_not else [])]
        own = (self.grow, self.clicks, self.masks)
        return any(each is not None for each in own) or any(each.asks_views for each in parts)

    def of(self, scene: GaussianScene, views: Views | None = None) -> np.ndarray:
        """(M,) bool; ``views`` where pixels or masks are named.

        Raises:
            TronError: an object that the scene does not have, a view or a pixel that is not there. That
                nothing is selected is no error here.
        """
        from tron.editing.views import Views

        views = Views() if views is None else views
        selected = np.ones(len(scene), bool)
        if self.object is not None:
            selected &= _of_objects(scene, sorted(self.objects or ()))
        for part in (self.box, self.sphere, self.material):
            if part is not None:
                selected &= part.of(scene)
        if self.grow is not None:
            selected &= self.grow.of(scene, views)
        if self.clicks is not None:
            selected &= _parted(scene, views, self.clicks)
        if self.masks is not None:
            selected &= views.lifted(scene, self.masks)
        if self.any is not None:
            selected &= np.any([one.of(scene, views) for one in self.any], axis=0)
        if self.but_not is not None:
            selected &= ~self.but_not.of(scene, views)
        return selected


PARTS = (Selection, Box, Sphere, MaterialRange, Grown, Clicks)


def _of_objects(scene: GaussianScene, ids: list[int]) -> np.ndarray:
    there = np.unique(scene.object_id)
    unknown = sorted(set(ids) - set(there.tolist()))
    if unknown:
        known = ", ".join(map(str, there[:20])) + (", ..." if len(there) > 20 else "")
        raise TronError(f"there is no object {unknown[0]}", mend=f"objects of the scene are {known}")
    return np.isin(scene.object_id, ids)


def _parted(scene: GaussianScene, views: Views, clicks: Clicks | tuple[Clicks, ...]) -> np.ndarray:
    every = clicks if isinstance(clicks, tuple) else (clicks,)
    inside, outside = (
        np.concatenate([_surfels(scene, views, each.view, getattr(each, side)) for each in every])
        for side in ("inside", "outside")
    )
    from tron.editing.regions import parted

    return parted(scene, inside, outside)


def _surfels(
    scene: GaussianScene, views: Views, view: str | int | None, picks: tuple[Picked, ...]
) -> np.ndarray:
    """Numbers of the picked surfels."""
    found = [np.empty(0, int)]
    for pick in picks:
        if isinstance(pick, int):
            if pick >= len(scene):
                raise TronError(f"there is no surfel {pick}", mend=f"surfels are 0..{len(scene) - 1}")
            found.append(np.array([pick]))
        else:
            assert view is not None
            found.append(views.picked(scene, view, pick))
    return np.concatenate(found)


def _require_view(view: str | int | None, picks: tuple[Picked, ...]) -> None:
    if view is None and not all(isinstance(pick, int) for pick in picks):
        raise ValueError("a pixel is one of a view: give view too, its name or number in cameras.json")


def _require_one(part: Any) -> Any:
    if all(getattr(part, name) is None for name in type(part).model_fields):
        raise ValueError(f"say what is selected: one of {', '.join(type(part).model_fields)}")
    return part
