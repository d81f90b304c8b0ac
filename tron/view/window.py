"""The window of a studio in a browser, by viser: controls that say what is wished for, and its pictures.

Every client has its own camera and its own picture; the scene, its edits and the light are shared. Nothing is
read but what the window was given by name, and nothing is written outside its folder.
"""

from __future__ import annotations

import errno
import io
import json
import logging
import shlex
import socket
import threading
from collections.abc import Callable, Mapping
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import viser
from scipy.spatial.transform import Rotation

from tron.cameras import Camera
from tron.color import linear_to_srgb, srgb_to_linear
from tron.editing import Edit, Insert, Material, Move, Remove, Selection, Separate
from tron.errors import TronError
from tron.framing import find_subject
from tron.gaussians.scene import GaussianScene, rotation_matrices
from tron.io.images import write_image
from tron.shading.environments.environment import EnvironmentMap
from tron.storage import write_atomic
from tron.trajectories import turn_cameras
from tron.view.cutting import Cutting
from tron.view.dragging import divider, panorama
from tron.view.filming import FRAMES_PER_SECOND, Filming
from tron.view.stage import BUFFERS, Left, Stage, Wish
from tron.view.studio import Picture, Studio

log = logging.getLogger(__name__)

WIDEST = 1024
"""Pixels along the longer side that are drawn; a larger window shows them enlarged."""
QUALITY = {True: 75, False: 92}
"""Of JPEG, while something moves and at rest."""
PATIENCE_SECONDS = 30.0
"""For an answer of the studio's thread."""
NOTICE_SECONDS = 8.0
SIDES: dict[str, tuple[Left, str]] = {
    "nothing": ("nothing", ""),
    "before the edits": ("before", ""),
    "the scan's own look": ("capture", ""),
}
"""What may be left of the divider besides other lights."""
NOBODY = "click one, or choose"
ABOVE = 4.0
"""Spacings above a point that was clicked from which what is inserted is lowered."""
EVERYWHERE = "0.0.0.0"
"""Host that stands for all addresses of the machine."""
BRAND = (232, 150, 60)


def require_free_port(host: str, port: int) -> None:
    """Raise TronError where nothing can listen there: viser would silently take the next port."""
    error = _refusal(host, port)
    if error is not None:
        mend = f"give another, such as port={port + 1}"
        what = f"cannot listen on {host}:{port}: {error.strerror or error}"
        raise TronError(what, mend=mend) from error


def free_port(host: str, first: int) -> int:
    """The first port from ``first`` on that nobody listens on.

    Raises:
        TronError: it is refused for another reason, or none of the next 100 is free.
    """
    for port in range(first, min(first + 100, 65_536)):
        error = _refusal(host, port)
        if error is None or error.errno != errno.EADDRINUSE:
            break
    require_free_port(host, port)
    return port


def _refusal(host: str, port: int) -> OSError | None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            return error
    return None


