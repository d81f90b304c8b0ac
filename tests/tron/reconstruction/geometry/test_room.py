"""Laws of a room's bounds: what no photo shows is closed, and so is what one shows dark; windows are open.

A window is what moves over the bounds as cameras do, or is white in photos; a white ceiling is none.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tron.cameras import Camera
from tron.captures import View
from tron.captures.view import decoded, encoded
from tron.color import srgb_to_linear
from tron.gaussians import GaussianScene
from tron.gaussians.harmonics import SH_C0
from tron.reconstruction.geometry import room as rooms
from tron.reconstruction.geometry.room import bounds_of
from tron.seeds import generator
from tron.tracing import SurfelTracer

WINDOW = 0.3


def room(dense: Any, ceiling: bool, window: bool = True) -> GaussianScene:
    """The inside of the cube of side 2 about the origin, with a window in the wall at x = 1."""
    box = dense.box(half=1.0)
    kept = ~(through_the_window(box.points) & window)
    if not ceiling:
        kept &= box.points[:, 2] < 0.99
    sheet = type(box)(box.points[kept], -box.normals[kept], box.mitsuba)
    return dense.scene(sheet)


GREY, DULL, SKY, WHITE = 0.5, 0.75, 0.98, 1.0
"""Display values of the walls, as surfels are made, of what is 2.4 and 4.5 times as bright, of white."""


def closed_indoors(*args: Any) -> GaussianScene:
    return rooms.closed_indoors(*args).scene


def outdoors(rays: np.ndarray) -> np.ndarray:
    """(N,) display values far outside, by directions (N, 3): a house before half of the sky."""
    return np.where(rays[:, 1] > 0.05 * np.abs(rays[:, 0]), SKY, DULL)


def through_the_window(points: np.ndarray) -> np.ndarray:
    """(N,) bool of points (N, 3) on the cube's faces."""
    x, y, z = points.T
    return (x > 0.99) & (np.abs(y) < WINDOW) & (np.abs(z) < WINDOW)


def picture(camera: Camera, shown: dict[Any, Any]) -> np.ndarray:
    """What a camera within the empty cube sees of its faces: display values by where rays leave it.

    Or functions of the rays.
    """
    rays = camera.rays().reshape(-1, 3)
    way = ((np.sign(rays) - camera.position) / rays).min(1)
    left = camera.position + way[:, None] * rays
    image = np.full((len(rays), 3), GREY, np.float32)
    for where, value in shown.items():
        there = where(left)
        image[there] = np.asarray(value(rays[there]))[:, None] if callable(value) else value
    return image.reshape(camera.height, camera.width, 3)


def photographed(shown: dict[Any, Any]) -> list[View]:
    """From a circle at half the height, across the room; the ceiling is above all of them."""
    views = []
    for i in range(10):
        eye = 0.6 * np.array([np.cos(0.2 * np.pi * i), np.sin(0.2 * np.pi * i), 0.0])
        camera = Camera.look_at(eye, (0, 0, 0), fov_deg=50, width=40, height=40)
        views.append(View(str(i), camera, picture(camera, shown), "display"))
    return views


@pytest.fixture(scope="module")
def photos() -> list[View]:
    return photographed({through_the_window: WHITE})


def painted(scene: GaussianScene, where: np.ndarray, display: float) -> GaussianScene:
    """The scene whose surfels show a grey there."""
    sh = scene.sh.copy()
    sh[where, 0] = (display - 0.5) / SH_C0
    return replace(scene, sh=sh)


def light_from(scene: GaussianScene, targets: np.ndarray) -> np.ndarray:
    """Transmittance (N,) from the middle of the room towards points (N, 3)."""
    ways = targets / np.linalg.norm(targets, axis=1, keepdims=True)
    start = mi.Point3f(*(dr.zeros(mi.Float, len(ways)) for _ in range(3)))
    return SurfelTracer(scene).transmittance(start, mi.Vector3f(ways.T.astype(np.float32))).numpy()


def around_the_origin() -> list[View]:
    views = []
    for i in range(6):
        turn = np.pi / 3 * i
        eye = (2 * np.cos(turn), 2 * np.sin(turn), 0)
        camera = Camera.look_at(eye, (0, 0, 0), fov_deg=5, width=8, height=8)
        views.append(View(str(i), camera, np.zeros((8, 8, 3), np.float32), "display"))
    return views


