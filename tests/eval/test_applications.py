"""The benchmark `applications`: its worlds, its figures where answers are known, all of it at toy sizes."""

from pathlib import Path

import numpy as np
import pytest

from eval.applications import baking, harmonising, moving, selecting, viewing, worlds
from eval.applications.harmonising import METHODS, TRUTH, Composite, covered, harmonising_rows, inserted
from eval.applications.moving import QUALITIES, Film, motion_rows
from eval.applications.selecting import Clicked, Draw, selection_rows
from eval.applications.worlds import GROUND, draw_thing, draw_world, moved, surfels_of, view_of
from eval.cli import cli
from eval.results import Results
from tron.cameras import Camera
from tron.color import to_display
from tron.estimation import Estimation
from tron.metrics import psnr
from tron.relighting import Relighter
from tron.seeds import generator

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture(scope="module")
def world() -> worlds.World:
    return draw_world(1, "tests", 0, "sun")


@pytest.fixture(scope="module")
def camera() -> Camera:
    return view_of(generator(1, "tests", "view"), 64, 64)


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as end:
        cli(["benchmark=applications", *arguments])
    return int(end.value.code or 0)


def test_surfels_and_meshes_of_a_world_look_alike(world, camera):
    """Mitsuba's paths through the meshes and TRON's light on the surfels; under another light they differ."""
    scene, there = world.surfels(8000), world.surface(camera).number > 0
    assert sorted(np.unique(scene.object_id)) == [GROUND, GROUND + 1, GROUND + 2, GROUND + 3]
    exposure = world.light.exposure()
    truth = to_display(world.traced(camera, 64, 0), exposure)
    relighter = Relighter(scene, Estimation(rays=16), proxy="never")
    found = []
    for turn in (0.0, 90.0):
        lit = relighter.under(world.light.rotated(turn)).render(camera).lit
        found.append(psnr(to_display(lit, exposure), truth, there))
    assert found[0] > 25, found
    assert found[1] < found[0] - 5, found


def test_true_surfaces_are_those_of_the_parts(world, camera):
    seen = world.surface(camera)
    on_ground = seen.number == GROUND
    assert on_ground.any()
    np.testing.assert_allclose(seen.normal[on_ground], np.tile([0, 0, 1], (on_ground.sum(), 1)), atol=1e-5)
    points = camera.position + seen.depth * camera.rays()
    assert np.abs(points[on_ground][:, 2]).max() < 1e-4
    assert (points[seen.number > GROUND][:, 2] > -1e-4).all()
    assert (seen.depth[seen.number == 0] == 0).all()


def test_worlds_come_from_their_names_alone():
    one, again, other = (draw_world(1, "tests", n, "soft") for n in (5, 5, 6))
    np.testing.assert_array_equal(one.parts[1].vertices, again.parts[1].vertices)
    assert one.light.rotation_deg != other.light.rotation_deg


def test_what_is_inserted_stands_where_the_truth_has_it(world):
    """The mesh and the surfels of it, turned and put by two programs."""
    thing, at, turn = draw_thing(generator(3, "tests", "thing")), np.array([0.1, -0.05]), 35.0
    scene = inserted(world.surfels(4000), surfels_of([thing], 0.04, 0), at, turn)
    new = scene.means[scene.object_id == GROUND + 4]
    truth = moved(thing, (*at, 0.0), turn).vertices
    np.testing.assert_allclose(new.min(0), truth.min(0), atol=0.05)
    np.testing.assert_allclose(new.max(0), truth.max(0), atol=0.05)


def test_covered_shares_are_those_of_the_outline(world, camera):
    share = covered(world, camera)
    middle = world.surface(camera).number == GROUND + 3
    assert share[middle].mean() > 0.8
    assert ((share > 0) & (share < 1)).any()
    assert abs(share.sum() - middle.sum()) < 0.1 * middle.sum() + 4


def test_composites_are_judged_at_the_thing_and_its_light_alone():
    truth = np.full((8, 8, 3), 0.5)
    thing, cast = np.zeros((2, 8, 8), bool)
    thing[2:4], cast[4:6] = True, True
    elsewhere, everywhere = truth.copy(), truth + 0.1
    elsewhere[:2] = 0
    half = 0.5 * (truth + everywhere)
    images = {METHODS[""]: elsewhere, METHODS["final_"]: truth, METHODS["fitted_"]: half, TRUTH: truth}
    images |= {METHODS["pasted_"]: everywhere}
    rows = {row.metric: row.value for row in harmonising_rows([Composite("a", images, thing, cast)], 0)}
    assert rows["harmonise.psnr"] == 100
    assert rows["harmonise.pasted_psnr"] == pytest.approx(20)
    assert rows["harmonise.pasted_cast_psnr"] == pytest.approx(20)
    assert rows["harmonise.gain"] == pytest.approx(80)
    assert rows["harmonise.fitted_gain"] == pytest.approx(20 * np.log10(2))


