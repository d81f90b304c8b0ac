"""The furnaces of benchmark=tracing: the file of balls, their brightness by each way, rows."""

import numpy as np
import pytest

from eval.tracing import furnace
from eval.tracing.furnace import (
    FINEST,
    MATERIALS,
    PREVIEW,
    SIDE,
    Furnace,
    Material,
    bowl,
    disk_mean,
    furnace_rows,
    place,
    price,
    write_balls,
)

pytestmark = pytest.mark.usefixtures("variant")
FEW = [Material(1.0, 1.0, 1.0), Material(1.0, 0.0, 0.2), Material(0.5, 1.0, 0.7), Material(0.2, 0.5, 0.05)]


@pytest.fixture(scope="module")
def few(tmp_path_factory: pytest.TempPathFactory, variant: str) -> Furnace:
    path = tmp_path_factory.mktemp("balls") / "balls.glb"
    write_balls(path, FEW)
    return Furnace.read(path, seed=3)


def test_the_file_holds_each_material_at_its_place(few: Furnace):
    for number, (material, ball) in enumerate(zip(FEW, few.balls, strict=True)):
        np.testing.assert_allclose(ball.base_color, material.base_color, rtol=1e-6)
        assert (ball.metallic, ball.roughness) == pytest.approx(material[1:])
        away = ball.vertices - place(number)
        np.testing.assert_allclose(np.linalg.norm(away, axis=1), 1, atol=1e-4)


def test_the_mean_is_of_the_disk_alone():
    y, x = (np.mgrid[:SIDE, :SIDE] + 0.5) / SIDE * 2 - 1
    edge = np.hypot(x, y) < 0.8
    assert disk_mean(np.where(edge[..., None], 0.5, np.nan) * np.ones(3)) == pytest.approx(0.5)
    assert disk_mean(np.where(np.hypot(x, y) > 0.95, 9.0, 0.25)[..., None] * np.ones(3)) == 0.25


def test_a_bowl_is_a_quarter_of_a_sphere_seen_from_within(few: Furnace):
    made = bowl(few.balls[0])
    corners = made.vertices[made.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.linalg.norm(cross, axis=1).sum() / 2 == pytest.approx(np.pi, rel=0.02)
    assert (np.einsum("nk,nk->n", cross, corners.mean(1)) < 0).all()
    assert (np.einsum("nk,nk->n", cross, made.normals[made.faces[:, 0]]) > 0).all()


def test_every_way_finds_the_same_brightness(few: Furnace, monkeypatch: pytest.MonkeyPatch):
    """0.33 of the first, 0.35 of the third with Mitsuba's ``principled``; Cycles has 0.418 of the third."""
    monkeypatch.setattr(furnace, "PATHS", 64)
    monkeypatch.setattr(furnace, "SPACING", 0.1)
    truth = few.by_paths()
    np.testing.assert_allclose(truth, [1, 1, 0.418, 0.2336], rtol=0.01)
    for found in (few.by_surfels(PREVIEW), few.by_surfels(FINEST), few.by_mesh(), few.by_harmonics()):
        np.testing.assert_allclose(found, truth, rtol=0.02)


def test_white_bowls_lose_no_light_but_where_few_rays_are_a_ratio(few: Furnace):
    white = Furnace(few.balls[:2], seed=3)
    np.testing.assert_allclose(white.by_bounces(), 1, atol=0.03)


def test_the_worst_are_the_worst_of_white_and_of_what_is_not():
    even = {way: [each.base_color for each in MATERIALS] for way in ("truth", "preview", "final", "cycles")}
    even["truth"][0], even["preview"][-1] = 0.97, 0.21
    rows = {row.metric: row.value for row in furnace_rows(even | {"bowl": [1.02] * 18})}
    assert rows["furnace.worst"] == rows["furnace.worst.truth"] == pytest.approx(0.03)
    assert rows["furnace.worst.bowl"] == pytest.approx(0.02)
    assert rows["furnace.cycles_worst"] == rows["furnace.cycles_worst.preview"] == pytest.approx(0.05)
    assert rows["furnace.cycles.50_100_38"] == 0.5
    assert "furnace.bowl.50_0_0" not in rows


def test_both_materials_are_timed_alike():
    times = price(2, side=16, paths=2)
    assert {name: len(each.seconds) for name, each in times.items()} == {
        "metallicroughness": 2,
        "principled": 2,
    }
