"""The window of a studio in a browser, by viser: controls that set the wish, and its pictures.

Every client has its own camera and its own picture; the scene, its edits and the light are shared. The window
reads only files that it was given by name, and writes only into its folder.
"""

from __future__ import annotations

import errno
import io
import logging
import socket
import threading
from collections.abc import Mapping
from concurrent.futures import CancelledError
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
import viser

from tron.cameras import Camera
from tron.editing import Edit, Insert
from tron.errors import TronError
from tron.framing import find_subject
from tron.gaussians.scene import GaussianScene, rotation_matrices
from tron.shading.environments.environment import EnvironmentMap
from tron.view.cutting import Cutting
from tron.view.filming import Filming
from tron.view.finding import MaterialSearch
from tron.view.history import HAND_SECONDS, History
from tron.view.objects import Objects
from tron.view.saving import Saving
from tron.view.scripts import divider, folded_on_phones, panorama
from tron.view.stage import BUFFERS, Left, Quality
from tron.view.studio import WORKING, Picture, Studio

log = logging.getLogger(__name__)

WIDEST = 1024
"""Pixels along the longer side that are drawn; a larger window shows them enlarged."""
QUALITY = {True: 75, False: 92}
"""Of JPEG, while something moves and at rest."""
NOTICE_SECONDS = 8.0
SIDES: dict[str, tuple[Left, str]] = {
    "nothing": ("nothing", ""),
    "before the edits": ("before", ""),
    "the scan's own look": ("capture", ""),
}
"""What may be left of the divider besides other lights."""
ABOVE = 4.0
"""Height in spacings above a clicked point from which an inserted object is lowered."""
EVERYWHERE = "0.0.0.0"
"""Host that stands for all addresses of the machine."""
GUESSED = "*Materials are guessed from the scan's colours, which keep the light of its capture.*"
FOUND = "*Materials were found, and are kept.*"
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
        light: name of the first one; None: the first of them.
        search: finds materials where they are guessed; None: nothing does.
        searching: whether it begins at once, not by a button.
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
        light: str | None = None,
        search: MaterialSearch | None = None,
        searching: bool = False,
        **studio: Any,
    ) -> None:
        require_free_port(host, port)
        self._lights, self._models = lights, models
        # Every address is none that a browser on this machine could go to.
        self.address = f"http://{'localhost' if host == EVERYWHERE else host}:{port}"
        self._spacing = scene.spacing
        self._clicked: np.ndarray | None = None  # in the frame of the file
        self._of_client: dict[int, tuple[Any, viser.GuiMarkdownHandle]] = {}
        self._sizes: dict[int, tuple[int, int]] = {}
        self._last: dict[int, Picture] = {}
        self._pictures = threading.Condition()
        self._about, self._shape = "reading the scene", (home.width, home.height)
        logging.getLogger("websockets").setLevel(logging.WARNING)  # it says who comes and goes
        with redirect_stdout(io.StringIO()):  # viser's banner
            self._server = viser.ViserServer(host=host, port=port, label="TRON", verbose=False)
        # A client may ask for a tunnel through viser's own host, button or not: nobody listens from outside.
        self._server.request_share_url = lambda *_, **__: None
        subject = find_subject(scene.upright())
        self._frame(home, subject.centre)
        first = light or next(iter(lights))
        self._search = search if scene.materials_guessed else None
        self._build(subject.radius, first, file, folder, scene.offset, scene.materials_guessed)
        self._closed = False
        self.studio = Studio(
            scene, {**lights, **(turned or {})}, home, self._show, self._say,
            busy=self._busy, light=light, **studio,
        )  # fmt: skip
        self._server.on_client_connect(self._greet)
        self._server.on_client_disconnect(lambda client: self._part(client.client_id))
        self._server.scene.on_click()(lambda event: self._click(event, shift=False))
        self._server.scene.on_click(modifier="shift")(lambda event: self._click(event, shift=True))
        threading.Thread(target=self._follow, daemon=True).start()
        if searching:
            self._find()

    def close(self) -> None:
        """End the search, the studio's thread, then the server."""
        with self._pictures:
            self._closed = True
            self._pictures.notify_all()
        if self._search is not None:
            self._search.close()
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

    def _build(
        self, size: float, light: str, file: Path, folder: Path, offset: np.ndarray, guessed: bool
    ) -> None:
        gui = self._server.gui
        gui.add_html(folded_on_phones(), order=-3)
        if guessed:
            self._materials = gui.add_markdown(GUESSED, order=-2)
        if self._search is not None:
            hint = "minutes; pictures go on meanwhile. What is found is kept, for tron-relight too"
            self._finder = gui.add_button("Find materials", order=-2, hint=hint)
            self._finder.on_click(lambda _: self._find())
        self._buffer = gui.add_dropdown("Show", BUFFERS, initial_value="lit", hint="what the picture is of")
        self._buffer.on_update(lambda _: self._want(buffer=self._buffer.value))
        self._quality = gui.add_dropdown(
            "Quality", get_args(Quality), initial_value="final",
            hint="of pictures at rest; preview: no shadow rays from pixels, no denoiser",
        )  # fmt: skip
        self._quality.on_update(lambda _: self._want(quality=self._quality.value))
        with gui.add_folder("Light"):
            self._map = gui.add_html("", order=-1)
            names = tuple(self._lights)
            self._light = gui.add_dropdown("Map", names, initial_value=light)
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
        self.objects = Objects(
            self._server,
            BRAND,
            lambda: self.studio.wished,
            lambda of: self.studio.change(of),
            self._ask,
            self._do,
        )
        self._cutting = Cutting(
            self._server, size, lambda of: self.studio.change(of), self._ask, self._do, self.objects.take
        )
        if self._models:
            with gui.add_folder("Insert", expand_by_default=False):
                names = tuple(self._models)
                self._model = gui.add_dropdown("Model", names, initial_value=names[0])
                self._size = gui.add_number("Size", 1.0, min=0.001, max=1000.0, step=0.01)
                gui.add_button("Insert where you clicked").on_click(lambda _: self._insert())
        self.history = History(
            self._server, lambda: self.studio.wished, lambda of: self.studio.change(of), self._changed
        )
        self._filming = Filming(self._server, size, self._seen_by, BRAND)
        self.saving = Saving(
            self._server, folder, file, offset, self._lights, self._filming, lambda: self.studio,
            self._seen_by, self._picture_of, self._say,
        )  # fmt: skip

    # Callbacks: of viser's threads.

    def _want(self, **changes: Any) -> None:
        self.studio.wish(**changes)

    def _find(self) -> None:
        """Look for materials, beside the window, and show them when they are there."""
        if self._search is None or self._finder.disabled or self._closed:
            return
        self._finder.disabled = True
        self._materials.content = "*Finding materials …*"
        try:
            self._search.begin(self._finding, self._found)
        except OSError as error:  # no process
            self._found(str(error))

    def _finding(self, about: str, share: float) -> None:
        self._materials.content = f"*Finding materials: {about} · {share:.0%}*"

    def _found(self, why: str) -> None:
        if self._closed or self._search is None:
            return
        if why:
            self._materials.content = f"{GUESSED} *They were not found: {why}*"
            self._finder.disabled = False
            return
        self._finder.remove()
        self._materials.content = FOUND
        self.studio.reopen(self._search.reopened)
        with self._pictures:
            self._last.clear()  # they are of guessed ones

    def _choose_light(self) -> None:
        self._want(light=self._light.value)
        self._show_map()

    def _compare(self) -> None:
        said = self._left.value
        left, light = self._sides[said]
        self._want(left=left, left_light=light)
        self._bar.content = "" if left == "nothing" else divider(self._divider._impl.uuid, said)

    def _do(self, edit: Edit, hand: str = "", within: float = HAND_SECONDS) -> None:
        self.history.do(edit, hand, within)

    def _changed(self) -> None:
        self._cutting.clear()
        self.objects.follow()

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
        self._do(Insert(file=file, at=place, scale=float(self._size.value)))  # pyright: ignore

    def _click(self, event: viser.SceneClickEvent, shift: bool) -> None:
        camera = self._seen_by(event.client)
        if camera is None:
            return
        x, y = (
            min(max(int(share * size), 0), size - 1)
            for share, size in zip(event.screen_pos, (camera.width, camera.height), strict=True)
        )
        self._pick(camera, x, y, shift)

    def _pick(self, camera: Camera, x: int, y: int, shift: bool) -> None:
        """Choose the object of a pixel; where clicks select, it is one of those."""
        found = self._ask(lambda stage: (stage.shown_at(camera, x, y), stage.session.scene.up, stage.turn))
        if found is None or found[0] is None:
            return
        hit, up, turn = found
        if self._cutting.active:
            self._cutting.click(hit, turn @ hit.point, shift)
        elif not shift:
            self._clicked = hit.point + ABOVE * self._spacing * up
            self.objects.take(hit.object)

    def _follow(self) -> None:
        """Let the panel say what the wish of the moment says."""
        self.history.list()
        self.objects.follow()

    def _show_map(self) -> None:
        name = self._light.value
        found = self._ask(lambda stage: stage.thumbnail(name))
        if found is not None and name == self._light.value:
            self._map.content = panorama(found, self._turn._impl.uuid)

    def _ask(self, question: Any) -> Any:
        """The studio's answer, after the wish of the moment is done; None where there is none."""
        try:
            return self.studio.ask(question).result()
        except (CancelledError, TronError) as error:  # what cannot be done is said where it is taken back
            log.debug("no answer: %s", error)
        except Exception:
            log.exception("a question of the panel failed")
        return None

    # Pictures: of the studio's thread.

    def _greet(self, client: viser.ClientHandle) -> None:
        bar = client.gui.add_progress_bar(0, order=-2, color=BRAND)
        words = client.gui.add_markdown(self._about, order=-1)
        self._of_client[client.client_id] = bar, words
        client.camera.on_update(lambda _: self._look(client))
        with self._pictures:
            others = list(self._last.values())
        size = _size_of(client.camera)
        if (
            size is not None and size[0] * self._shape[1] < size[1] * self._shape[0]
        ):  # what was at the sides stays
            wide = np.tan(client.camera.fov / 2) * self._shape[0] / self._shape[1] * size[1] / size[0]
            client.camera.fov = float(2 * np.arctan(wide))
        if others and size is not None:  # its own may have to wait for an edit
            words.content = f"{WORKING}: the picture is another window's"
            image = _cropped(others[-1].image, size[0] / size[1])
            client.scene.set_background_image(image, format="jpeg", jpeg_quality=QUALITY[False])
        self._look(client)

    def _look(self, client: viser.ClientHandle) -> None:
        camera = self._seen_by(client)
        if camera is not None:
            self.studio.look(client.client_id, camera)

    def _seen_by(self, client: viser.ClientHandle) -> Camera | None:
        """A client's camera, of the full size of its view; None: not yet known.

        Where a browser draws slowly, viser's page says three quarters of its size, and goes on saying so.
        """
        size = _size_of(client.camera)
        if size is None:
            return None
        full = self._sizes.get(client.client_id, size)
        share = max(size) / max(full)
        if not (
            0.7 < share <= 1 and abs(size[0] - share * full[0]) < 2 and abs(size[1] - share * full[1]) < 2
        ):
            full = size
        self._sizes[client.client_id] = full
        return _camera_of(client.camera, full)

    def _part(self, number: int) -> None:
        self.studio.look(number, None)
        with self._pictures:
            self._last.pop(number, None)
            self._pictures.notify_all()
        self._of_client.pop(number, None)
        self._sizes.pop(number, None)

    def _busy(self, about: str, share: float) -> None:
        self._about = about + (f" · {share:.0%}" if share else "")
        for bar, words in list(self._of_client.values()):
            bar.value, words.content = 100 * share, self._about

    def _show(self, number: int, picture: Picture) -> None:
        client = self._server.get_clients().get(number)
        if client is None:
            self.studio.look(number, None)
            return
        with self._pictures:
            first = not self._last
            self._last[number] = picture
            self._pictures.notify_all()
        full, image = (picture.camera.width, picture.camera.height), picture.image
        if image.shape[1::-1] != full:  # browsers enlarge in blocks
            image = cv2.resize(image, full, interpolation=cv2.INTER_LINEAR)
        moving = picture.refined == 0
        client.scene.set_background_image(image, format="jpeg", jpeg_quality=QUALITY[moving])
        if number in self._of_client and picture.wish == self.studio.wished:
            bar, words = self._of_client[number]
            bar.value = 100 * picture.refined
            height, width = picture.image.shape[:2]
            state = f"moving · {picture.seconds:.2f} s" if moving else "refining"
            words.content = f"{'done' if picture.refined == 1 else state} · {width} × {height}"
        client.flush()
        if first:
            threading.Thread(target=self._show_map, daemon=True).start()

    def _picture_of(self, client: viser.ClientHandle) -> Picture:
        """A client's picture of the wish and the view of the moment, once nothing is left to refine."""
        number = client.client_id

        def there() -> bool:
            if self._closed or number not in self._of_client:
                return True
            picture, camera = self._last.get(number), self._seen_by(client)
            if picture is None or camera is None or picture.refined < 1:
                return False
            return picture.wish == self.studio.wished and picture.camera.to_dict() == camera.to_dict()

        with self._pictures:
            while not self._pictures.wait_for(there, timeout=1.0):  # a wish may be taken back
                pass
            if self._closed or number not in self._last:
                raise CancelledError
            return self._last[number]

    def _say(self, line: str) -> None:
        log.warning("%s", line)
        for client in self._server.get_clients().values():
            client.add_notification(
                "That cannot be done", line, auto_close_seconds=NOTICE_SECONDS, color="red"
            )
        wish = self.studio.wished
        self._light.value, self._turn.value, self._stops.value = wish.light, round(wish.turn), wish.stops
        self._buffer.value, self._quality.value = wish.buffer, wish.quality
        sides = {side: said for said, side in self._sides.items()}
        self._left.value = sides[wish.left, wish.left_light]
        self._cutting.follow(wish.marked)
        threading.Thread(target=self._follow, daemon=True).start()


def _size_of(handle: viser.CameraHandle) -> tuple[int, int] | None:
    """Width and height of a client's view, pixels; None: not yet known."""
    try:
        wide, high = handle.image_width, handle.image_height
    except (AssertionError, AttributeError):
        return None
    return (wide, high) if wide and high else None


def _cropped(image: np.ndarray, aspect: float) -> np.ndarray:
    """The middle of an image, width over height."""
    height, width = image.shape[:2]
    wide, high = min(width, round(height * aspect)), min(height, round(width / aspect))
    x, y = (width - wide) // 2, (height - high) // 2
    return image[y : y + high, x : x + wide]


def _camera_of(handle: viser.CameraHandle, size: tuple[int, int]) -> Camera | None:
    """A client's camera; None: not yet known. viser's axes are OpenCV's, its field of view is vertical."""
    wide, high = size
    try:
        turn = rotation_matrices(np.array([handle.wxyz], np.float64))[0].astype(np.float64)
        position, fov = np.array(handle.position, np.float64), float(handle.fov)
    except (AssertionError, AttributeError):
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