class Window:
    """Serves one scene until :meth:`close`.

    Args:
        scene: valid, in the frame of its file.
        file: that it is of, for the command line that films it.
        lights: files of environment maps by name.
        models: files of scenes that may be inserted, by name.
        folder: that is written to; it need not exist.
        host, port: to listen on.
        home: the first view, where up is +z.
        turned: lights that stand otherwise than in their files, by name.
        studio: more arguments of :class:`tron.view.studio.Studio`.

    Raises:
        TronError: the port is taken.
    """

    def __init__(
        self,
        scene: GaussianScene,
        file: Path,
        lights: Mapping[str, Path],
        models: Mapping[str, Path],
        folder: Path,
        host: str,
        port: int,
        home: Camera,
        turned: Mapping[str, EnvironmentMap] | None = None,
        **studio: Any,
    ) -> None:
        require_free_port(host, port)
        self._file, self._lights, self._models, self._folder = file, lights, models, folder
        # Every address is none that a browser on this machine could go to.
        self.address = f"http://{'localhost' if host == EVERYWHERE else host}:{port}"
        self._spacing, self._offset = scene.spacing, scene.offset
        self._undone: list[Edit] = []
        self._numbers: dict[str, int] = {}  # of the objects, by their label
        self._chosen: int | None = None
        self._moving = False  # whether the arrows have moved the object since they were placed
        self._clicked: np.ndarray | None = None  # in the frame of the file
        self._of_client: dict[int, tuple[Any, viser.GuiMarkdownHandle]] = {}
        self._last: dict[int, Picture] = {}
        self._lock = threading.Lock()
        with redirect_stdout(io.StringIO()):  # viser's banner
            self._server = viser.ViserServer(host=host, port=port, label="TRON", verbose=False)
        # A client may ask for a tunnel through viser's own host, button or not: nobody listens from outside.
        self._server.request_share_url = lambda *_, **__: None
        subject = find_subject(scene.upright())
        self._frame(home, subject.centre)
        self._build(subject.radius)
        self.studio = Studio(scene, {**lights, **(turned or {})}, home, self._show, self._say, **studio)
        self._server.on_client_connect(self._greet)
        self._server.on_client_disconnect(lambda client: self._part(client.client_id))
        self._server.scene.on_click()(lambda event: self._pick(event, shift=False))
        self._server.scene.on_click(modifier="shift")(lambda event: self._pick(event, shift=True))
        threading.Thread(target=self._refresh, daemon=True).start()

    def close(self) -> None:
        """End the studio's thread, then the server."""
        self.studio.close()
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    def _frame(self, home: Camera, subject: np.ndarray) -> None:
        server = self._server
        server.gui.configure_theme(
            dark_mode=True, show_logo=False, show_share_button=False, brand_color=BRAND
        )
        server.gui.set_panel_label("TRON")
        server.gui.main_panel.dock_right()
        server.scene.set_up_direction("+z")
        centre = home.position + home.forward * ((subject - home.position) @ home.forward)
        server.initial_camera.position = tuple(home.position)
        server.initial_camera.look_at = tuple(centre)
        server.initial_camera.fov = 2 * float(np.arctan(0.5 * home.height / home.fy))

    def _build(self, size: float) -> None:
        gui = self._server.gui
        self._buffer = gui.add_dropdown("Show", BUFFERS, initial_value="lit", hint="what the picture is of")
        self._buffer.on_update(lambda _: self._want(buffer=self._buffer.value))
        with gui.add_folder("Light"):
            self._map = gui.add_html("", order=-1)
            names = tuple(self._lights)
            self._light = gui.add_dropdown("Map", names, initial_value=names[0])
            self._turn = gui.add_slider("Turn °", min=0, max=360, step=1, initial_value=0)
            self._stops = gui.add_slider("Exposure", min=-4.0, max=4.0, step=0.1, initial_value=0.0)
        self._light.on_update(lambda _: self._choose_light())
        self._turn.on_update(lambda _: self._want(turn=float(self._turn.value)))
        self._stops.on_update(lambda _: self._want(stops=float(self._stops.value)))
        with gui.add_folder("Compare", expand_by_default=False):
            lights = {f"light: {name}": name for name in names}
            self._sides = {**SIDES, **{said: ("light", name) for said, name in lights.items()}}
            self._left = gui.add_dropdown("Left side", tuple(self._sides), initial_value=next(iter(SIDES)))
            self._divider = gui.add_slider("Divider %", min=0, max=100, step=0.1, initial_value=50)
            self._bar = gui.add_html("")
        self._left.on_update(lambda _: self._compare())
        self._divider.on_update(lambda _: self._want(divider=float(self._divider.value) / 100))
        with gui.add_folder("Object"):
            self._object: Any = gui.add_dropdown("Object", [NOBODY], initial_value=NOBODY)
            self._visible = gui.add_checkbox("Visible", True, hint="what is hidden is still saved")
            self._color = gui.add_rgb("Color", (128, 128, 128))
            self._roughness = gui.add_slider("Roughness", min=0.0, max=1.0, step=0.01, initial_value=0.5)
            self._metallic = gui.add_slider("Metallic", min=0.0, max=1.0, step=0.01, initial_value=0.0)
            self._arrows = gui.add_checkbox("Move", False, hint="arrows and rings move the object")
            self._remove = gui.add_button("Remove object", icon=viser.Icon.TRASH, color="gray")
        self._object.on_update(self._of_user(self._choose))
        self._visible.on_update(self._of_user(self._hide))
        self._color.on_update(self._of_user(lambda: self._paint(base_color=self._picked_color())))
        self._roughness.on_update(self._of_user(lambda: self._paint(roughness=float(self._roughness.value))))
        self._metallic.on_update(self._of_user(lambda: self._paint(metallic=float(self._metallic.value))))
        self._arrows.on_update(lambda _: self._place_arrows())
        self._remove.on_click(lambda _: self._edit_chosen(lambda of: Remove(select=of)))
        self._cutting = Cutting(
            self._server, size, lambda of: self.studio.change(of), self._ask, self._edit, self._take
        )
        if self._models:
            with gui.add_folder("Insert", expand_by_default=False):
                names = tuple(self._models)
                self._model = gui.add_dropdown("Model", names, initial_value=names[0])
                self._size = gui.add_number("Size", 1.0, min=0.001, max=1000.0, step=0.01)
                gui.add_button("Insert where you clicked").on_click(lambda _: self._insert())
        with gui.add_folder("Edits"):
            self._done = gui.add_markdown("*none*")
            steps = gui.add_button_group("Step", ("Undo", "Redo"))
        steps.on_click(lambda event: (self._undo if event.target.value == "Undo" else self._redo)())
        self._filming = Filming(self._server, size, lambda client: _camera_of(client.camera), BRAND)
        with gui.add_folder("Save", expand_by_default=False):
            save = gui.add_button_group("Save", ("Picture", "Scene", "Film"))
            self._saved = gui.add_markdown(f"into `{self._folder}`")
        save.on_click(self._save)
        self._gizmo: viser.TransformControlsHandle | None = None

    # Callbacks: of viser's threads. What the server sets itself has no client, and wishes for nothing.

    def _of_user(self, act: Any) -> Any:
        return lambda event: act() if event.client is not None else None

    def _want(self, **changes: Any) -> None:
        self.studio.wish(**changes)

    def _choose_light(self) -> None:
        self._want(light=self._light.value)
        self._show_map()

    def _compare(self) -> None:
        said = self._left.value
        left, light = self._sides[said]
        self._want(left=left, left_light=light)
        self._bar.content = "" if left == "nothing" else divider(self._divider._impl.uuid, said)

    def _edit(self, edit: Edit, replaced: type[Edit] | None = None) -> None:
        """Do one more edit; or another in place of the last one, if that is of the same kind and object."""

        def with_it(wish: Wish) -> Wish:
            edits = list(wish.edits)
            if replaced is not None and edits and type(edits[-1]) is replaced:
                last: Any = edits[-1]
                if last.select == edit.select:  # type: ignore[union-attr]
                    given = last.model_dump(exclude_unset=True) | edit.model_dump(exclude_unset=True)
                    return replace(wish, edits=(*edits[:-1], type(edit).model_validate(given)))
            return replace(wish, edits=(*edits, edit))

        self._undone.clear()
        self._changed(with_it)
        if self._moving and not isinstance(edit, Move):  # the arrows count from where the object stands now
            self._place_arrows()

    def _changed(self, by: Callable[[Wish], Wish]) -> None:
        """Change the edits; clicks are of the scene before."""
        self.studio.change(lambda wish: replace(by(wish), marked=None))
        self._cutting.clear()
        self._refresh()

    def _edit_chosen(self, made: Any, replaced: type[Edit] | None = None) -> None:
        if self._chosen is not None:
            self._edit(made(Selection(object=self._chosen)), replaced)

    def _paint(self, **material: Any) -> None:
        self._edit_chosen(lambda of: Material(select=of, **material), Material)

    def _picked_color(self) -> tuple[float, ...]:
        linear = srgb_to_linear(np.array(self._color.value) / 255)
        return tuple(float(value) for value in np.clip(linear, 0, 1))

    def _hide(self) -> None:
        if (chosen := self._chosen) is not None:
            show = self._visible.value
            self.studio.change(
                lambda wish: replace(wish, hidden=wish.hidden - {chosen} if show else wish.hidden | {chosen})
            )

    def _undo(self) -> None:
        def without(wish: Wish) -> Wish:
            self._undone.extend(wish.edits[-1:])
            return replace(wish, edits=wish.edits[:-1])

        self._changed(without)
        self._place_arrows()

    def _redo(self) -> None:
        if self._undone:
            edit = self._undone.pop()
            self._changed(lambda wish: replace(wish, edits=(*wish.edits, edit)))
            self._place_arrows()

    def _insert(self) -> None:
        at = self._clicked
        if at is None:
            middle = self._ask(lambda stage: (stage.session.scene.bounds(0.02), stage.session.scene.up))
            if middle is None:
                return
            (low, high), up = middle
            at = 0.5 * (low + high) + 0.5 * abs(high - low) @ abs(up) * up
        file = self._models[self._model.value]
        place = tuple(float(value) for value in at)
        self._edit(Insert(file=file, at=place, scale=float(self._size.value)))  # pyright: ignore

    def _choose(self) -> None:
        """Take the object of the dropdown: its materials are put into the sliders."""
        chosen = self._numbers.get(self._object.value)
        self._chosen = chosen

        def means(stage: Stage) -> tuple[np.ndarray, float, float] | None:
            scene = stage.session.scene
            which = scene.object_id == chosen
            if not which.any():
                return None
            color = scene.base_color[which].mean(0)
            return color, float(scene.roughness[which].mean()), float(scene.metallic[which].mean())

        found = None if chosen is None else self._ask(means)
        if found is not None:
            color, roughness, metallic = found
            shown = (255 * np.clip(np.asarray(linear_to_srgb(color)), 0, 1) + 0.5).astype(int)
            self._color.value = tuple(int(value) for value in shown)  # pyright: ignore
            self._roughness.value, self._metallic.value = round(roughness, 2), round(metallic, 2)
            self._visible.value = chosen not in self.studio.wished.hidden
        self._place_arrows()

    def _place_arrows(self) -> None:
        """The gizmo at the foot of the chosen object, where it is wanted."""
        self._moving = False
        if self._gizmo is not None:
            self._gizmo.remove()
            self._gizmo = None
        chosen = self._chosen
        if chosen is None or not self._arrows.value:
            return

        def place(stage: Stage) -> tuple[np.ndarray, np.ndarray, float] | None:
            scene = stage.session.scene
            which = scene.object_id == chosen
            if not which.any():
                return None
            points = scene.means[which].astype(np.float64)
            return points.mean(0), stage.turn, float(np.ptp(points, axis=0).max())

        found = self._ask(place)
        if found is None:
            return
        centre, turn, size = found
        gizmo = self._server.scene.add_transform_controls(
            "/move", scale=max(0.6 * size, 1e-6), depth_test=False, disable_sliders=True,
            position=tuple(turn @ centre), line_width=3.0,
        )  # fmt: skip

        def moved(_: Any) -> None:
            by = turn.T @ np.array(gizmo.position) - centre
            vector = turn.T @ Rotation.from_quat(np.roll(gizmo.wxyz, -1)).as_rotvec()
            angle = float(np.degrees(np.linalg.norm(vector)))
            if not np.any(by) and not angle:
                return
            words: dict[str, Any] = {"by": tuple(map(float, by)), "about": tuple(map(float, centre))}
            if angle > 1e-3:
                words |= {"turn": angle, "axis": tuple(map(float, vector))}
            self._edit_chosen(lambda of: Move(select=of, **words), Move if self._moving else None)
            self._moving = True

        gizmo.on_update(moved)
        self._gizmo = gizmo

    def _pick(self, event: viser.SceneClickEvent, shift: bool) -> None:
        """Choose the object of a click; where clicks select, it is one of those."""
        origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)
        found = self._ask(
            lambda stage: (stage.first_hit(origin, direction), stage.session.scene.up, stage.turn)
        )
        if found is None or found[0] is None:
            return
        hit, up, turn = found
        if self._cutting.active:
            self._cutting.click(hit, turn @ hit.point, shift)
        elif not shift:
            self._clicked = hit.point + ABOVE * self._spacing * up
            self._take(hit.object)

    def _take(self, number: int) -> None:
        """Choose the object of a number, as if in the list."""
        label = next((name for name, each in self._numbers.items() if each == number), None)
        if label is not None:
            self._object.value = label
            self._choose()

    def _refresh(self) -> None:
        """Objects and edits, as they are after the wish of the moment."""
        edits = self.studio.wished.edits
        shown = [f"{n}. {_said(each)}" for n, each in enumerate(edits, 1)]
        self._done.content = "\n".join(shown[-4:]) if shown else "*none*"
        objects = self._ask(Stage.objects)
        if objects is None:
            return
        labels = {f"{number} · {count:,} surfels": number for number, count in objects.items()}
        with self._lock:
            if self._numbers == labels:
                return
            self._numbers = labels
            self._object.options = (NOBODY, *labels)
            kept = next((name for name, each in labels.items() if each == self._chosen), NOBODY)
            self._object.value = kept
            self._chosen = labels.get(kept)

    def _show_map(self) -> None:
        name = self._light.value
        found = self._ask(lambda stage: stage.thumbnail(name))
        if found is not None:
            self._map.content = panorama(found, self._turn._impl.uuid)

    def _ask(self, question: Any) -> Any:
        """The studio's answer; None where there is none."""
        try:
            return self.studio.ask(question).result(PATIENCE_SECONDS)
        except Exception as error:  # a wish that could not be done is said where it is taken back
            log.debug("no answer: %s", error)
            return None

    # Files: of fixed names in one folder, by free numbers; nothing is replaced.

    def _path(self, name: str, suffix: str) -> Path:
        self._folder.mkdir(parents=True, exist_ok=True)
        numbers = (f"{name}-{n:03d}{suffix}" for n in range(1, 1_000_000))
        return next(path for each in numbers if not (path := self._folder / each).exists())

    def _save(self, event: Any) -> None:
        try:
            with self._lock:
                what = event.target.value
                if what == "Scene":
                    said = _listed(*self._save_scene())
                else:
                    picture = self._last.get(event.client_id)
                    if picture is None:
                        raise TronError("there is no picture yet")
                    said = self._film(picture) if what == "Film" else _listed(self._save_picture(picture))
        except (TronError, OSError) as error:
            self._say(str(error))
            return
        self._saved.content = said

    def _save_picture(self, picture: Picture) -> Path:
        path = self._path("picture", ".png")
        write_image(path, picture.image)
        return path

    def _save_scene(self) -> list[Path]:
        """The scene of the moment, and the edits that made it where there are any."""
        path = self._path("scene", ".ply")
        scene, edits = self.studio.ask(lambda stage: (stage.session.scene, stage.session.edits)).result(
            PATIENCE_SECONDS
        )
        scene.save(path)
        if not edits.edits:
            return [path]
        listed = self._path("edits", ".yaml")
        edits.write(listed)
        return [path, listed]

    def _film(self, picture: Picture) -> str:
        """Save what tron-relight needs to film the path, or the view; its command line, as Markdown."""
        wish, scene = picture.wish, self._file
        turn, exposure = self.studio.ask(
            lambda stage: (stage.turn, stage.exposure(wish.light, wish.stops))
        ).result(PATIENCE_SECONDS)
        if wish.edits:
            scene = self._save_scene()[0]
        path = self._filming.path()
        file = self._path("path" if path else "view", ".json")
        cameras = turn_cameras(path or [picture.camera], turn.T)
        content = {"offset": self._offset.tolist(), "cameras": [camera.to_dict() for camera in cameras]}
        write_atomic(file, json.dumps(content, indent=1) + "\n")
        words = [
            *("tron-relight", f"scene={scene}", f"environment={self._lights[wish.light]}"),
            *(f"rotation={wish.turn:g}", f"exposure={exposure:.4g}", f"cameras={file}", "quality=final"),
            *(f"width={cameras[0].width}", f"height={cameras[0].height}"),
            *([f"fps={FRAMES_PER_SECOND}"] if path else []),
            f"output_dir={file.with_suffix('')}",
        ]
        line = " ".join(map(shlex.quote, words))
        log.info("%s", line)
        return f"```\n{line}\n```"

    # Pictures: of the studio's thread.

    def _greet(self, client: viser.ClientHandle) -> None:
        bar = client.gui.add_progress_bar(0, order=-2, color=BRAND)
        words = client.gui.add_markdown("reading the scene", order=-1)
        self._of_client[client.client_id] = bar, words
        client.camera.on_update(lambda _: self._look(client))
        self._look(client)

    def _look(self, client: viser.ClientHandle) -> None:
        camera = _camera_of(client.camera)
        if camera is not None:
            self.studio.look(client.client_id, camera)

    def _part(self, number: int) -> None:
        self.studio.look(number, None)
        self._last.pop(number, None)
        self._of_client.pop(number, None)

    def _show(self, number: int, picture: Picture) -> None:
        client = self._server.get_clients().get(number)
        if client is None:
            self.studio.look(number, None)
            return
        first = not self._last
        self._last[number] = picture
        full, image = (picture.camera.width, picture.camera.height), picture.image
        if image.shape[1::-1] != full:  # browsers enlarge in blocks
            image = cv2.resize(image, full, interpolation=cv2.INTER_LINEAR)
        moving = picture.refined == 0
        client.scene.set_background_image(image, format="jpeg", jpeg_quality=QUALITY[moving])
        if number in self._of_client:
            bar, words = self._of_client[number]
            bar.value = 100 * picture.refined
            height, width = picture.image.shape[:2]
            state = "moving" if moving else "done" if picture.refined == 1 else "refining"
            words.content = f"{state} · {width} × {height} · {picture.seconds:.2f} s"
        client.flush()
        if first:
            threading.Thread(target=self._show_map, daemon=True).start()

    def _say(self, line: str) -> None:
        log.warning("%s", line)
        for client in self._server.get_clients().values():
            client.add_notification(
                "That cannot be done", line, auto_close_seconds=NOTICE_SECONDS, color="red"
            )
        wish = self.studio.wished
        self._light.value = wish.light
        sides = {side: said for said, side in self._sides.items()}
        self._left.value = sides[wish.left, wish.left_light]
        self._cutting.follow(wish.marked)
        if self._chosen is not None:
            self._visible.value = self._chosen not in wish.hidden
        threading.Thread(target=self._refresh, daemon=True).start()


