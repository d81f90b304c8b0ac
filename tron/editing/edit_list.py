"""Lists of edits: stored as YAML, replayed, undone one by one, merged.

session = Session(GaussianScene.load("scene.ply"))
session.do(Move(select=Selection(object=3), by=(0.5, 0, 0)))
session.undo()
session.edits.write("edits.yaml")
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from pydantic import TypeAdapter, ValidationError

from tron.editing.documents import in_one_line, read_yaml, with_paths
from tron.editing.edits import ACTIONS, Edit, Insert
from tron.editing.selections import PARTS
from tron.editing.views import Views
from tron.errors import TronError, located
from tron.gaussians.scene import GaussianScene
from tron.storage import write_atomic

_EDIT: TypeAdapter[Edit] = TypeAdapter(Edit)
_MEND = "write a list, such as: [{action: remove, select: {object: 3}}]"
_ACTIONS = [each.model_fields["action"].default for each in ACTIONS]
_KEYS = {name for each in (*ACTIONS, *PARTS) for name in each.model_fields}
_SHOWN = 60


@dataclass(frozen=True)
class EditList:
    """Edits, to be applied one after the other."""

    edits: tuple[Edit, ...] = ()

    def __len__(self) -> int:
        return len(self.edits)

    def __iter__(self) -> Iterator[Edit]:
        return iter(self.edits)

    @classmethod
    def of(cls, data: Any, folder: Path = Path(), where: str = "edits") -> EditList:
        """Edits of plain values, as YAML has them; files that they name lie in ``folder``.

        Raises:
            TronError: what is no list of edits; the first mistake is named with its place.
        """
        if not isinstance(data, list) or not data:
            raise TronError("no edits found", where, _MEND)
        return cls(tuple(_checked(each, f"{where}, edit {n}", folder) for n, each in enumerate(data, 1)))

    @classmethod
    def read(cls, path: Path) -> EditList:
        """Edits of a YAML file; files that they name are found from its folder.

        Raises:
            TronError: no such file, no YAML, or as :meth:`of`.
        """
        return cls.of(read_yaml(path, _MEND), path.parent, str(path))

    def write(self, path: Path) -> None:
        """Write YAML, whole or not at all; files are named from its folder."""
        plain = [with_paths(_plain(each), lambda file: os.path.relpath(file, path.parent)) for each in self]
        write_atomic(path, yaml.safe_dump(plain, sort_keys=False, default_flow_style=None, width=110))

    def apply(
        self, scene: GaussianScene, views: Views | None = None, where: str = "edits",
        track: Callable[[Iterable[Edit]], Iterable[Edit]] = iter,
    ) -> GaussianScene:  # fmt: skip
        """The scene after all of them.

        Args:
            scene: valid.
            views: cameras that edits may name.
            where: what messages call the list.
            track: wraps the loop over the edits.

        Raises:
            TronError: an edit selects nothing or cannot be done; it is named by its place.
        """
        views = views or Views()
        for n, edit in enumerate(track(self.edits), 1):
            with located(f"{where}, edit {n}: {edit.action}"):
                scene = edit.apply(scene, views).validate()
        return scene

    def merged(self, other: EditList) -> EditList:
        """Both lists' edits, of two people who edited one scene; the same whichever is asked.

        All edits have to name their objects, and no object is in both: then none sees what another does.

        Raises:
            TronError: an object is in both lists, or an edit does not name its objects.
        """
        mine, theirs = (each._objects() for each in (self, other))
        if both := sorted(mine & theirs):
            raise TronError(
                f"object {both[0]} is named by both lists of edits", mend="apply one after the other"
            )
        first, second = sorted((self, other), key=lambda each: min(each._objects(), default=-1))
        return EditList((*first.edits, *second.edits))

    def _objects(self) -> frozenset[int]:
        named: set[int] = set()
        for edit in self:
            if edit.objects is None:
                asked = "give it standing: false and an object" if isinstance(edit, Insert) else (
                    "select by object, and give what is new an object"
                )  # fmt: skip
                what = f"an edit ({edit.action}) does not say which objects it is about"
                raise TronError(f"{what}, so lists cannot be merged", mend=asked)
            named |= edit.objects
        return frozenset(named)


@dataclass
class Session:
    """A scene under edit: what was done can be undone, one edit at a time.

    Attributes:
        scene: as it is after all edits; shares with earlier ones what no edit changed.
        views: cameras that edits may name.
    """

    scene: GaussianScene
    views: Views = field(default_factory=Views)
    _before: list[GaussianScene] = field(default_factory=list, init=False, repr=False)
    _edits: list[Edit] = field(default_factory=list, init=False, repr=False)

    @property
    def edits(self) -> EditList:
        """What was done and not undone."""
        return EditList(tuple(self._edits))

    def do(self, edit: Edit) -> GaussianScene:
        """The scene after one more edit; nothing changes if it raises TronError."""
        after = EditList((edit,)).apply(self.scene, self.views)
        self._before.append(self.scene)
        self._edits.append(edit)
        self.scene = after
        return after

    def undo(self) -> Edit:
        """Take the last edit back, and return it; TronError where there is none."""
        if not self._edits:
            raise TronError("there is nothing to undo")
        self.scene = self._before.pop()
        return self._edits.pop()

    def without(self, place: int) -> Session:
        """A session in which the edit at a place, from 0, was never done: those behind it are done anew.

        Raises:
            TronError: no such edit, or one behind it cannot be done without it.
        """
        if not 0 <= place < len(self._edits):
            raise TronError(f"there is no edit {place}", mend=f"there are {len(self._edits)}, from 0")
        other = Session(self._before[place], self.views)
        other._before, other._edits = self._before[:place], self._edits[:place]
        for edit in self._edits[place + 1 :]:
            other.do(edit)
        return other


def _checked(data: Any, where: str, folder: Path) -> Edit:
    if not isinstance(data, dict):
        raise TronError(f"an edit is a mapping, not {str(data)[:_SHOWN]!r}", where, _MEND)
    try:
        return _EDIT.validate_python(with_paths(data, lambda file: str(folder / file)))
    except ValidationError as error:
        raise _said(error, where) from error


def _said(error: ValidationError, where: str) -> TronError:
    kind, given = error.errors()[0]["type"], error.errors()[0].get("ctx", {})
    if kind == "union_tag_not_found":
        return TronError("the edit has no action", where, f"give one of {', '.join(_ACTIONS)}")
    if kind == "union_tag_invalid":
        return TronError(f"unknown action {given.get('tag')!r}", where, f"give one of {', '.join(_ACTIONS)}")
    return in_one_line(error, where, _KEYS, below=1)  # the action


def _plain(edit: Edit) -> dict[str, Any]:
    """Plain values of an edit, its action and its selection first, without what was not given."""
    given = {"action": edit.action} | edit.model_dump(mode="json", exclude_unset=True)
    return {name: given[name] for name in ("action", *(["select"] if "select" in given else ()))} | given
