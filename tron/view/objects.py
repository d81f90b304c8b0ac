"""The panel of the chosen object: its name, material, visibility and place.

Its controls show the scene after the wish's edits and are absent while no object is chosen, because viser's
sliders accept typed values even when disabled. A box around the object marks it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import viser
from scipy.spatial.transform import Rotation

from tron.color import linear_to_srgb, srgb_to_linear
from tron.editing import Edit, Material, Move, Remove, Selection
from tron.view.stage import Stage, Wish

NOBODY = "click one, or choose"
STRAYS = 0.005
"""Share of an object's surfels beyond either side of its box."""
LINE = 2.0
"""Width of the box's edges, pixels."""


class Do(Protocol):
    """:meth:`tron.view.history.History.do`."""

    def __call__(self, edit: Edit, hand: str = "", within: float = ...) -> None: ...


@dataclass(frozen=True)
class _State:
    """An object after the edits of the wish: means of its materials, places in the upright frame."""

    color: np.ndarray
    roughness: float
    metallic: float
    centre: np.ndarray
    low: np.ndarray
    high: np.ndarray
    turn: np.ndarray


class Objects:
    """The objects of the scene, and the controls of the chosen one.

    Args:
        server: that shows them.
        color: of the box.
        wished: gives the wish of the moment.
        change: changes the wish by the one before.
        ask: the studio's answer to a question; None where there is none.
        do: does one more edit, or another in place of the last by the same hand.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        color: tuple[int, int, int],
        wished: Callable[[], Wish],
        change: Callable[[Callable[[Wish], Wish]], Wish],
        ask: Callable[[Callable[[Stage], Any]], Any],
        do: Do,
    ) -> None:
        self._scene, self._color = server.scene, color
        self._wished, self._change, self._ask, self._do = wished, change, ask, do
        self.numbers: dict[str, int] = {}
        """Of the objects, by their label."""
        self.chosen: int | None = None
        self._gizmo: viser.TransformControlsHandle | None = None
        self._box: Any = None
        self._drags = itertools.count()
        gui = server.gui
        with gui.add_folder("Object"):
            self._object: Any = gui.add_dropdown("Object", [NOBODY], initial_value=NOBODY)
            self._visible = gui.add_checkbox(
                "Visible", True, hint="what is hidden stays in saved scenes, not in films"
            )
            self._paint = gui.add_rgb("Color", (128, 128, 128))
            self._roughness = gui.add_slider("Roughness", min=0.0, max=1.0, step=0.01, initial_value=0.5)
            self._metallic = gui.add_slider("Metallic", min=0.0, max=1.0, step=0.01, initial_value=0.0)
            self._arrows = gui.add_checkbox("Move", False, hint="arrows and rings move the object")
            self._remove = gui.add_button("Remove object", icon=viser.Icon.TRASH, color="gray")
        self._of_one: tuple[Any, ...] = (
            self._visible, self._paint, self._roughness, self._metallic, self._arrows, self._remove,
        )  # fmt: skip
        self._object.on_update(_of_user(lambda: self._choose(self.numbers.get(self._object.value))))
        self._visible.on_update(_of_user(self._hide))
        self._paint.on_update(_of_user(lambda: self.paint(base_color=self._picked())))
        self._roughness.on_update(_of_user(lambda: self.paint(roughness=float(self._roughness.value))))
        self._metallic.on_update(_of_user(lambda: self.paint(metallic=float(self._metallic.value))))
        self._arrows.on_update(_of_user(self.follow))
        self._remove.on_click(lambda _: self._edit(lambda of: Remove(select=of)))
        self._reveal()

    def take(self, number: int) -> None:
        """Choose an object by its number, where there is one."""
        label = next((name for name, each in self.numbers.items() if each == number), None)
        if label is not None:
            self._object.value = label
            self._choose(number)

    def paint(self, **material: Any) -> None:
        """Give the chosen object a value of :class:`tron.editing.Material`."""
        (name,) = material
        self._edit(lambda of: Material(select=of, **material), f"{name} of {self.chosen}")

    def follow(self) -> None:
        """Let list, controls, box and arrows be those of the scene after the edits of the wish."""
        chosen = self.chosen
        found = self._ask(lambda stage: (stage.objects(), _state(stage, chosen)))
        if found is None:
            return
        counts, state = found
        self._list(counts)
        if chosen != self.chosen and self.chosen is not None:  # chosen meanwhile: that follows by itself
            return
        if state is not None:
            shown = 255 * np.clip(np.asarray(linear_to_srgb(state.color)), 0, 1) + 0.5
            self._paint.value = tuple(int(value) for value in shown)  # pyright: ignore
            self._roughness.value, self._metallic.value = round(state.roughness, 2), round(state.metallic, 2)
            self._visible.value = chosen not in self._wished().hidden
        self._mark(state)
        self._place(state)

    def _list(self, counts: dict[int, int]) -> None:
        hidden = dict.fromkeys(self._wished().hidden, " · hidden")
        labels = {f"{n} · {count:,} surfels{hidden.get(n, '')}": n for n, count in counts.items()}
        if labels == self.numbers:
            return
        self.numbers = labels
        self._object.options = (NOBODY, *labels)
        kept = next((name for name, each in labels.items() if each == self.chosen), NOBODY)
        self._object.value, self.chosen = kept, labels.get(kept)
        self._reveal()

    def _choose(self, number: int | None) -> None:
        self.chosen = number
        self._reveal()
        self.follow()

    def _reveal(self) -> None:
        for control in self._of_one:
            control.visible = self.chosen is not None

    def _edit(self, made: Callable[[Selection], Edit], hand: str = "", within: float | None = None) -> None:
        if self.chosen is not None:
            edit = made(Selection(object=self.chosen))
            self._do(edit, hand) if within is None else self._do(edit, hand, within)

    def _picked(self) -> tuple[float, ...]:
        linear = srgb_to_linear(np.array(self._paint.value) / 255)
        return tuple(float(value) for value in np.clip(linear, 0, 1))

    def _hide(self) -> None:
        if (chosen := self.chosen) is not None:
            show = self._visible.value
            self._change(
                lambda wish: replace(wish, hidden=wish.hidden - {chosen} if show else wish.hidden | {chosen})
            )
            self.follow()

    def _mark(self, state: _State | None) -> None:
        """Draw the box over the picture, without depth test."""
        if self._box is not None:
            self._box.remove()
            self._box = None
        if state is None:
            return
        corners = np.array(list(itertools.product(*zip(state.low, state.high, strict=True))))
        pairs = [(a, b) for a, b in itertools.combinations(range(8), 2) if (a ^ b).bit_count() == 1]
        self._box = self._scene.add_line_segments(
            "/chosen", points=corners[np.array(pairs)], colors=self._color,
            thickness=LINE, thickness_units="screen",
        )  # fmt: skip

    def _place(self, state: _State | None) -> None:
        """The gizmo at the middle of the object, where it is wanted."""
        if self._gizmo is not None:
            self._gizmo.remove()
            self._gizmo = None
        if state is None or not self._arrows.value:
            return
        turn, place = state.turn, state.turn.T @ state.centre
        gizmo = self._scene.add_transform_controls(
            "/move", scale=max(0.35 * float((state.high - state.low).max()), 1e-6), depth_test=False,
            disable_sliders=True, position=tuple(state.centre), line_width=3.0,
        )  # fmt: skip
        drag = f"move {self.chosen} {next(self._drags)}"

        def moved(event: Any) -> None:
            by = turn.T @ (np.array(gizmo.position) - state.centre)
            vector = turn.T @ Rotation.from_quat(np.roll(gizmo.wxyz, -1)).as_rotvec()
            angle = float(np.degrees(np.linalg.norm(vector)))
            if np.any(by) or angle:
                words: dict[str, Any] = {"by": tuple(map(float, by)), "about": tuple(map(float, place))}
                if angle > 1e-3:
                    words |= {"turn": angle, "axis": tuple(map(float, vector))}
                self._edit(lambda of: Move(select=of, **words), drag, math.inf)
                if getattr(event, "phase", None) == "end":  # the next drag counts from where it stands now
                    self._place(None)
                    self.follow()

        gizmo.on_update(moved)
        self._gizmo = gizmo


def _of_user(act: Callable[[], Any]) -> Callable[[Any], Any]:
    """A callback that ignores values set by the server itself, which come without a client."""
    return lambda event: act() if event.client is not None else None


def _state(stage: Stage, number: int | None) -> _State | None:
    scene = stage.session.scene
    which = np.zeros(len(scene), bool) if number is None else scene.object_id == number
    if not which.any():
        return None
    points = scene.means[which].astype(np.float64) @ stage.turn.T
    low, high = np.quantile(points, (STRAYS, 1 - STRAYS), axis=0)
    return _State(
        color=scene.base_color[which].mean(0),
        roughness=float(scene.roughness[which].mean()),
        metallic=float(scene.metallic[which].mean()),
        centre=points.mean(0),
        low=low - scene.spacing,
        high=high + scene.spacing,
        turn=stage.turn,
    )
