"""The panel of edits: those that were done, undo and redo."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace

import viser

from tron.editing import Edit, Insert, Separate
from tron.view.stage import Wish

HAND_SECONDS = 2.0
"""Longest pause between changes that count as one edit: a dragged slider sends 20 a second."""
LISTED = 4


class History:
    """The edits of the wish, and what was undone.

    Args:
        server: that shows them.
        wished: gives the wish of the moment.
        change: changes the wish by the one before.
        changed: called when edits are others than before, unless a hand is still at it.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        wished: Callable[[], Wish],
        change: Callable[[Callable[[Wish], Wish]], Wish],
        changed: Callable[[], None],
    ) -> None:
        self._wished, self._change, self._changed = wished, change, changed
        self._undone: list[Edit] = []
        self._hand, self._moved = "", 0.0
        self._one = threading.Lock()  # events of one slider come on several threads
        gui = server.gui
        with gui.add_folder("Edits"):
            self._list = gui.add_markdown("*none*")
            steps = gui.add_button_group("Step", ("Undo", "Redo"))
        steps.on_click(lambda event: (self.undo if event.target.value == "Undo" else self.redo)())

    def do(self, edit: Edit, hand: str = "", within: float = HAND_SECONDS) -> None:
        """Do one more edit; or in place of the last one, where the same hand goes on.

        Args:
            edit: of the scene after those before it.
            hand: what is dragged, such as a slider of an object; empty: nothing.
            within: seconds after which the same hand does another edit.
        """
        with self._one:
            now = time.monotonic()
            goes_on = bool(hand) and hand == self._hand and now - self._moved < within
            self._hand, self._moved = hand, now
            self._undone.clear()
            self._set(lambda edits: (*(edits[:-1] if goes_on else edits), edit))
        if not hand:
            self._changed()

    def undo(self) -> None:
        """Undo the last edit."""

        if not self._wished().edits:
            self._list.content = "*no edit to undo; light and view are none*"
            return

        def without(edits: tuple[Edit, ...]) -> tuple[Edit, ...]:
            self._undone.extend(edits[-1:])
            return edits[:-1]

        with self._one:
            self._hand = ""
            self._set(without)
        self._changed()

    def redo(self) -> None:
        """Redo the edit undone last."""
        if self._undone:
            with self._one:
                edit, self._hand = self._undone.pop(), ""
                self._set(lambda edits: (*edits, edit))
            self._changed()

    def list(self) -> None:
        """Show the last edits of the wish."""
        shown = [f"{n}. {_said(each)}" for n, each in enumerate(self._wished().edits, 1)]
        more = ["…"] if len(shown) > LISTED else []
        self._list.content = "\n\n".join([*more, *shown[-LISTED:]]) if shown else "*none*"

    def _set(self, by: Callable[[tuple[Edit, ...]], tuple[Edit, ...]]) -> None:
        """Change the edits; clicks are of the scene before."""
        self._change(lambda wish: replace(wish, edits=by(wish.edits), marked=None))
        self.list()


def _said(edit: Edit) -> str:
    """An edit in words."""
    if isinstance(edit, Insert):
        return f"insert {edit.file.name}"
    if isinstance(edit, Separate):
        return f"cut out {edit.object}"
    given = {name: getattr(edit, name, None) for name in ("base_color", "emission", "roughness", "metallic")}
    words = ", ".join(
        f"{name} {value:.2f}" if isinstance(value, float) else name.replace("base_color", "color")
        for name, value in given.items()
        if value is not None
    )
    return f"{edit.action} {edit.select.object}" + (f": {words}" if words else "")
