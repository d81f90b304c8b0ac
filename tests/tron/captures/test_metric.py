"""The size of a capture in metres: from a distance that is known, or from GPS."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tron.captures import LoadSettings, load_capture
from tron.captures.metric import earth_centred
from tron.errors import TronError
from tron.seeds import generator

PLACE = 47.3, -122.2, 60.0
UNIT = 7.5
"""Metres of one unit of the poses: the cameras' arc is some 60 m across."""


def degrees_of(east_north_up: np.ndarray) -> np.ndarray:
    """Latitude, longitude, height some metres from PLACE, by the radii of curvature there (not by ECEF)."""
    e2 = (1 / 298.257223563) * (2 - 1 / 298.257223563)
    sine = np.sin(np.radians(PLACE[0]))
    meridian = 6_378_137.0 * (1 - e2) / (1 - e2 * sine**2) ** 1.5
    across = 6_378_137.0 / np.sqrt(1 - e2 * sine**2) * np.cos(np.radians(PLACE[0]))
    east, north, up = east_north_up.T
    return np.stack(
        [PLACE[0] + np.degrees(north / meridian), PLACE[1] + np.degrees(east / across), PLACE[2] + up], axis=1
    )


def with_gps(folder: Path, photos, write, noise: float = 0.0, outlier: bool = False) -> None:
    """A transforms.json whose photos are JPEGs with GPS to a ten-thousandth of a second."""
    content = write.transforms(photos)
    turn = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]])
    shaken = generator(0, "gps").normal(0, 1, (len(photos.names), 3)) * noise
    places = UNIT * photos.opengl[:, :3, 3] @ turn.T + shaken
    if outlier:
        places[3] += 400
    (folder / "images").mkdir()
    for n, (frame, at) in enumerate(zip(content["frames"], degrees_of(places))):
        frame["file_path"] = f"images/{n:02d}.jpg"
        exif = Image.Exif()
        height = {5: bytes([int(at[2] < 0)]), 6: abs(float(at[2]))}
        angles = {1: "N", 2: _sexagesimal(at[0]), 3: "W", 4: _sexagesimal(-at[1])}
        exif.get_ifd(0x8825).update({**angles, **height})
        Image.fromarray(write.picture(n)).save(folder / "images" / f"{n:02d}.jpg", exif=exif)
    write.json(folder / "transforms.json", content)


def _sexagesimal(value: float) -> tuple[float, float, float]:
    whole, minutes = int(value), value % 1 * 60
    return float(whole), float(int(minutes)), round(minutes % 1 * 60, 4)


def size_of(capture) -> float:
    positions = np.array([view.camera.position for view in capture.views])
    return float(np.linalg.norm(positions[0] - positions[-1]))


@pytest.mark.parametrize("noise, outlier, close", [(0, False, 1e-3), (2.0, False, 0.1), (0.5, True, 0.05)])
def test_gps_tells_the_size(tmp_path: Path, photos, write, noise: float, outlier: bool, close: float):
    with_gps(tmp_path, photos, write, noise, outlier)
    plain, metric = load_capture(tmp_path), load_capture(tmp_path, LoadSettings(scale="gps"))
    assert size_of(metric) / size_of(plain) == pytest.approx(UNIT, rel=close)
    factor = np.linalg.norm(metric.transform[:3, 0])
    for view, other in zip(metric.views, plain.views):
        np.testing.assert_allclose(view.camera.position, factor * other.camera.position, atol=1e-9)
        np.testing.assert_allclose(view.camera.forward, other.camera.forward, atol=1e-12)


def test_two_cameras_tell_the_size_and_points_go_along(tmp_path: Path, photos, write):
    write.colmap(tmp_path / "sparse" / "0", photos, text=False)
    write.photos(tmp_path / "images", photos)
    apart = np.linalg.norm(photos.opengl[0, :3, 3] - photos.opengl[4, :3, 3])
    capture = load_capture(tmp_path, LoadSettings(scale=(photos.names[0], "photo_04", 3 * float(apart))))
    np.testing.assert_allclose(
        [view.camera.position for view in capture.views], 3 * photos.opengl[:, :3, 3], atol=1e-9
    )
    for index, view in enumerate(capture.views):
        assert np.abs(view.camera.project(3 * photos.points)[0] - photos.pixels(index)).max() < 1e-3
    assert capture.points is not None
    nearest = np.linalg.norm(capture.points[:, None] - 3 * photos.points[None], axis=-1).min(1)
    assert nearest.max() < 1e-4


def test_what_tells_no_size_is_one_line(tmp_path: Path, photos, write):
    with_gps(tmp_path, photos, write, noise=200.0)
    with pytest.raises(TronError, match="tells no scale"):
        load_capture(tmp_path, LoadSettings(scale="gps"))
    with pytest.raises(TronError, match="no photo of the name x"):
        load_capture(tmp_path, LoadSettings(scale=("x", "01", 2.0)))
    (tmp_path / "bare").mkdir()
    write.json(tmp_path / "bare" / "transforms.json", write.transforms(photos))
    write.photos(tmp_path / "bare" / "images", photos)
    with pytest.raises(TronError, match="0 of 10 photos have GPS"):
        load_capture(tmp_path / "bare", LoadSettings(scale="gps"))


def test_the_ellipsoid_has_wgs84s_axes():
    found = earth_centred(np.array([[0, 0, 0], [90, 0, 0], [0, 90, 100.0]]))
    np.testing.assert_allclose(found[0], (6_378_137, 0, 0), atol=1e-6)
    np.testing.assert_allclose(found[1], (0, 0, 6_356_752.3142), atol=1e-3)
    np.testing.assert_allclose(found[2], (0, 6_378_237, 0), atol=1e-6)
