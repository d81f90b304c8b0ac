"""Laws of edits: what is done is what was said, comes back when undone, and depends on no order of people."""

import colorsys
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.distance import pdist

from examples.stage import BALL, FLOOR, RING
from tron.color import linear_to_srgb
from tron.editing import (
    Duplicate,
    EditList,
    Insert,
    Material,
    Move,
    Remove,
    Selection,
    Separate,
    Session,
    Views,
)
from tron.errors import TronError
from tron.gaussians.fields import FIELDS
from tron.gaussians.harmonics import eval_sh
from tron.gaussians.scene import GaussianScene
from tron.seeds import generator
from tron.termination import TERMINATED

HERE = Views()
RINGS, BALLS, FLOORS = (Selection(object=which) for which in (RING, BALL, FLOOR))


@pytest.fixture
def other(scene: GaussianScene, tmp_path: Path) -> Path:
    path = tmp_path / "other.ply"
    scene.save(path)
    return path


@pytest.fixture
def insert(other: Path) -> Insert:
    return Insert(file=other, at=(3, 1, 0.5), standing=False, take=RINGS, turn=30, scale=0.5, object=9)


def edits_of(insert: Insert) -> list:
    return [
        Remove(select=RINGS),
        Move(select=BALLS, by=(0.3, 0, 0), turn=40, scale=1.5),
        Duplicate(select=BALLS, by=(0, 1.5, 0), object=7),
        insert,
        Material(select=BALLS, hue=200, roughness=0.1),
    ]


def test_a_file_that_is_read_and_written_has_its_bytes(scene, other, content):
    assert content(GaussianScene.load(other)) == other.read_bytes()


def test_insert_then_remove_gives_the_bytes_back(scene, insert, content):
    there = insert.apply(scene, HERE)
    assert len(there) > len(scene)
    assert content(Remove(select=Selection(object=9)).apply(there, HERE)) == content(scene)
    copied = Duplicate(select=BALLS, by=(5, 0, 0), object=4).apply(scene, HERE)
    assert content(Remove(select=Selection(object=4)).apply(copied, HERE)) == content(scene)


@pytest.mark.usefixtures("variant")
def test_separate_changes_ids_alone_and_undoes(scene, content):
    half = Selection(object=BALL, box={"low": (-9, -9, 0.4), "high": (9, 9, 9)})  # type: ignore[arg-type]
    session = Session(scene)
    apart = session.do(Separate(select=half, object=8))
    upper = (scene.object_id == BALL) & (scene.means[:, 2] >= 0.4)
    assert 0 < upper.sum() < (scene.object_id == BALL).sum()
    np.testing.assert_array_equal(apart.object_id, np.where(upper, 8, scene.object_id))
    assert content(replace(apart, object_id=scene.object_id)) == content(scene)
    assert Separate(select=half).apply(scene, HERE).object_id.max() == RING + 1
    assert Separate(select=half, object=8).objects == {BALL, 8}
    assert EditList.of([{"action": "separate", "select": {"object": BALL}, "object": 8}]).merged(
        EditList((Remove(select=RINGS),))
    )
    session.undo()
    assert content(session.scene) == content(scene)


def test_it_does_so_where_what_is_inserted_was_stood_on_the_floor(scene, other, content):
    standing = Insert(file=other, at=(1, 0.2, 3), take=RINGS, object=9).apply(scene, HERE)
    lowest = standing.means[standing.object_id == 9, 2].min()
    assert abs(lowest) < 0.005, "on the floor, which is at 0"
    assert content(Remove(select=Selection(object=9)).apply(standing, HERE)) == content(scene)


def test_what_is_undone_was_never_done(scene, insert, content):
    session, bytes_ = Session(scene), [content(scene)]
    for edit in edits_of(insert):
        bytes_.append(content(session.do(edit)))
    assert len(set(bytes_)) == len(bytes_), "every edit changes the file"
    for edit, before in reversed(list(zip(edits_of(insert), bytes_))):
        assert session.undo() == edit
        assert content(session.scene) == before
    with pytest.raises(TronError, match="nothing to undo"):
        session.undo()


