"""The studio without a window: what it ends with, what it gives up, and what it survives."""

import threading
import time
from dataclasses import replace
from typing import get_args

import drjit as dr
import numpy as np
import pytest

from examples.stage import BALL, FLOOR, RING
from tron.cameras import Camera
from tron.editing import Clicks, Insert, Material, Move, Remove, Selection, Separate
from tron.seeds import generator
from tron.view.stage import BUFFERS, Left, Stage, Wish
from tron.view.studio import REST_SECONDS

LEFT = get_args(Left)
EDITS = (
    Material(select=Selection(object=BALL), metallic=1.0, roughness=0.1),
    Move(select=Selection(object=RING), by=(0.4, 0.0, 0.2)),
    Remove(select=Selection(object=RING)),
    Material(select=Selection(object=FLOOR), base_color=(0.7, 0.2, 0.1)),
)


def random_change(rng: np.random.Generator) -> dict[str, object]:
    """One attribute of a wish, as a GUI would change it."""
    return [
        {"light": ["east", "west"][rng.integers(2)]},
        {"turn": float(rng.integers(360))},
        {"stops": float(rng.integers(-2, 3))},
        {"buffer": BUFFERS[rng.integers(len(BUFFERS))]},
        {"edits": tuple(EDITS[k] for k in sorted(rng.choice(4, rng.integers(4), replace=False)))},
        {"hidden": frozenset([RING] if rng.integers(2) else [])},
        {"left": LEFT[rng.integers(4)], "left_light": "west", "divider": float(rng.uniform(0, 1))},
    ][rng.integers(7)]


def baked(stage: Stage) -> np.ndarray:
    """Direct and indirect light at the surfels."""
    light = stage._right
    assert light is not None
    assert light.bounced is not None
    return np.concatenate([np.array(light.bounced.direct), np.array(light.bounced.indirect)])


@pytest.mark.long
@pytest.mark.parametrize("edits", [EDITS[:1], EDITS[:2], EDITS[1:]], ids=["paint", "move", "remove"])
def test_the_last_picture_is_that_of_a_fresh_studio(open_studio, camera, edits):
    """Bitwise, whatever was wished for before, in whatever haste."""
    rng = generator(len(edits), "wishes")
    with open_studio(threads=1) as (studio, shown):
        studio.look(0, camera)
        for _ in range(20):
            studio.wish(**random_change(rng))
            time.sleep(float(rng.uniform(0, 2 * REST_SECONDS)) * float(rng.integers(2)))
        plain = {"buffer": "lit", "hidden": frozenset(), "left": "nothing"}
        for wish in (plain, {"edits": edits}):
            before = len(shown.pictures)
            studio.wish(**wish)
            shown.until(lambda before=before: len(shown.pictures) > before)
        for turn in range(30, 40):  # a busy machine may come to rest before it draws
            wish = studio.wish(turn=float(turn))
            shown.until(lambda wish=wish: shown.pictures[-1].wish == wish)
            if any(each.refined == 0 and each.wish == wish for each in shown.pictures):
                break
        used, bake = shown.final(studio, camera), studio.ask(baked).result(60)
    with open_studio(threads=1) as (fresh, other):
        fresh.change(lambda _: used.wish)
        fresh.look(0, camera)
        expected, anew = other.final(fresh, camera), fresh.ask(baked).result(60)
    assert used.wish == expected.wish
    assert any(each.refined == 0 and each.wish == used.wish for each in shown.pictures), "rough at first"
    np.testing.assert_array_equal(bake, anew)
    np.testing.assert_array_equal(used.image, expected.image)


@pytest.mark.long
def test_pictures_are_of_the_wish_of_the_moment_once_at_rest(open_studio, scene):
    """Refinement grows from 0 to 1 for each wish, and never shows a wish that is past."""
    camera, rng = Camera.around(scene, azimuth_deg=30, width=320, height=240), generator(1, "haste")
    past: list[Wish] = []
    with open_studio() as (studio, shown):

        def show(view, picture):
            if picture.refined > 0 and picture.wish != studio.wished:
                past.append(picture.wish)
            shown.show(view, picture)

        studio._show = show
        studio.look(0, camera)
        for turn in range(20):
            studio.wish(turn=float(turn))
            time.sleep(float(rng.uniform(0.2, 0.8)))
        studio.wish(turn=40.0)
        shown.final(studio, camera)
        of_last = [each.refined for each in shown.pictures if each.wish.turn == 40 and each.refined > 0]
    assert of_last == sorted(of_last)
    assert of_last[-1] == 1
    assert len(of_last) == 5
    assert past == []


