"""Motions as data: keyframes of things and of the light, and objects that fall.

:mod:`tron.editing.moving` has the scene as it stands at any time.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field, ValidationError, field_validator, model_validator
from scipy.interpolate import PchipInterpolator

from tron.editing.documents import in_one_line, read_yaml, with_paths
from tron.editing.selections import PARTS, Axis, ObjectId, Part, Selection, Vector
from tron.errors import TronError

_MEND = "write a mapping, such as: objects: [{select: {object: 3}, keys: [{time: 2, by: [1, 0, 0]}]}]"
Time = Annotated[float, Field(ge=0, le=86_400)]
Turn = Annotated[float, Field(ge=-1e6, le=1e6)]
Length = Annotated[float, Field(ge=-1e9, le=1e9)]
Way = tuple[Length, Length, Length]


class Key(Part):
    """Where a thing is at a time, from where the scene has it.

    Attributes:
        time: seconds from the first frame.
        by: shift, world units.
        turn: degrees about the path's axis, counter-clockwise; more than 360 are several turns.
    """

    time: Time
    by: Way = (0.0, 0.0, 0.0)
    turn: Turn = 0.0


class LightKey(Part):
    """The light at a time.

    Attributes:
        time: seconds from the first frame.
        rotation: turn about up, degrees, on that of the settings.
        stops: brightness, as powers of two.
        environment: map, from here on; None: that of the key before, at first the one of the settings. From
            a key to the next one the one's radiance fades into the other's.
    """

    time: Time
    rotation: Turn = 0.0
    stops: float = Field(default=0.0, ge=-24, le=24)
    environment: Path | None = None


def _in_order(keys: tuple[Key, ...] | tuple[LightKey, ...]) -> None:
    for before, after in pairwise(keys):
        if after.time < before.time + 1e-6:
            raise ValueError(f"keys are not in order: {after.time:g} s comes after {before.time:g} s")


class _Path(Part):
    """How one thing moves.

    Attributes:
        keys: in the order of their times.
        axis: of turns, world; up by default.
        about: what turns keep where it is; by default the point that the thing stands on.
    """

    keys: tuple[Key, ...] = Field(min_length=1)
    axis: Axis | None = None
    about: Vector | None = None

    @field_validator("keys")
    @classmethod
    def _are_in_order(cls, keys: tuple[Key, ...]) -> tuple[Key, ...]:
        _in_order(keys)
        return keys


class ObjectPath(_Path):
    """How one selection moves.

    Attributes:
        select: surfels; no other path may have any of them.
    """

    select: Selection


class MeshPath(_Path):
    """How one model that stands beside the surfels moves.

    Attributes:
        mesh: its number in the setting ``meshes``, from 1; no other path may have it.
    """

    mesh: int = Field(ge=1)


class Fall(Part):
    """Objects that fall, are pushed and collide as rigid bodies (:mod:`tron.editing.falling`).

    Attributes:
        objects: numbers of those that move; all else stands still, as they find it.
        push: velocity of some of them at the start, world units a second.
        gravity: world units a second squared, along -up; the default is of scenes in metres.
        friction: of all surfaces, a ratio.
        start: seconds from the first frame.
    """

    objects: tuple[ObjectId, ...] = Field(min_length=1)
    push: dict[ObjectId, Way] = Field(default={})
    gravity: float = Field(default=9.81, ge=0, le=1e9)
    friction: float = Field(default=0.8, ge=0, le=100)
    start: Time = 0.0

    @model_validator(mode="after")
    def _pushes_what_moves(self) -> Fall:
        if len(set(self.objects)) < len(self.objects):
            raise ValueError("an object is named twice")
        if others := sorted(set(self.push) - set(self.objects)):
            raise ValueError(f"object {others[0]} is pushed and not among the objects that move")
        return self


def between(times: np.ndarray, values: np.ndarray, seconds: float) -> np.ndarray:
    """(N,) of values (K, N) at times (K,): along a curve without overshoot (Fritsch and Butland 1984, PCHIP).

    Before the first time and after the last one they stand still.
    """
    if len(times) == 1 or seconds <= times[0]:
        return values[0]
    return PchipInterpolator(times, values)(seconds) if seconds < times[-1] else values[-1]


@dataclass(frozen=True)
class LightNow:
    """A light at one time.

    Attributes:
        rotation: degrees.
        factor: on its radiance.
        maps: files and their shares, which add up to 1; None is the map of the settings.
    """

    rotation: float = 0.0
    factor: float = 1.0
    maps: tuple[tuple[Path | None, float], ...] = ((None, 1.0),)


class Motion(Part):
    """All that moves in a film."""

    objects: tuple[ObjectPath, ...] = ()
    meshes: tuple[MeshPath, ...] = ()
    fall: Fall | None = None
    light: tuple[LightKey, ...] = ()

    @field_validator("light")
    @classmethod
    def _is_in_order(cls, keys: tuple[LightKey, ...]) -> tuple[LightKey, ...]:
        _in_order(keys)
        return keys

    @model_validator(mode="after")
    def _moves_something(self) -> Motion:
        if not self.objects and not self.meshes and not self.light and self.fall is None:
            raise ValueError("nothing moves: give objects, meshes, fall or light")
        return self

    @classmethod
    def read(cls, path: Path) -> Motion:
        """Motion of a YAML file; maps that it names are found from its folder.

        Raises:
            TronError: no such file, no YAML, or no motion; the first mistake is named with its key.
        """
        data = read_yaml(path, _MEND)
        if not isinstance(data, dict):
            raise TronError("no motion found", path, _MEND)
        known = {name for each in (cls, *_PARTS, *PARTS) for name in each.model_fields}
        try:
            return cls.model_validate(with_paths(data, lambda file: str(path.parent / file)))
        except ValidationError as error:
            raise in_one_line(error, str(path), known) from error

    @property
    def maps(self) -> tuple[Path, ...]:
        """Environment maps that keys name, each once."""
        return tuple(dict.fromkeys(key.environment for key in self.light if key.environment is not None))

    @property
    def end(self) -> float:
        """Seconds of the last key; a fall has none."""
        keys = [key for path in (*self.objects, *self.meshes) for key in path.keys]
        return max((key.time for key in (*keys, *self.light)), default=0.0)

    def light_at(self, seconds: float) -> LightNow:
        """The light at a time: turns and stops along curves, maps by linear shares of radiance."""
        if not self.light:
            return LightNow()
        times = np.array([key.time for key in self.light])
        values = np.array([[key.rotation, key.stops] for key in self.light])
        rotation, stops = between(times, values, seconds).tolist()
        maps: list[Path | None] = []
        for key in self.light:
            maps.append(key.environment or (maps[-1] if maps else None))
        place = float(np.interp(seconds, times, np.arange(len(times))))
        first = min(int(place), len(maps) - 1)
        after = min(first + 1, len(maps) - 1)
        share = place - first
        if maps[first] == maps[after] or share == 0:
            return LightNow(rotation, 2.0**stops, ((maps[first], 1.0),))
        return LightNow(rotation, 2.0**stops, ((maps[first], 1 - share), (maps[after], share)))


_PARTS = (Key, LightKey, ObjectPath, MeshPath, Fall)
