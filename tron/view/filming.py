"""The panel of a camera path: views that are kept, and the way between them, to be played and filmed."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import viser
from scipy.spatial.transform import Rotation

from tron.cameras import Camera
from tron.trajectories import keyframed

FRAMES_PER_SECOND = 24
"""Of the film."""
PLAYED_PER_SECOND = 12
"""Views that a client is sent while the path is played."""
DOT = 0.02
"""Radius of the dot where a kept view is from, of the subject's. It is not seen from within."""
EMPTY = "*no views yet: look somewhere, and keep it*"


class Filming:
    """Kept views, and the buttons about them.

    Args:
        server: that shows them.
        size: radius of the subject, world units.
        look: the camera of a client, +z up; None: not yet known.
        color: of the views in the scene.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        size: float,
        look: Callable[[viser.ClientHandle], Camera | None],
        color: tuple[int, int, int],
    ) -> None:
        self._scene, self._size, self._look, self._color = server.scene, DOT * size, look, color
        self._kept: list[Camera] = []
        # Hidden as a whole while it is played: its parts are drawn anew when the path changes meanwhile.
        self._way = server.scene.add_frame("/path", show_axes=False)
        self._shown: list[Any] = []  # in the scene: a dot each, and the way between them
        self._playing = threading.Event()
        gui = server.gui
        with gui.add_folder("Camera path", expand_by_default=False):
            self._words = gui.add_markdown(EMPTY)
            keep = gui.add_button("Keep this view", icon=viser.Icon.CAMERA_PLUS)
            self._seconds = gui.add_number("Seconds", 4.0, min=0.5, max=120.0, step=0.5)
            steps = gui.add_button_group("Path", ("Play", "Drop last", "Clear"))
        keep.on_click(lambda event: None if event.client is None else self.keep(self._look(event.client)))
        self._seconds.on_update(lambda _: self._say())
        steps.on_click(self._step)

    def keep(self, camera: Camera | None) -> None:
        """One more view, framed as the first one."""
        if camera is None:
            return
        self._kept.append(alike(camera, self._kept[0]) if self._kept else camera)
        self._say()

    def path(self) -> list[Camera]:
        """The film's cameras, +z up; none where no way is there: of fewer than two views."""
        if len(self._kept) < 2:
            return []
        frames = max(2, round(float(self._seconds.value) * FRAMES_PER_SECOND))
        return keyframed(self._kept, frames)

    def play(self, client: viser.ClientHandle) -> None:
        """Take a client along the path; again: stop."""
        if self._playing.is_set():
            self._playing.clear()
            return
        path = self.path()
        if path:
            self._playing.set()
            threading.Thread(target=self._play, args=(client, path), daemon=True).start()

    def _play(self, client: viser.ClientHandle, path: list[Camera]) -> None:
        self._way.visible = False
        began, last = time.perf_counter(), False
        while self._playing.is_set() and not last:
            index = int((time.perf_counter() - began) * FRAMES_PER_SECOND)
            last = index >= len(path) - 1
            camera = path[min(index, len(path) - 1)]
            x, y, z, w = Rotation.from_matrix(camera.camera_to_world[:3, :3]).as_quat()
            with client.atomic():
                client.camera.position = tuple(camera.position)
                client.camera.wxyz = (w, x, y, z)
            client.flush()
            time.sleep(1 / PLAYED_PER_SECOND)
        self._playing.clear()
        self._way.visible = True

    def _step(self, event: Any) -> None:
        if event.target.value == "Play":
            self.play(event.client)
            return
        self._playing.clear()
        del self._kept[-1 if event.target.value == "Drop last" else 0 :]
        self._say()

    def _say(self) -> None:
        self._draw()
        count = len(self._kept)
        frames = len(self.path())
        more = f": {frames} frames" if frames else ", one more makes a path"
        self._words.content = f"{count} view{'s' if count > 1 else ''}{more}" if count else EMPTY

    def _draw(self) -> None:
        while self._shown:
            self._shown.pop().remove()
        places = np.array([camera.position for camera in self._kept])
        for number, place in enumerate(places):
            dot = self._scene.add_icosphere(
                f"/path/{number}", radius=self._size, color=self._color, position=tuple(place)
            )
            self._shown.append(dot)
        if len(places) > 1:
            ways = np.stack([places[:-1], places[1:]], axis=1)
            line = self._scene.add_line_segments(
                "/path/way", points=ways, colors=self._color, thickness=0.3 * self._size
            )
            self._shown.append(line)


def alike(camera: Camera, first: Camera) -> Camera:
    """A camera with the image size of another; what is seen from top to bottom stays."""
    scale = first.height / camera.height
    fx, fy = scale * camera.fx, scale * camera.fy
    width, height = first.width, first.height
    return Camera(fx, fy, width / 2, height / 2, width, height, camera.world_to_camera)