@pytest.mark.long
def test_a_wish_in_the_middle_of_a_pass_is_drawn_next(open_studio, scene, monkeypatch):
    """The band that is under way ends, and no other begins."""
    drawn: list[int] = []
    one_in_a_pass = threading.Event()
    linear = Stage.linear

    def noted(stage, part, camera, number=-1, band=0, **more):
        drawn.append(number)
        if number >= 0 and band == 3:
            one_in_a_pass.set()
        return linear(stage, part, camera, number, band, **more)

    monkeypatch.setattr(Stage, "linear", noted)
    large = Camera.around(scene, azimuth_deg=30, width=640, height=480)
    with open_studio() as (studio, shown):
        studio.look(0, large)
        for turn in (50.0, 70.0, 90.0):
            assert one_in_a_pass.wait(60)
            begun = len(drawn)
            studio.wish(turn=turn)
            shown.until(lambda turn=turn: shown.pictures[-1].wish.turn == turn)
            after = drawn[begun:]
            assert sum(number >= 0 for number in after[: after.index(-1)]) <= 1
            one_in_a_pass.clear()


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"edits": (Remove(select=Selection(object=77)),)}, "there is no object 77"),
        ({"edits": (Insert(file="absent.ply", at=(0, 0, 2)),)}, "absent.ply"),  # pyright: ignore
        ({"hidden": frozenset([FLOOR, BALL, RING])}, "everything is hidden"),
        ({"light": "none of them"}, "none of them"),
    ],
)
def test_a_wish_that_cannot_be_is_taken_back_with_a_notice(open_studio, camera, wrong, said):
    with open_studio() as (studio, shown):
        studio.look(0, camera)
        good = shown.final(studio, camera).wish
        studio.wish(**wrong)
        shown.until(lambda: shown.notices)
        assert said in shown.notices[0]
        assert studio.wished == good
        studio.wish(turn=90.0)
        assert shown.final(studio, camera).wish.turn == 90
        assert len(shown.notices) == 1


def test_several_views_see_one_scene_each_from_its_own_place(open_studio, scene, camera):
    other = Camera.around(scene, azimuth_deg=200, width=40, height=40)
    with open_studio() as (studio, shown):
        shown.of = {}
        studio._show = lambda view, picture: (shown.of.update({view: picture}), shown.show(view, picture))
        studio.look(0, camera)
        studio.look(1, other)
        studio.wish(edits=EDITS[:1])
        shown.until(lambda: len(shown.of) == 2 and all(each.refined == 1 for each in shown.of.values()))
        assert [shown.of[n].image.shape[:2] for n in (0, 1)] == [(48, 64), (40, 40)]
        assert shown.of[0].wish == shown.of[1].wish == studio.wished
        studio.look(1, None)
        studio.wish(stops=1.0)
        shown.final(studio, camera)
        assert shown.of[1].wish.stops == 0


def test_undo_brings_the_picture_back(open_studio, camera):
    with open_studio(threads=1) as (studio, shown):
        studio.look(0, camera)
        before = shown.final(studio, camera)
        studio.wish(edits=EDITS[:2])
        changed = shown.final(studio, camera)
        studio.wish(edits=())
        after = shown.final(studio, camera)
    assert np.abs(changed.image.astype(int) - before.image).mean() > 1
    np.testing.assert_array_equal(after.image, before.image)


def pixel_of(camera, point) -> tuple[int, int]:
    x, y = camera.project(point[None])[0][0]
    return int(x), int(y)


def test_a_pixel_is_of_the_object_that_it_shows(open_studio, camera, scene):
    x, y = pixel_of(camera, scene.means[scene.object_id == BALL].mean(0))
    with open_studio() as (studio, _):
        found = studio.ask(lambda stage: stage.shown_at(camera, x, y)).result(60)
        assert found is not None
        assert found.object == BALL
        assert (scene.object_id[list(found.surfels)] == BALL).all()
        on_ball = scene.means[scene.object_id == BALL]
        assert np.linalg.norm(on_ball - found.point, axis=1).min() < 2 * scene.spacing
        studio.wish(hidden=frozenset([BALL]))
        behind = studio.ask(lambda stage: stage.shown_at(camera, x, y)).result(60)
        assert behind is None or behind.object != BALL
        assert studio.ask(lambda stage: stage.shown_at(camera, 0, 0)).result(60) is None


