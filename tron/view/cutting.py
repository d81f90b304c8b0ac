"""The panel that cuts an object out of a scan: clicks inside and outside it, what they select, an id for it.

Clicks are surfels by number, of the scene after all edits: any edit makes them void.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import viser

from tron.editing import Clicks, Edit, Selection, Separate
from tron.view.stage import Hit, Stage, Wish

COLORS = {True: (70, 220, 110), False: (235, 70, 70)}
"""Of the dots of clicks inside and outside."""
DOT = 0.012
"""Radius of a dot, of the subject's."""
HINT = "Click what belongs to it; shift and click what does not."


class Cutting:
    """Clicks, and the buttons about them.

    Args:
        server: that shows them.
        size: radius of the subject, world units.
        change: changes the wish by the one before.
        ask: the studio's answer to a question; None where there is none.
        edit: does one more edit.
        take: chooses the object of a number.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        size: float,
        change: Callable[[Callable[[Wish], Wish]], Wish],
        ask: Callable[[Callable[[Stage], Any]], Any],
        edit: Callable[[Edit], None],
        take: Callable[[int], None],
    ) -> None:
        self._scene, self._radius = server.scene, DOT * size
        self._change, self._ask, self._edit, self._take = change, ask, edit, take
        self._clicks: list[tuple[bool, tuple[int, ...], Any]] = []  # with the dot of each
        self._made = 0
        gui = server.gui
        with gui.add_folder("Cut out", expand_by_default=False):
            self._on = gui.add_checkbox("Select by clicks", False, hint=HINT)
            self._side = gui.add_dropdown("A click is", ("inside", "outside"), initial_value="inside")
            self._words = gui.add_markdown(HINT)
            gui.add_button("Make it an object").on_click(lambda _: self._separate())
            steps = gui.add_button_group("Clicks", ("Take back", "Clear"))
        self._on.on_update(lambda _: self._want())
        steps.on_click(lambda event: self.clear() if event.target.value == "Clear" else self._take_back())

    @property
    def active(self) -> bool:
        """Whether clicks on the picture are for this panel."""
        return bool(self._on.value)

    @property
    def marked(self) -> Clicks | None:
        """Surfels that were clicked, as the wish has them."""
        if not self._clicks or not self.active:
            return None
        inside, outside = (
            tuple(dict.fromkeys(n for kind, numbers, _ in self._clicks if kind is side for n in numbers))
            for side in (True, False)
        )
        return Clicks(inside=inside, outside=outside)

    def click(self, hit: Hit, place: np.ndarray, shift: bool) -> None:
        """One more click: ``place`` (3,) with +z up; with shift it is of the other kind."""
        inside = (self._side.value == "inside") is not shift
        if any(kind is not inside and set(numbers) & set(hit.surfels) for kind, numbers, _ in self._clicks):
            self._words.content = f"That is {'outside' if inside else 'inside'} already."
            return
        self._made += 1
        dot = self._scene.add_icosphere(
            f"/clicks/{self._made}", radius=self._radius, color=COLORS[inside], position=tuple(place)
        )
        self._clicks.append((inside, hit.surfels, dot))
        self._want()

    def clear(self) -> None:
        """Forget all clicks."""
        while self._clicks:
            self._clicks.pop()[2].remove()
        self._want()

    def follow(self, marked: Clicks | None) -> None:
        """Drop the last clicks, down to those that a wish still has; called by the studio's own thread."""
        while self._clicks and self.marked != marked:
            self._clicks.pop()[2].remove()
        self._say(counted=False)

    def _take_back(self) -> None:
        if self._clicks:
            self._clicks.pop()[2].remove()
        self._want()

    def _want(self) -> None:
        marked = self.marked
        self._change(lambda wish: replace(wish, marked=marked))
        self._say()

    def _say(self, counted: bool = True) -> None:
        """What the clicks are, and how many surfels they select: a question that the studio has to answer."""
        marked = self.marked
        if marked is None:
            self._words.content = HINT
            return
        kinds = [kind for kind, *_ in self._clicks]
        said = f"{sum(kinds)} inside, {len(kinds) - sum(kinds)} outside"
        if not (marked.inside and marked.outside):
            self._words.content = f"{said}; one of each at least"
            return
        if not counted:
            self._words.content = said
            return
        found = self._ask(lambda stage: int(stage.selected(marked).sum()))
        if found is not None and self.marked == marked:
            self._words.content = f"{said}: **{found:,} surfels**"

    def _separate(self) -> None:
        marked = self.marked
        if marked is None or not (marked.inside and marked.outside):
            self._words.content = HINT
            return
        number = self._ask(lambda stage: max(int(stage.session.scene.object_id.max()) + 1, 1))
        if number is not None:
            self._on.value = False
            self._edit(Separate(select=Selection(clicks=marked), object=number))
            self._take(number)