def test_one_edit_among_others_can_be_taken_back(scene, insert, content):
    session = Session(scene)
    for edit in edits_of(insert):
        session.do(edit)
    without, every = session.without(1), edits_of(insert)
    assert list(without.edits) == [every[0], *every[2:]]
    assert content(without.scene) == content(EditList(tuple(without.edits)).apply(scene))
    assert len(session.edits) == 5


def test_an_edit_that_fails_changes_nothing(scene):
    session = Session(scene)
    with pytest.raises(TronError, match="no object 5"):
        session.do(Remove(select=Selection(object=5)))
    assert session.scene is scene
    assert len(session.edits) == 0


def test_edits_that_are_stored_and_replayed_do_the_same(scene, insert, content, tmp_path):
    edits = EditList(tuple(edits_of(insert)))
    (tmp_path / "kept").mkdir()
    edits.write(tmp_path / "kept" / "edits.yaml")
    assert yaml.safe_load((tmp_path / "kept" / "edits.yaml").read_text())[3]["file"] == "../other.ply"
    again = EditList.read(tmp_path / "kept" / "edits.yaml")
    assert content(again.apply(scene)) == content(edits.apply(scene))
    again.write(tmp_path / "again.yaml")
    assert (
        EditList.read(tmp_path / "again.yaml").apply(scene).means.tobytes()
        == edits.apply(scene).means.tobytes()
    )


MINE = EditList((Move(select=BALLS, by=(0.1, 0, 0.2), turn=20), Material(select=BALLS, metallic=1)))
YOURS = EditList((Remove(select=RINGS), Material(select=FLOORS, base_color={"scale": 0.5})))  # type: ignore[arg-type]


def test_lists_over_different_objects_may_be_done_in_either_order(scene, content):
    one, other = (EditList((*a, *b)).apply(scene) for a, b in ((MINE, YOURS), (YOURS, MINE)))
    assert content(one) == content(other) != content(scene)
    assert MINE.merged(YOURS) == YOURS.merged(MINE)
    assert content(MINE.merged(YOURS).apply(scene)) == content(one)


def test_lists_that_add_objects_make_the_same_surfels_in_either_order(scene, insert, content):
    """Their rows stand in the order in which they came, so the lists are merged in one order."""
    mine, yours = EditList((Duplicate(select=BALLS, by=(2, 0, 0), object=7),)), EditList((insert,))
    one, other = (EditList((*a, *b)).apply(scene) for a, b in ((mine, yours), (yours, mine)))
    assert not np.array_equal(one.means, other.means)
    for name in FIELDS:
        rows = (getattr(each, name)[np.argsort(each.object_id, kind="stable")] for each in (one, other))
        np.testing.assert_array_equal(*rows)
    assert content(mine.merged(yours).apply(scene)) == content(yours.merged(mine).apply(scene))


@pytest.mark.parametrize(
    ("theirs", "said"),
    [
        (Remove(select=BALLS), "object 2 is named by both"),
        (Duplicate(select=RINGS, object=BALL), "object 2 is named by both"),
        (Duplicate(select=RINGS), r"an edit \(duplicate\) does not say which objects"),
        (Remove(select=Selection(sphere={"center": (0, 0, 0), "radius": 1})), "select by object"),  # type: ignore[arg-type]
        (Insert(file=Path("a.ply"), at=(0, 0, 0), object=9), "standing: false"),
    ],
)
def test_lists_that_may_see_each_other_are_not_merged(theirs, said):
    with pytest.raises(TronError, match=said):
        MINE.merged(EditList((theirs,)))


def test_a_body_keeps_its_shape_and_its_radiance_turns_with_it(scene):
    """Distances by SciPy, radiance by looking along turned directions."""
    rng = generator(1, "test", "radiance")
    colourful = replace(scene, sh=rng.normal(size=scene.sh.shape) * 0.1)
    which = np.flatnonzero(scene.object_id == BALL)[::12]
    after = Move(select=BALLS, by=(0.4, -1, 2), turn=90, axis=(0, 0, 2), scale=1.5).apply(colourful, HERE)
    np.testing.assert_allclose(
        pdist(after.means[which]), 1.5 * pdist(scene.means[which]), rtol=1e-4, atol=1e-5
    )
    np.testing.assert_allclose(after.log_scales[which], scene.log_scales[which] + np.log(1.5), rtol=1e-5)
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    seen = rng.normal(size=(len(which), 3))
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    np.testing.assert_allclose(
        eval_sh(after.sh[which], seen @ turn.T), eval_sh(colourful.sh[which], seen), atol=1e-5
    )
    np.testing.assert_allclose(after.normals()[which], scene.normals()[which] @ turn.T, atol=1e-5)
    rest = scene.object_id != BALL
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(after, name)[rest], getattr(colourful, name)[rest])