def _some(value: Any, kept: np.ndarray) -> Any:
    return value[kept] if isinstance(value, np.ndarray) and len(value) == len(kept) else value


def over(low: tuple[float, ...], high: tuple[float, ...], count: int = 2000) -> np.ndarray:
    return generator(0, "tests", "targets").uniform(low, high, (count, 3))


def test_a_ceiling_that_no_photo_shows_lets_no_light_in(dense_surfels, photos: list[View]) -> None:
    found = room(dense_surfels, ceiling=False)
    closed = closed_indoors(found, photos, True, 0)
    above = over((-0.95, -0.95, 1), (0.95, 0.95, 1))
    assert light_from(found, above).min() > 0.9
    assert light_from(closed, above).mean() < 0.01
    new = slice(len(found), None)
    assert len(closed) > len(found)
    assert np.array_equal(closed.means[: len(found)], found.means)
    assert (np.einsum("mi,mi->m", closed.normals()[new], closed.means[new]) < 0).all(), "not inwards"
    closed.validate()


def test_new_surfels_have_the_colours_near_by(dense_surfels, photos: list[View]) -> None:
    """Red walls where x is negative, green ones where it is not."""
    found = room(dense_surfels, ceiling=False)
    right = found.means[:, 0] > 0
    found.base_color[:] = np.where(right[:, None], (0.1, 0.8, 0.1), (0.8, 0.1, 0.1))
    found.sh[:, 0] = found.base_color
    closed = closed_indoors(found, photos, True, 0)
    new = np.arange(len(found), len(closed))
    far = new[np.abs(closed.means[new, 0]) > 0.7]
    wanted = np.where(closed.means[far, :1] > 0, (0.1, 0.8, 0.1), (0.8, 0.1, 0.1))
    assert len(far) > 100
    for given in (closed.base_color, closed.sh[:, 0]):
        near_by = np.isclose(given[far], wanted, atol=1e-5).all(1)
        assert near_by.mean() > 0.97, "a few photos look at the ceiling's edge"


def test_strays_outside_do_not_move_the_ceiling(dense_surfels, photos: list[View]) -> None:
    found = room(dense_surfels, ceiling=False)
    found.means[:10] += np.array([0, 0, 4], np.float32)
    closed = closed_indoors(found, photos, True, 0)
    assert len(closed) > len(found)
    assert closed.means[len(found) :, 2].max() < 1.2


def test_a_window_that_photos_show_stays_open(dense_surfels, photos: list[View]) -> None:
    """To its edge, which the surfels of the wall blur by half a spacing."""
    within = 0.9 * WINDOW
    window = over((1, -within, -within), (1, within, within))
    found = room(dense_surfels, ceiling=False)
    closed = closed_indoors(found, photos, True, 0)
    assert light_from(found, window).mean() - light_from(closed, window).mean() < 0.01
    assert light_from(closed, window).mean() > 0.95


def test_a_window_beside_what_is_closed_stays_open(dense_surfels) -> None:
    """A slit from floor to ceiling, whose middle photos show: surfels that close its ends leave it open."""

    def slit(points: np.ndarray) -> np.ndarray:
        return (points[:, 0] > 0.99) & (np.abs(points[:, 1]) < WINDOW)

    found = room(dense_surfels, ceiling=True)
    kept = ~slit(found.means)
    found = GaussianScene(**{f.name: _some(getattr(found, f.name), kept) for f in fields(GaussianScene)})
    closed = closed_indoors(found, photographed({slit: WHITE}), True, 0)
    shown = over((1, -0.9 * WINDOW, -0.65), (1, 0.9 * WINDOW, 0.65))
    assert len(closed) > len(found)
    assert light_from(closed, shown).mean() > 0.95


def sealed(dense: Any) -> GaussianScene:
    """The closed cube, whose surfels show the sky where its window is."""
    found = room(dense, ceiling=True, window=False)
    return painted(found, through_the_window(found.means), DULL)


def _rows(points: np.ndarray) -> set[tuple[float, ...]]:
    return set(map(tuple, points.tolist()))


