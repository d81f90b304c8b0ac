"""Pictures for the judge, as PNG files that anyone can view."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from eval.compare.displayed import TRUTH, displayed
from eval.judge.schedule import CONTROL, SPOILED, Question, spoiled
from eval.protocol.method import MethodFolder
from eval.protocol.pictures import Fault, frame_name
from eval.protocol.suite import Suite
from tron.io.images import encode_png

log = logging.getLogger("tron.eval")


class Sent:
    """Files ``folder/METHOD/SCENE/LIGHT/NNNN.png`` of the views in the questions."""

    def __init__(self, folder: Path):
        self.folder = folder

    def __call__(self, question: Question, method: str) -> bytes:
        """Return the picture of a method in a question."""
        return self._path(method, question.scene, question.light, question.view).read_bytes()

    def _path(self, method: str, scene: str, light: str, view: int) -> Path:
        return self.folder / method / scene / light / frame_name(view, ".png")

    def write(
        self,
        suite: Suite,
        folders: Mapping[str, MethodFolder | None],
        ours: str,
        asked: Iterable[Question],
    ) -> dict[str, str]:
        """Write all pictures of the questions, scene by scene; return method -> its fault.

        The control's picture is the truth, or ours if the truth is unknown.
        """
        views: dict[tuple[str, str], set[int]] = {}
        for each in asked:
            views.setdefault((each.scene, each.light), set()).add(each.view)
        control = TRUTH if TRUTH in folders else ours
        faults: dict[str, str] = {}
        for method, folder in folders.items():
            try:
                for scene in suite.scenes.values():
                    for light, pictures in displayed(suite, scene, folder):
                        for view in views.get((scene.name, light), ()):
                            data = {method: pictures[view]}
                            if method == control:
                                data |= {CONTROL: pictures[view], SPOILED: spoiled(pictures[view])}
                            for name, picture in data.items():
                                self._write(self._path(name, scene.name, light, view), picture)
                    log.info("pictures of %s: %s", method, scene.name)
            except Fault as fault:
                faults[method] = str(fault)
        return faults

    def _write(self, path: Path, picture: np.ndarray) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(encode_png(picture))