def test_a_thing_that_grows_or_turns_about_up_stays_on_the_floor(scene):
    for edit in (Move(select=BALLS, scale=2), Move(select=BALLS, turn=70), Move(select=RINGS, scale=0.3)):
        (which,) = {BALL, RING} & set(edit.objects or ())
        before, after = (each.means[scene.object_id == which] for each in (scene, edit.apply(scene, HERE)))
        assert after[:, 2].min() == pytest.approx(before[:, 2].min(), abs=0.005)
        assert after[:, :2].mean(0) == pytest.approx(before[:, :2].mean(0), abs=0.002)


def test_four_quarter_turns_are_none(scene):
    turned = scene
    for _ in range(4):
        turned = Move(select=BALLS, turn=90).apply(turned, HERE)
    for name, error in {"means": 1e-6, "quats": 1e-6, "sh": 1e-6}.items():
        np.testing.assert_allclose(getattr(turned, name), getattr(scene, name), atol=error)


def test_hue_is_that_of_the_color_wheel(scene):
    """By Python's own colorsys; saturation and value stay, and so do greys."""
    which = np.flatnonzero(scene.object_id == RING)[0]
    before = colorsys.rgb_to_hsv(*linear_to_srgb(scene.base_color[which].astype(float)))
    for hue, expected in ((200.0, 200.0), ({"turn": 100.0}, 360 * before[0] + 100)):
        after = Material(select=Selection(object=(FLOOR, RING)), hue=hue).apply(scene, HERE)  # type: ignore[arg-type]
        found = colorsys.rgb_to_hsv(*linear_to_srgb(after.base_color[which].astype(float)))
        np.testing.assert_allclose(found, (expected / 360 % 1, *before[1:]), atol=1e-3)
        floor = scene.object_id == FLOOR
        np.testing.assert_allclose(after.base_color[floor], scene.base_color[floor], atol=1e-5)


def test_materials_are_set_or_scaled_within_their_range(scene):
    edit = Material(select=BALLS, base_color={"scale": (0.5, 2, 40)}, roughness={"scale": 2}, metallic=0.25)  # type: ignore[arg-type]
    after, ball = edit.apply(scene, HERE), scene.object_id == BALL
    np.testing.assert_allclose(
        after.base_color[ball], np.tile([0.375, 0.16, 1.0], (ball.sum(), 1)), rtol=1e-5
    )
    np.testing.assert_allclose(after.roughness[ball], 0.6, rtol=1e-6)
    assert (after.metallic[ball] == 0.25).all()
    for name in FIELDS:
        changes = name in ("base_color", "roughness", "metallic")
        assert changes or getattr(after, name) is getattr(scene, name)
        np.testing.assert_array_equal(getattr(after, name)[~ball], getattr(scene, name)[~ball])


def test_what_is_inserted_stands_upright_where_up_is_another_direction(scene, tmp_path):
    """A scene with y up receives one with z up: the ring stands on it, as high as it was."""
    rotation = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    scene.save(tmp_path / "z.ply")
    lying = scene.rotated(rotation)
    np.testing.assert_allclose(lying.up, [0, 1, 0], atol=1e-9)
    there = Insert(file=tmp_path / "z.ply", at=(4, 1, 0), standing=False, take=RINGS, object=9).apply(
        lying, HERE
    )
    heights = there.means[there.object_id == 9, 1]
    assert heights.min() == pytest.approx(1, abs=0.005)
    assert np.ptp(heights) == pytest.approx(np.ptp(scene.means[scene.object_id == RING, 2]), abs=1e-4)