@pytest.mark.parametrize("gain", [0.6, 1.0, 2.1])
def test_sky_that_surfels_show_in_a_window_is_taken_out(dense_surfels, gain: float) -> None:
    """A house outside, however photos are exposed: as they are, walls or windows may pass for the other."""
    found = sealed(dense_surfels)
    exposed = [
        replace(view, image=encoded(gain * decoded(view.read(), "srgb"), "srgb"))
        for view in photographed({through_the_window: outdoors})
    ]
    closed = closed_indoors(found, exposed, True, 0)
    within = 0.8 * WINDOW
    assert light_from(found, over((1, -within, -within), (1, within, within))).max() < 0.1
    assert light_from(closed, over((1, -within, -within), (1, within, within))).mean() > 0.95
    clear = np.abs(found.means - (1, 0, 0)).max(1) > 1.3 * WINDOW
    assert _rows(found.means[clear]) <= _rows(closed.means), "a wall is gone"


def test_the_sun_on_a_floor_and_a_lamp_are_no_windows(dense_surfels) -> None:
    """A floor as bright as what is outside the window; a white ball in the middle of the room."""

    def sunny(points: np.ndarray) -> np.ndarray:
        return (points[:, 2] < -0.99) & (np.abs(points[:, :2]) < 0.5).all(1)

    box, lamp = dense_surfels.box(half=1.0), dense_surfels.sphere(radius=0.12)
    kept = ~through_the_window(box.points)
    found = dense_surfels.scene(type(box)(box.points[kept], -box.normals[kept], box.mitsuba), lamp)
    bright = sunny(found.means) | (np.linalg.norm(found.means, axis=1) < 0.2)
    found, views = painted(found, bright, SKY), []
    for view in photographed({sunny: SKY}):
        eye = view.camera.position
        camera = Camera.look_at(eye, (-eye[0], -eye[1], -0.8), fov_deg=80, width=40, height=40)
        image = picture(camera, {sunny: SKY, through_the_window: SKY})
        image[SurfelTracer(found).gbuffer(camera).numpy()["depth"] < 0.75] = SKY
        views.append(View(view.name, camera, image, "display"))
    closed = closed_indoors(found, views, True, 0)
    assert _rows(found.means) <= _rows(closed.means)


def upper(points: np.ndarray) -> np.ndarray:
    return points[:, 2] > 0.99


def far_wall(points: np.ndarray) -> np.ndarray:
    return points[:, 0] > 0.99


def patch(points: np.ndarray) -> np.ndarray:
    return far_wall(points) & (np.abs(points[:, 1:]) < 0.4).all(1)


def all_around(shown: dict[Any, Any]) -> list[View]:
    """From a circle, level and upwards: photos show the ceiling too."""
    views = photographed(shown)
    for view in photographed(shown):
        eye = view.camera.position
        camera = Camera.look_at(eye, (-eye[0], -eye[1], 0.9), fov_deg=80, width=40, height=40)
        views.append(View("up" + view.name, camera, picture(camera, shown), "display"))
    return views


@pytest.mark.parametrize(("where", "display"), [(upper, DULL), (far_wall, DULL), (patch, SKY)])
def test_a_white_ceiling_a_white_wall_and_the_sun_on_a_wall_are_no_windows(
    dense_surfels, caplog: pytest.LogCaptureFixture, where: Any, display: float
) -> None:
    """As bright as windows are, but on the walls in all photos, and not white in them."""
    found = room(dense_surfels, ceiling=True, window=False)
    found = painted(found, where(found.means), display)
    closed = closed_indoors(found, all_around({where: display}), True, 0)
    assert _rows(found.means) <= _rows(closed.means)
    assert "taken for white walls" in caplog.text


@pytest.mark.long
def test_a_window_in_a_white_wall_is_opened_alone(dense_surfels) -> None:
    """A white sky; the wall around it is 2.4 times as bright as the others."""
    found = room(dense_surfels, ceiling=True, window=False)
    found = painted(found, far_wall(found.means), DULL)
    found = painted(found, through_the_window(found.means), WHITE)
    closed = closed_indoors(found, all_around({far_wall: DULL, through_the_window: WHITE}), True, 0)
    within = 0.8 * WINDOW
    assert light_from(closed, over((1, -within, -within), (1, within, within))).mean() > 0.95
    clear = np.abs(found.means - (1, 0, 0)).max(1) > 1.3 * WINDOW
    assert _rows(found.means[clear]) <= _rows(closed.means), "a wall is gone"