def test_motion_is_judged_by_its_changes():
    """The same changes on another picture are perfect; half of them has the slope 0.5; none, nothing."""
    rng = generator(0, "tests", "film")
    truth = rng.random((4, 6, 6, 3))
    stays = np.ones((3, 6, 6), bool)
    stays[:, 0] = False
    other = 0.5 * truth + 0.2
    other[:, 0] = rng.random((4, 6, 3))  # what moved itself does not count
    (one, two) = QUALITIES
    films = [Film("a", truth, {one: other, two: np.zeros_like(truth)}, stays)]
    rows = {row.metric: row.value for row in motion_rows(films, 0)}
    assert rows["motion.shadow_correlation"] == pytest.approx(1)
    assert rows["motion.shadow_slope"] == pytest.approx(0.5)
    assert rows["motion.final_shadow_correlation"] == 0


@pytest.mark.long
def test_the_film_of_the_truth_is_that_of_the_motion(monkeypatch):
    """Surfels by motion.yaml and meshes by the same keys: shadows go together."""
    for name, value in (("SIDE", 48), ("PATHS", 36), ("FRAMES", 3), ("SURFELS", 6000)):
        monkeypatch.setattr(moving, name, value)
    found = moving.film(1, 0)
    assert found.stays.any()
    assert (np.abs(np.diff(found.truth, axis=0)).max(-1) > 0.1).any(), "nothing moves"
    rows = {row.metric: row.value for row in motion_rows([found], 0)}
    assert rows["motion.shadow_correlation"] > 0.6, rows


def test_clicks_are_drawn_from_seeds_and_on_what_they_are_for(world):
    clicked = Clicked("a", world.surfels(6000))
    number = clicked.things()[-1]
    draw = clicked.drawn(number, 0, 5)
    assert draw.clicks == clicked.drawn(number, 0, 5).clicks != clicked.drawn(number, 1, 5).clicks
    for click in draw.clicks:
        ((x, y),) = np.array(click.inside or click.outside)
        shown = clicked.shown[int(str(click.view)), int(y), int(x)]
        assert (shown == number) == bool(click.inside)
    assert sum(len(click.inside) for click in draw.clicks) == selecting.INSIDE
    truth = clicked.scene.object_id == number
    overlap = (draw.selected & truth).sum() / (draw.selected | truth).sum()
    assert draw.iou == pytest.approx(overlap)
    assert draw.iou > 0.9


def test_selections_are_averaged_over_all_draws():
    draws = [Draw(s, 1, (), np.zeros(1, bool), iou, r) for s, iou, r in (("a-0", 1, 0), ("b-0", 0.5, 2))]
    rows = {row.metric: row.value for row in selection_rows(draws, 0)}
    assert rows["select.iou"] == 0.75
    assert rows["select.good"] == 0.5
    assert rows["select.refused"] == 0.5
    assert rows["select.scene_iou.b_0"] == 0.5


def test_cameras_turn_about_up():
    home = Camera.look_at((3, 0, 1), (0, 0, 0.2), fov_deg=40, width=8, height=8)
    quarter = viewing.turned(home, 90)
    np.testing.assert_allclose(quarter.position, [0, 3, 1], atol=1e-9)
    expected = Camera.look_at((0, 3, 1), (0, 0, 0.2), fov_deg=40, width=8, height=8)
    np.testing.assert_allclose(quarter.world_to_camera, expected.world_to_camera, atol=1e-9)


def test_a_folder_without_scenes_is_named(tmp_path, capsys):
    assert run(f"benchmark.data={tmp_path}", f"output_dir={tmp_path / 'out'}") == 2
    assert "no scenes with surfels.ply" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_the_whole_benchmark_runs_and_its_page_has_every_part(tmp_path: Path, monkeypatch, world):
    toy = {
        baking: {"SCENES": 1, "VIEWS": 1, "SIDE": 48},
        harmonising: {"WORLDS": 1, "SIDE": 48, "PATHS": 16, "SURFELS": 3000, "PHOTOS": 6, "PHOTO_SIDE": 48},
        moving: {"WORLDS": 1, "SIDE": 48, "PATHS": 16, "SURFELS": 3000, "FRAMES": 2},
        selecting: {"LARGE": 4000, "ROUNDS": 1, "TRIALS": 1},
        viewing: {
            "SURFELS": 3000, "SIZE": (64, 36), "LARGE": (128, 72), "SECONDS": 1.0, "FIRST_SECONDS": 1.0,
            "COUNTED": 5, "INTERRUPTS": 1,
        },
    }  # fmt: skip
    for module, values in toy.items():
        for name, value in values.items():
            monkeypatch.setattr(module, name, value)
    for name in ("a", "b"):
        folder = tmp_path / "data" / "scenes" / name
        folder.mkdir(parents=True)
        world.surfels(3000).save(folder / "surfels.ply")
    where = (
        f"benchmark.data={tmp_path / 'data'}",
        "benchmark.real_data=null",
        f"output_dir={tmp_path / 'out'}",
    )
    assert run(*where) == 0
    results = Results.load(tmp_path / "out" / "results.json")
    absent = [target.metric for target in results.targets if results.find(target.metric) is None]
    assert [metric for metric in absent if not metric.startswith("mesh.")] == []
    page = (tmp_path / "out" / "report.html").read_text()
    for section in ("harmonise", "motion", "bake", "select", "viewer"):
        assert f'<section id="{section}">' in page
        assert section == "viewer" or list((tmp_path / "out" / "pictures").glob(f"{section}-*.png"))