def _camera_of(handle: viser.CameraHandle) -> Camera | None:
    """A client's camera; None: not yet known. viser's axes are OpenCV's, its field of view is vertical."""
    try:
        wide, high = handle.image_width, handle.image_height
        turn = rotation_matrices(np.array([handle.wxyz], np.float64))[0].astype(np.float64)
        position, fov = np.array(handle.position, np.float64), float(handle.fov)
    except (AssertionError, AttributeError):
        return None
    if not wide or not high:
        return None
    share = min(1.0, WIDEST / max(wide, high))
    width, height = max(16, round(share * wide)), max(16, round(share * high))
    focal = 0.5 * height / np.tan(0.5 * fov)
    u, _, vt = np.linalg.svd(turn)
    matrix = np.eye(4)
    matrix[:3, :3] = (u @ vt).T
    matrix[:3, 3] = -matrix[:3, :3] @ position
    try:
        return Camera(focal, focal, width / 2, height / 2, width, height, matrix)
    except TronError:  # a client may send anything
        return None


def _listed(*paths: Path) -> str:
    """Paths as Markdown, one below another."""
    return "\n\n".join(f"`{path}`" for path in paths)


def _said(edit: Edit) -> str:
    """An edit in words, for the list of those that were done."""
    if isinstance(edit, Insert):
        return f"insert {edit.file.name}"
    if isinstance(edit, Separate):
        return f"cut out {edit.object}"
    changed = [
        name for name in ("base_color", "roughness", "metallic") if getattr(edit, name, None) is not None
    ]
    words = ", ".join(changed).replace("base_color", "color")
    return f"{edit.action} {edit.select.object}" + (f": {words}" if words else "")