@pytest.mark.long
def test_a_wall_that_is_overexposed_is_no_window(dense_surfels, caplog: pytest.LogCaptureFixture) -> None:
    """All of it but its edge, white in photos; sky masks, if there are, say that it is a glass front."""
    found = room(dense_surfels, ceiling=True, window=False)
    found, views = painted(found, far_wall(found.means), WHITE), all_around({far_wall: WHITE})
    closed = closed_indoors(found, views, True, 0)
    inner = far_wall(found.means) & (np.abs(found.means[:, 1:]) < 0.75).all(1)
    assert _rows(found.means[inner]) <= _rows(closed.means)
    assert light_from(closed, over((1, -0.75, -0.75), (1, 0.75, 0.75))).mean() < 0.01
    assert "sky_mask" in caplog.text
    masked = [replace(view, sky_mask=(view.read().min(-1) > 0.99).astype(np.float32)) for view in views]
    front = rooms.closed_indoors(found, masked, True, 0)
    assert light_from(front.scene, over((1, -0.7, -0.7), (1, 0.7, 0.7))).mean() > 0.95
    assert front.opened > 0.6 * far_wall(found.means).sum()


def test_a_hole_that_photos_show_dark_is_closed_in_their_colour(dense_surfels) -> None:
    """Where surfels were not found, though photos have it in their pictures."""
    color = np.array([0.55, 0.4, 0.3])
    found = room(dense_surfels, ceiling=True)
    closed = closed_indoors(found, photographed({through_the_window: tuple(color)}), True, 0)
    within = 0.8 * WINDOW
    assert light_from(closed, over((1, -within, -within), (1, within, within))).mean() < 0.05
    new = np.arange(len(found), len(closed))
    inner = new[(np.abs(closed.means[new, 1:]) < 0.6 * WINDOW).all(1) & (closed.means[new, 0] > 0.9)]
    assert len(inner) > 20
    np.testing.assert_allclose(np.median(closed.base_color[inner], 0), srgb_to_linear(color), atol=0.02)
    np.testing.assert_allclose(np.median(SH_C0 * closed.sh[inner, 0] + 0.5, 0), color, atol=0.02)


def test_a_window_that_no_photo_shows_is_taken_for_a_wall(dense_surfels, photos: list[View]) -> None:
    """Nobody can know: the photos that look at it are those from the other side of the room."""
    away = [view for view in photos if view.camera.forward[0] < 0.2]
    assert 2 < len(away) < len(photos)
    closed = closed_indoors(room(dense_surfels, ceiling=True), away, True, 0)
    within = 0.8 * WINDOW
    assert light_from(closed, over((1, -within, -within), (1, within, within))).mean() < 0.05


def test_a_room_that_is_closed_stays_as_it_is(dense_surfels, photos: list[View]) -> None:
    found = room(dense_surfels, ceiling=True)
    closed = closed_indoors(found, photos, True, 0)
    assert len(closed) - len(found) < 20, "of 20,000 places asked"


def test_photos_from_without_are_told_of(dense_surfels, caplog: pytest.LogCaptureFixture) -> None:
    ball = dense_surfels.scene(dense_surfels.sphere(radius=0.3))
    closed_indoors(ball, around_the_origin(), True, 0)
    assert "indoors=false" in caplog.text


def test_the_same_seed_gives_the_same_surfels(dense_surfels, photos: list[View]) -> None:
    found = room(dense_surfels, ceiling=False)
    one, other, another = (closed_indoors(found, photos, True, seed) for seed in (3, 3, 4))
    assert np.array_equal(one.means, other.means)
    assert not np.array_equal(one.means, another.means)


