"""Cells are halved where they blur, and surfels get their shape: laws on rectangles and stripes."""

import dataclasses

import numpy as np
import pytest

from tests.tron.gaussians.test_initialize import ring, view
from tron.gaussians import cells
from tron.gaussians.fields import FIELDS
from tron.gaussians.initialize import surfels_from_gbuffers
from tron.gaussians.samples import Samples
from tron.seeds import generator
from tron.tracing import SurfelTracer


def samples(points: np.ndarray, color: np.ndarray | float = 0.5) -> Samples:
    """Samples of a plane z = 0, seen from above."""
    number = len(points)
    values = {
        "position": points,
        "normal": np.tile([0.0, 0.0, 1.0], (number, 1)),
        "base_color": np.broadcast_to(np.reshape(color, (-1, 1)), (number, 3)),
        "roughness": np.full((number, 1), 0.5),
        "metallic": np.zeros((number, 1)),
    }
    values = {name: np.ascontiguousarray(value, np.float32) for name, value in values.items()}
    return Samples(values, np.ones(number), np.zeros(number, np.int64))


def flat(number: int, *key: str) -> np.ndarray:
    """(N, 3) points of the square (0, 1)^2 at z = 0."""
    return np.pad(generator(0, "test", *key).random((number, 2)), ((0, 0), (0, 1)))


def quarters(points: np.ndarray, side: int = 4) -> np.ndarray:
    """(N,) number of each point's cell in a grid of side x side."""
    column, row = np.minimum((points[:, :2] * side).astype(int), side - 1).T
    return side * row + column


def within(cell: np.ndarray, value: np.ndarray) -> float:
    """Sum of squared differences from the cells' means."""
    held = np.bincount(cell)
    return float((value**2).sum() - (np.bincount(cell, value) ** 2 / held).sum())


def test_halvings_go_where_the_colour_varies_and_across_its_change():
    points = flat(20_000, "halves")
    grid = quarters(points)
    # The cell in the corner is dark on its left half, all others are even.
    dark = (grid == 0) & (points[:, 0] < 0.125)
    given = samples(points, np.where(dark, 0.1, 0.5))
    found = cells.halved(given, grid, 17)
    assert found.max() + 1 == 17
    halves = np.unique(found[grid == 0])
    assert len(halves) == 2, "the cell in the corner, no other"
    means = [points[found == half].mean(axis=0) for half in halves]
    assert abs(means[0][0] - means[1][0]) == pytest.approx(0.125, abs=0.01)
    assert abs(means[0][1] - means[1][1]) < 0.01


def test_halvings_save_more_than_a_finer_grid_of_as_many_cells():
    points = flat(60_000, "stripes")
    # Lines half as wide as a cell in one half; nothing to see in the other.
    lines = (points[:, 0] > 0.5) & (points[:, 0] * 7.3 % 1 < 0.2)
    given = samples(points, np.where(lines, 0.05, 0.6))
    shown = np.where(lines, 0.05, 0.6)
    found = cells.halved(given, quarters(points, 16), 400)
    assert np.array_equal(np.unique(found), np.arange(400))
    assert within(found, shown) < 0.7 * within(quarters(points, 20), shown)


def test_halves_are_no_slivers_and_never_empty():
    points = flat(5_000, "slivers") * [1.0, 0.1, 1.0]
    # What varies across the short side cannot be halved there, nor across the plane, which has no depth.
    given = samples(points, points[:, 1] * 5)
    found = cells.halved(given, np.zeros(len(points), int), 2)
    np.testing.assert_allclose([points[found == k, 0].mean() for k in (0, 1)], [0.25, 0.75], atol=0.02)
    assert np.bincount(cells.halved(given, np.zeros(len(points), int), 10_000)).min() > 0


@pytest.mark.parametrize("turn_deg", [0.0, 30.0])
def test_a_surfel_is_as_long_and_as_wide_as_its_samples(turn_deg):
    length, width = 0.3, 0.12
    angle = np.radians(turn_deg)
    along, across = np.array([np.cos(angle), np.sin(angle), 0]), np.array([-np.sin(angle), np.cos(angle), 0])
    x, y, _ = flat(20_000, "rectangle").T - 0.5
    given = samples(np.outer(x * length, along) + np.outer(y * width, across))
    cell = np.zeros(len(x), int)
    frames, sides = cells.axes(given, cell, given.merged(cell), np.array([0.2]))
    np.testing.assert_allclose(sides, [[length, width]], rtol=0.02)
    assert abs(frames[0, :, 0] @ along) > 0.999
    np.testing.assert_allclose(frames[0, :, 2], [0, 0, 1], atol=1e-6)
    assert np.linalg.det(frames[0]) == pytest.approx(1)


def test_four_samples_say_as_much_as_their_pixels_and_fewer_nothing():
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    for number, expected in ((4, 2.0), (3, 1.7)):
        given = samples(corners[:number])
        cell = np.zeros(number, int)
        _, sides = cells.axes(given, cell, given.merged(cell), np.array([1.7]))
        np.testing.assert_allclose(sides, [[expected, expected]])


def striped(seen):
    """A view whose floor has fine dark lines on one side of the ball."""
    x = seen.position[..., 0]
    lines = (x > 0) & (x * 12 % 1 < 0.3) & (seen.object_id == 3)
    return dataclasses.replace(seen, base_color=np.where(lines[..., None], 0.05, seen.base_color))


def error(scene, seen) -> float:
    found = SurfelTracer(scene).gbuffer(seen.camera).numpy()
    return float(((found["base_color"] - seen.base_color)[seen.valid] ** 2).mean())


@pytest.fixture(scope="module")
def views():
    return [striped(seen) for seen in ring(size=192)]


def test_as_many_surfels_show_lines_better(views, variant):
    plain, fine = (surfels_from_gbuffers(views, count=4000, detail=detail) for detail in (False, True))
    assert len(fine) == pytest.approx(4000, rel=0.01)
    seen = striped(view((3, -2, 2), size=192))
    assert error(fine, seen) < 0.75 * error(plain, seen)
    holes = SurfelTracer(fine).gbuffer(seen.camera).numpy()["opacity"][seen.valid] < 0.5
    assert holes.mean() < 0.01
    np.testing.assert_allclose(fine.means[fine.object_id == 3, 2], 0, atol=1e-6)


def test_the_order_of_views_does_not_matter_to_detail(views):
    one, other = (surfels_from_gbuffers(each, count=4000, detail=True) for each in (views, views[::-1]))
    for name in FIELDS:
        mine, theirs = getattr(one, name), getattr(other, name)
        if name == "quats":  # a square's sides have no direction
            mine, theirs = one.normals(), other.normals()
        np.testing.assert_allclose(mine, theirs, atol=1e-4)
