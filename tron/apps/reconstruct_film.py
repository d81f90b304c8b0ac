"""Films of a reconstruction under the showcase lights, from where it was photographed."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tron.apps.framing import find_subject, plan_cameras, turn_cameras, upright
from tron.apps.lit_scene import LitScene
from tron.apps.relight_settings import QUALITY
from tron.apps.showcase import showcase_lights
from tron.cameras import Camera
from tron.captures import Capture
from tron.cli.progress import track
from tron.color import to_display
from tron.gaussians.scene import GaussianScene
from tron.seeds import integer
from tron.shading.guidance import Lighting, render_guidance
from tron.trajectories import keyframed
from tron.video import VideoWriter

FOV_DEG = 40.0
GAP_DEG = 100.0
"""Widest angle without photos that an orbit may pass."""
STOPS = 7
"""Most photos that a path from photo to photo goes through."""
FPS = 12


def showcase_films(scene: GaussianScene, capture: Capture, frames: int, side: int) -> dict[str, bytes]:
    """Name of each showcase light -> an MP4 of the scene in it, ``side`` x ``side`` pixels, that loops."""
    turn = upright(scene.up)
    cameras = turn_cameras(film_cameras(scene, capture, frames, side), turn)
    estimation = QUALITY["preview"]
    lit = LitScene(scene.rotated(turn), cameras[0], estimation, integer(0, "report", "bounces"))
    films = {}
    for name, light in showcase_lights().items():
        lighting, exposure, pictures = Lighting(light), light.exposure(), []
        bounced = lit.bake(lighting)
        for number, camera in enumerate(track(cameras, f"report: {name}")):
            seed, bounce = integer(0, "report", number), bounced(camera)
            guidance = render_guidance(lit.tracer(camera), camera, lighting, estimation, seed, bounce=bounce)
            pictures.append(to_display(guidance.lit, exposure))
        films[name] = _film(pictures)
    return films


def film_cameras(scene: GaussianScene, capture: Capture, frames: int, side: int) -> list[Camera]:
    """Cameras from where the scene was photographed, in its world: all around it, or along the photos.

    All around where the photos leave no gap of more than GAP_DEG; else from photo to photo and back, because
    what nobody photographed is not there.
    """
    photographed = [view.camera for view in capture.views]
    centre = find_subject(scene).centre
    if _widest_gap(photographed, centre, scene.up) <= GAP_DEG:
        return plan_cameras(scene, "orbit", frames, width=side, height=side, fov_deg=FOV_DEG)
    stops = np.unique(np.linspace(0, len(photographed) - 1, STOPS).astype(int))
    forth = keyframed([_square(photographed[i], side) for i in stops], frames // 2 + 1)
    return [*forth, *forth[-2:0:-1]]


def _widest_gap(cameras: Sequence[Camera], centre: np.ndarray, up: np.ndarray) -> float:
    """Widest angle about ``up`` through ``centre`` in which no camera stands, degrees."""
    offsets = (np.stack([camera.position for camera in cameras]) - centre) @ upright(up).T
    azimuths = np.sort(np.degrees(np.arctan2(offsets[:, 1], offsets[:, 0])))
    return float(np.diff([*azimuths, azimuths[0] + 360]).max())


def _square(camera: Camera, side: int) -> Camera:
    """A camera at the same place whose square picture holds no more than the narrower way of the photo."""
    focal = side * max(camera.fx / camera.width, camera.fy / camera.height)
    return Camera(focal, focal, side / 2, side / 2, side, side, camera.world_to_camera)


def _film(frames: Sequence[np.ndarray]) -> bytes:
    height, width = frames[0].shape[:2]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        with VideoWriter(path, FPS, (width, height)) as film:
            for frame in frames:
                film.write(frame)
        return path.read_bytes()
