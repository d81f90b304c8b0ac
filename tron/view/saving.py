"""The panel that saves: pictures, the scene with its edits, and what tron-relight needs to film a view.

What is saved is what the panel shows: where the studio still works on that, saving waits for it and says so.
Files have fixed names in one folder, with free numbers; nothing is replaced.
"""

from __future__ import annotations

import html
import json
import logging
import shlex
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import CancelledError
from pathlib import Path
from typing import Any

import viser

from tron.cameras import Camera
from tron.errors import TronError
from tron.io.images import write_image
from tron.storage import write_atomic
from tron.trajectories import turn_cameras
from tron.view.filming import FRAMES_PER_SECOND, Filming
from tron.view.stage import Wish
from tron.view.studio import Picture, Studio

log = logging.getLogger(__name__)

_WHOLE = "white-space:pre-wrap;overflow-wrap:anywhere;user-select:all;font:0.8em monospace;margin:0.3em 0.8em"


class Saving:
    """Buttons that save, and what they have saved.

    Args:
        server: that shows them.
        folder: that is written to; it need not exist.
        file: the scene's.
        offset: (3,) of the scene, for cameras.
        lights: files by name.
        filming: the path that was kept.
        studio: gives the studio, once it is there.
        look: the camera of a client, +z up; None: not yet known.
        picture: the client's picture of the wish and the view of the moment, which it waits for.
        say: a line for the user about what cannot be done.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        folder: Path,
        file: Path,
        offset: Any,
        lights: Mapping[str, Path],
        filming: Filming,
        studio: Callable[[], Studio],
        look: Callable[[viser.ClientHandle], Camera | None],
        picture: Callable[[viser.ClientHandle], Picture],
        say: Callable[[str], None],
    ) -> None:
        self._folder, self._file, self._offset = folder.absolute(), file.absolute(), offset
        self._lights, self._filming, self._studio = lights, filming, studio
        self._look, self._picture, self._say = look, picture, say
        self._one = threading.Lock()
        gui = server.gui
        with gui.add_folder("Save", expand_by_default=False):
            buttons = gui.add_button_group("Save", ("Picture", "Scene", "Film"))
            self._said = gui.add_html("")
        self._tell(f"into {self._folder}")
        buttons.on_click(lambda event: event.client and self.save(event.target.value, event.client))

    def save(self, what: str, client: viser.ClientHandle) -> None:
        """Save "Picture", "Scene" or "Film", as it is after the wish of the moment."""
        wish = self._studio().wished
        self._tell(
            f"{what.lower()}: waits until {'the picture is' if what == 'Picture' else 'edits are'} done"
        )
        try:
            with self._one:
                if what == "Picture":
                    told = str(self._save_picture(self._picture(client)))
                elif what == "Scene":
                    told = "\n".join(map(str, self._save_scene(wish)))
                else:
                    told = self._film(wish, client)
        except CancelledError:  # the window or its page closes
            self._tell(f"{what.lower()}: not saved")
            return
        except (TronError, OSError) as error:
            self._tell(f"{what.lower()}: not saved")
            self._say(str(error))
            return
        self._tell(told)

    def path(self, name: str, suffix: str) -> Path:
        """A file that is not there yet."""
        self._folder.mkdir(parents=True, exist_ok=True)
        numbers = (f"{name}-{n:03d}{suffix}" for n in range(1, 1_000_000))
        return next(path for each in numbers if not (path := self._folder / each).exists())

    def _tell(self, text: str) -> None:
        self.told = text
        self._said.content = f'<pre style="{_WHOLE}">{html.escape(text)}</pre>'

    def _save_picture(self, picture: Picture) -> Path:
        path = self.path("picture", ".png")
        write_image(path, picture.image)
        return path

    def _save_scene(self, wish: Wish, hidden: frozenset[int] = frozenset()) -> list[Path]:
        """The scene of a wish without what is hidden, and the edits that made it where there are any."""
        scene, edits = self._studio().ask(lambda stage: (stage.without(hidden), stage.session.edits)).result()
        if tuple(edits.edits) != wish.edits:
            raise TronError("the edits have changed while it waited", mend="press it again")
        path = self.path("scene", ".ply")
        scene.save(path)
        if not edits.edits:
            return [path]
        listed = self.path("edits", ".yaml")
        edits.write(listed)
        return [path, listed]

    def _film(self, wish: Wish, client: viser.ClientHandle) -> str:
        """Save what tron-relight needs to film the path, or the view; its command line."""
        studio, scene, path = self._studio(), self._file, self._filming.path()
        camera = self._look(client)
        turn, exposure = studio.ask(
            lambda stage: (stage.turn, stage.exposure(wish.light, wish.stops))
        ).result()
        if camera is None and not path:
            raise TronError("the view is not known yet")
        if wish.edits or wish.hidden:
            scene = self._save_scene(wish, wish.hidden)[0]
        file = self.path("path" if path else "view", ".json")
        cameras = turn_cameras(path or [camera], turn.T)  # pyright: ignore[reportArgumentType]
        content = {"offset": self._offset.tolist(), "cameras": [each.to_dict() for each in cameras]}
        write_atomic(file, json.dumps(content, indent=1) + "\n")
        words = [
            *("tron-relight", f"scene={scene}", f"environment={self._lights[wish.light].absolute()}"),
            *(f"rotation={wish.turn:g}", f"exposure={exposure:.4g}", f"cameras={file}"),
            *(f"quality={wish.quality}", f"width={cameras[0].width}", f"height={cameras[0].height}"),
            *([f"fps={FRAMES_PER_SECOND}"] if path else []),
            f"output_dir={file.with_suffix('')}",
        ]
        line = " ".join(map(shlex.quote, words))
        log.info("%s", line)
        return line
