"""The studio without a window: what it ends with, what it gives up, and what it survives."""

import threading
import time

import drjit as dr
import numpy as np
import pytest

from examples.stage import BALL, FLOOR, RING
from tron.cameras import Camera
from tron.editing import Insert, Material, Move, Remove, Selection
from tron.seeds import generator
from tron.view.stage import BUFFERS, Stage, Wish
from tron.view.studio import REST_SECONDS

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
    ][rng.integers(6)]


def baked(stage: Stage) -> np.ndarray:
    """Direct and indirect light at the surfels."""
    light = stage._illumination
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
        for wish in ({"buffer": "lit", "hidden": frozenset()}, {"edits": edits}, {"turn": 30.0}):
            before = len(shown.pictures)
            studio.wish(**wish)
            shown.until(lambda before=before: len(shown.pictures) > before)
        used, bake = shown.final(studio, camera), studio.ask(baked).result(60)
    with open_studio(threads=1) as (fresh, other):
        fresh.change(lambda _: used.wish)
        fresh.look(0, camera)
        expected, anew = other.final(fresh, camera), fresh.ask(baked).result(60)
    assert used.wish == expected.wish
    assert any(each.refined == 0 and each.wish == used.wish for each in shown.pictures), "rough at first"
    np.testing.assert_array_equal(bake, anew)
    np.testing.assert_array_equal(used.image, expected.image)


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


def test_a_wish_in_the_middle_of_a_pass_is_drawn_next(open_studio, scene, monkeypatch):
    """The band that is under way ends, and no other begins."""
    drawn: list[int] = []
    one_in_a_pass = threading.Event()
    linear = Stage.linear

    def noted(stage, buffer, camera, number=-1, band=0, **more):
        drawn.append(number)
        if number >= 0 and band == 3:
            one_in_a_pass.set()
        return linear(stage, buffer, camera, number, band, **more)

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


def test_a_ray_meets_the_object_that_is_shown(open_studio, camera, scene):
    middle = scene.means[scene.object_id == BALL].mean(0)
    with open_studio() as (studio, _):
        towards = middle - camera.position
        found = studio.ask(lambda stage: stage.first_hit(camera.position, towards)).result(60)
        assert found is not None
        number, point = found
        assert number == BALL
        on_ball = scene.means[scene.object_id == BALL]
        assert np.linalg.norm(on_ball - point, axis=1).min() < 2 * scene.spacing
        studio.wish(hidden=frozenset([BALL]))
        behind = studio.ask(lambda stage: stage.first_hit(camera.position, towards)).result(60)
        assert behind is None or behind[0] != BALL
        assert studio.ask(lambda stage: stage.first_hit(camera.position, -towards)).result(60) is None


def test_close_ends_the_thread_in_the_middle_of_work(open_studio, scene):
    with open_studio() as (studio, shown):
        studio.look(0, Camera.around(scene, width=1024, height=1024))
        shown.until(lambda: shown.pictures)
        studio.close()
        assert not studio._thread.is_alive()
        assert studio.ask(lambda stage: None).cancelled()
    assert not any(each.name == "studio" for each in threading.enumerate())


def test_no_kernel_is_compiled_while_light_and_camera_turn(open_studio, scene, camera):
    """After the first pictures of each kind: what is in the cache is enough."""
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
    assert sum(not each["cache_hit"] for each in history) == 0