def test_another_kernel_keeps_its_width(scene, tmp_path, caplog):
    """Between that of equal volume, 2 pi s^2 = pi sqrt(18 pi) / 2, and of half height (at 1.18 and 1.88)."""
    soft = replace(scene, kernel_degree=2)
    soft.save(tmp_path / "soft.ply")
    there = Insert(file=tmp_path / "soft.ply", at=(0, 0, 5), standing=False, object=9).apply(scene, HERE)
    assert there.kernel_degree == 4
    ratio = np.exp(there.log_scales[-1, 0] - soft.log_scales[-1, 0])
    volume, half = (18 * np.pi) ** 0.25 / 2, (18 * np.log(2)) ** 0.25 / np.sqrt(2 * np.log(2))
    assert volume < 1 / ratio < half
    assert "kernel of degree 2" in caplog.text


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (Remove(select=Selection(object=(FLOOR, BALL, RING))), "no surfel is left"),
        (Remove(select=Selection(sphere={"center": (9, 9, 9), "radius": 1})), "no surfel is selected"),  # type: ignore[arg-type]
        (Duplicate(select=BALLS, by=(1, 0, 0), object=RING), "there is an object 3 already"),
        (Separate(select=BALLS, object=FLOOR), "there is an object 1 already"),
        (Insert(file=Path("absent.ply"), at=(0, 0, 0), standing=False), "absent.ply"),
    ],
)
def test_what_cannot_be_done_is_named_with_its_place(scene, edit, said):
    with pytest.raises(TronError, match=said) as refusal:
        EditList((Material(select=BALLS, hue=3), edit)).apply(scene)
    assert "absent" in said or f"edits, edit 2: {edit.action}" in str(refusal.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "no edits found"),
        ("{a: 1}", "no edits found"),
        ("- 3", "edit 1): write a list"),
        ("- {select: {object: 1}}", "the edit has no action"),
        ("- {action: fly}", "unknown action 'fly'"),
        ("- {action: remove, select: {objct: 1}}", "unknown key 'select.objct'"),
        ("- {action: remove, select: {objct: 1}}", "did you mean 'object'?"),
        ("- {action: remove}", "'select' has no value"),
        ("- {action: remove, select: {object: [3, 3]}}", "object 3 is named twice"),
        ("- {action: remove, select: {box: {low: [0,0,1], high: [1,1,0]}}}", "the box is inverted"),
        ("- {action: move, select: {object: 1}, by: [0, .nan, 0]}", "wrong value for 'by.1': nan"),
        ("- {action: move, select: {object: 1}}", "say how it moves"),
        ("- {action: move, select: {object: 1}, turn: 5, axis: [0,0,0]}", "an axis has a length"),
        ("- {action: material, select: {object: 1}}", "say what changes"),
        ("- {action: material, select: {object: 1}, roughness: 2}", "wrong value for 'roughness': 2"),
        ("- {action: insert, file: a.ply}", "'at' has no value"),
        ("- {action: remove, select: {object: 1}}\n- [", "not YAML"),
    ],
)
def test_a_mistake_in_a_file_is_one_line_that_names_its_place(tmp_path, text, said):
    path = tmp_path / "edits.yaml"
    path.write_text(text)
    with pytest.raises(TronError) as refusal:
        EditList.read(path)
    assert said in str(refusal.value)
    assert str(path) in str(refusal.value)
    assert len(str(refusal.value).splitlines()) == 1


def test_an_end_amid_the_imports_of_a_model_is_an_end(tmp_path):
    """trimesh takes whatever comes while it imports its libraries for one that is missing, SIGTERM too."""
    program = """
import os, signal, sys, time
from pathlib import Path
from tron.editing.models import read_model
from tron.termination import termination_unwinds

class Swallowing:
    def find_spec(self, name, *_):
        if name == "trimesh":
            try:
                os.kill(os.getpid(), signal.SIGTERM)
                time.sleep(0.01)
            except BaseException:
                pass

sys.meta_path.insert(0, Swallowing())
with termination_unwinds():
    read_model(Path(sys.argv[1]))
"""
    done = subprocess.run([sys.executable, "-c", program, str(tmp_path / "a.obj")], check=False)
    assert done.returncode == TERMINATED