def test_photos_from_within_a_room_are_known(dense_surfels, photos: list[View]) -> None:
    """With a ceiling that none shows; and the same room closed where indoors says nothing."""
    found = room(dense_surfels, ceiling=False)
    bounds = bounds_of(found, photos, seed=0)
    assert bounds is not None
    assert bounds.around > 0.9
    assert 0.3 < bounds.over < 0.9
    assert bounds.overhead == 0
    assert bounds.room is True
    by_rule, asked = (closed_indoors(found, photos, indoors, 0) for indoors in ("auto", True))
    assert np.array_equal(by_rule.means, asked.means)
    assert closed_indoors(found, photos, False, 0) is found


def test_a_yard_whose_sky_photos_show_is_no_room(dense_surfels, photos: list[View]) -> None:
    """A blue sky, hardly brighter than the walls."""
    found = room(dense_surfels, ceiling=False)
    raised = []
    for view in photos:
        eye = view.camera.position
        camera = Camera.look_at(eye, (-eye[0], -eye[1], 1.5), fov_deg=90, width=20, height=20)
        image = picture(camera, {lambda points: points[:, 2] > 0.99: GREY + 0.05})
        raised.append(View("up" + view.name, camera, image, "display"))
    assert closed_indoors(found, photos + raised, "auto", 0) is found


def test_photos_of_what_is_no_room_are_not_read(dense_surfels) -> None:
    def unread() -> np.ndarray:
        raise AssertionError("a photo was read")

    views = [replace(view, image=unread) for view in around_the_origin()]
    ball = dense_surfels.scene(dense_surfels.sphere(radius=0.3))
    assert closed_indoors(ball, views, "auto", 0) is ball


def test_photos_of_a_room_are_read_once(dense_surfels, photos: list[View]) -> None:
    times = dict.fromkeys([view.name for view in photos], 0)

    def counted(view: View) -> View:
        def read() -> np.ndarray:
            times[view.name] += 1
            return np.asarray(view.image)

        return replace(view, image=read)

    closed_indoors(sealed(dense_surfels), [counted(view) for view in photos], True, 0)
    assert set(times.values()) == {1}


def test_a_thing_that_cameras_surround_is_no_room(dense_surfels) -> None:
    ball = dense_surfels.scene(dense_surfels.sphere(radius=0.3))
    assert closed_indoors(ball, around_the_origin(), "auto", 0) is ball


def test_a_room_with_one_wall_missing_is_asked_about(
    dense_surfels, photos: list[View], caplog: pytest.LogCaptureFixture
) -> None:
    """Two of four walls: nobody can tell a corner of a room from a house's; a mask says it is no room."""
    found = room(dense_surfels, ceiling=False)
    kept = found.means[:, 0] < 0.5
    found = GaussianScene(**{f.name: _some(getattr(found, f.name), kept) for f in fields(GaussianScene)})
    assert closed_indoors(found, photos, "auto", 0) is found
    assert "indoors=true" in caplog.text
    caplog.clear()
    masked = [replace(view, mask=np.ones((40, 40), np.float32)) for view in photos]
    assert closed_indoors(found, masked, "auto", 0) is found
    assert not caplog.text


def test_a_garden_filmed_from_above_is_asked_about(dense_surfels, caplog: pytest.LogCaptureFixture) -> None:
    """Ground and a hedge around it, no higher than 26 degrees; no photo looks up, so none shows a sky."""
    ground = dense_surfels.plane(0.12, 2.0)
    box = dense_surfels.box(0.12, half=2.0)
    hedge = (np.abs(box.normals[:, 2]) < 0.5) & (np.abs(box.points[:, 2]) < 0.9) & (box.points[:, 2] > 0)
    wall = type(box)(box.points[hedge], -box.normals[hedge], box.mitsuba)
    garden = dense_surfels.scene(ground, wall, spacing=0.12)
    views = []
    for i in range(8):
        eye = (0.8 * np.cos(0.25 * np.pi * i), 0.8 * np.sin(0.25 * np.pi * i), 0.5)
        camera = Camera.look_at(eye, (0, 0, 0), fov_deg=50, width=20, height=20)
        views.append(View(str(i), camera, np.full((20, 20, 3), 0.5, np.float32), "display"))
    bounds = bounds_of(garden, views, 0)
    assert bounds is not None
    assert bounds.around > 0.7
    assert closed_indoors(garden, views, "auto", 0) is garden
    assert "indoors=true" in caplog.text