@pytest.mark.long
def test_clicks_inside_and_outside_cut_an_object_out(open_studio, scene, variant):
    """The whole scene is one object; what is marked in the picture is what becomes the new one."""
    camera = Camera.around(scene, azimuth_deg=30, width=160, height=120)
    x, y = camera.project(scene.means)[0].T
    framed = (x >= 0) & (x < 160) & (y >= 0) & (y < 120)
    one = replace(scene, object_id=np.zeros(len(scene), np.int32))
    ball = scene.object_id == BALL

    def towards(stage, points):
        hits = [stage.shown_at(camera, *pixel_of(camera, point)) for point in points]
        return tuple(dict.fromkeys(n for hit in hits if hit for n in hit.surfels))

    rng, on_ball, around = generator(2, "clicks"), scene.means[ball], scene.means[framed & ~ball]
    facing = on_ball[(on_ball - on_ball.mean(0)) @ (camera.position - on_ball.mean(0)) > 0.2]
    with open_studio(scene=one) as (studio, shown):
        studio.look(0, camera)
        plain = shown.final(studio, camera)
        inside = studio.ask(lambda stage: towards(stage, rng.choice(facing, 3))).result(60)
        outside = studio.ask(lambda stage: towards(stage, rng.choice(around, 5))).result(60)
        assert ball[list(inside)].all()
        outside = tuple(n for n in outside if not ball[n])  # a ray to what the ball hides
        clicks = Clicks(inside=inside, outside=outside)
        studio.wish(marked=clicks)
        marked = shown.final(studio, camera)
        studio.wish(marked=None, edits=(Separate(select=Selection(clicks=clicks), object=5),))
        after = shown.final(studio, camera)
        cut = studio.ask(lambda stage: stage.session.scene.object_id == 5).result(60)
        studio.wish(edits=(*studio.wished.edits, Remove(select=Selection(object=5))))
        without = shown.final(studio, camera)
    assert (cut & ball).sum() / (cut | ball).sum() > 0.95
    np.testing.assert_array_equal(after.image, plain.image)
    changed = np.abs(marked.image.astype(int) - plain.image).max(-1) > 30
    pixels = camera.project(facing)[0].round().astype(int)
    assert changed[pixels[:, 1], pixels[:, 0]].mean() > 0.9
    middle, radius = (
        camera.project(on_ball.mean(0)[None])[0][0],
        1.15 * np.ptp(pixels[:, 0]) / 2,
    )  # surfels reach a spacing beyond
    y, x = np.nonzero(changed)
    assert (np.hypot(x - middle[0], y - middle[1]) <= radius).mean() > 0.97
    assert np.abs(without.image.astype(int) - plain.image)[changed].mean() > 10


def test_a_surfel_clicked_inside_and_outside_is_refused(open_studio, camera):
    with open_studio() as (studio, shown):
        studio.look(0, camera)
        good = shown.final(studio, camera).wish
        studio.wish(marked=Clicks(inside=(3,), outside=(3, 9)))
        shown.until(lambda: shown.notices)
        assert "both inside and outside" in shown.notices[0]
        assert studio.wished == good


def differs(image: np.ndarray, other: np.ndarray) -> float:
    """Mean difference, of 255."""
    return float(np.abs(image.astype(int) - other).mean())


@pytest.mark.long
def test_left_of_the_divider_is_what_was_chosen(open_studio, camera):
    """Against pictures of that alone; the seeds of noise are other ones."""
    column, red = 24, {"edits": EDITS[3:]}
    with open_studio() as (studio, shown):

        def seen(**wish):
            studio.wish(**wish)
            return shown.final(studio, camera).image

        studio.look(0, camera)
        before, own = seen(turn=20.0), seen(buffer="capture")
        other = seen(buffer="lit", light="west", turn=0.0, **red)
        after = seen(light="east", turn=20.0)
        sides = {"before": before, "capture": own, "light": other}
        for left, alone in sides.items():
            both = seen(left=left, left_light="west", divider=column / 64)
            assert differs(both[:, : column - 1], alone[:, : column - 1]) < 3, left
            assert differs(both[:, : column - 1], after[:, : column - 1]) > 8, left
            assert differs(both[:, column + 1 :], after[:, column + 1 :]) < 3, left
            assert (both[:, column - 1 : column + 1] == 255).all(), "a line between the two"
        assert differs(seen(divider=1.0), other) < 3
        np.testing.assert_array_equal(seen(divider=0.0), after)
        np.testing.assert_array_equal(seen(divider=0.4, left="nothing"), after)


class Finish:
    """A grey picture; it begins, and waits as long as it is told to."""

    buffers = ("pbr",)
    normals = False

    def __init__(self) -> None:
        self.frames, self.begun, self.slow = [], threading.Event(), False

    def __call__(self, frame, exposure, watch):
        self.frames.append(frame)
        self.begun.set()
        while self.slow:
            watch()
            time.sleep(0.01)
        return np.full_like(frame["lit"], 0.18) / exposure


def test_a_picture_at_rest_ends_with_its_finish(open_studio, camera):
    finish = Finish()
    with open_studio(finish=lambda *_: finish) as (studio, shown):
        studio.look(0, camera)
        last = shown.final(studio, camera)
        levels = [each.refined for each in shown.pictures if each.refined > 0]
        studio.wish(buffer="irradiance")
        shown.final(studio, camera)
        assert np.ptp(shown.final(studio, camera).image) > 100, "of lit alone"
        studio.wish(buffer="lit", left="light", left_light="west")
        both = shown.final(studio, camera)
    assert levels == sorted(levels)
    assert len(levels) == 6
    assert np.ptp(last.image) == 0
    (first, *_), sizes = finish.frames, [each["lit"].shape[1] for each in finish.frames]
    assert {name: each.shape for name, each in first.items()} == dict.fromkeys(
        ("lit", "pbr", "albedo", "surface", "sampling"), (48, 64, 3)
    )
    assert differs(255 * first["pbr"], 255 * first["lit"]) > 1
    assert sizes == [64, 32, 32], "each side of the divider by itself"
    assert np.ptp(both.image[:, :31]) == np.ptp(both.image[:, 33:]) == 0


@pytest.mark.long
def test_a_finish_is_given_up_once_it_is_out_of_date(open_studio, camera):
    finish = Finish()
    finish.slow = True
    with open_studio(finish=lambda *_: finish) as (studio, shown):
        studio.look(0, camera)
        for turn in (50.0, 70.0):
            assert finish.begun.wait(60)
            asked = studio.ask(lambda stage: stage.turn).result(10)
            assert asked.shape == (3, 3), "questions do not wait for it"
            finish.begun.clear()
            studio.wish(turn=turn)
            shown.until(lambda turn=turn: shown.pictures[-1].wish.turn == turn)
        assert all(each.refined < 1 for each in shown.pictures)
        finish.slow = False
        assert np.ptp(shown.final(studio, camera).image) == 0


@pytest.mark.long
def test_a_finish_that_fails_leaves_the_passes_as_they_are(open_studio, camera, caplog):
    def broken(frame, exposure, watch):
        raise OSError("no such library")

    broken.buffers, broken.normals = (), False
    with open_studio() as (studio, shown):
        studio.look(0, camera)
        plain = shown.final(studio, camera).image
    with open_studio(finish=lambda *_: broken) as (studio, shown):
        studio.look(0, camera)
        np.testing.assert_array_equal(shown.final(studio, camera).image, plain)
        studio.wish(turn=90.0)
        shown.final(studio, camera)
    assert caplog.text.count("no such library") == 1
    assert shown.notices == []


@pytest.mark.long
def test_close_ends_the_thread_in_the_middle_of_work(open_studio, scene):
    with open_studio() as (studio, shown):
        studio.look(0, Camera.around(scene, width=1024, height=1024))
        shown.until(lambda: shown.pictures)
        studio.close()
        assert not studio._thread.is_alive()
        assert studio.ask(lambda stage: None).cancelled()
    assert not any(each.name == "studio" for each in threading.enumerate())


def test_no_kernel_is_compiled_while_light_and_camera_turn(variant, open_studio, scene, camera):
    """After the first pictures of each kind: what is in the cache is enough.

    But on a GPU, where a kernel that lays three channels one after another has their length as a
    constant: each new number of pixels that show something costs 12 ms once.
    """
    with open_studio() as (studio, shown):
        studio.look(0, camera)
        studio.wish(turn=10.0)
        shown.final(studio, camera)

        def run(turns: range) -> None:
            for turn in turns:
                near = Camera.around(scene, azimuth_deg=turn, width=64, height=48)
                studio.look(0, near)
                studio.wish(turn=float(turn))
                shown.until(lambda turn=turn: shown.pictures[-1].wish.turn == turn)

        run(range(11, 14))
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            studio.ask(lambda stage: dr.set_flag(dr.JitFlag.KernelHistory, True)).result(60)
            run(range(20, 40, 2))
            history = studio.ask(lambda stage: dr.kernel_history([dr.KernelType.JIT])).result(60)
            studio.ask(lambda stage: dr.set_flag(dr.JitFlag.KernelHistory, False)).result(60)
    assert history
    least = 1 if variant.startswith("llvm") else 20  # operations
    assert not [each for each in history if not each["cache_hit"] and each["operation_count"] >= least]
