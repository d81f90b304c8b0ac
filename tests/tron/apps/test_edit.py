"""tron-edit from end to end: the file it writes is what the edits say, or there is none."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from examples.stage import BALL, FLOOR, RING, make_scene
from tron.apps.edit import cli
from tron.cameras import Camera
from tron.editing import EditList, Remove, Selection, Views
from tron.gaussians.edit import subset
from tron.gaussians.ply import header_comments, write_ply
from tron.gaussians.scene import GaussianScene
from tron.io.images import write_image
from tron.relighting.proxy import fingerprint
from tron.scans import Scan

TOP = Camera.look_at((0.1, -0.45, 4), (0.1, -0.4, 0), fov_deg=50, width=64, height=64)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    make_scene(0.08).save(tmp_path / "scene.ply")
    return tmp_path


def edit(folder: Path, edits: str, *arguments: str) -> int:
    (folder / "edits.yaml").write_text(edits)
    with pytest.raises(SystemExit) as stop:
        cli(
            [
                f"scene={folder}/scene.ply",
                f"edits={folder}/edits.yaml",
                *([] if any("output=" in word for word in arguments) else [f"output={folder}/out.ply"]),
                *arguments,
            ]
        )
    return int(stop.value.code or 0)


def test_the_file_is_what_python_makes(folder, caplog):
    with caplog.at_level("INFO"):
        assert edit(folder, "- {action: remove, select: {object: 3}}") == 0
    scene = GaussianScene.load(folder / "scene.ply")
    Remove(select=Selection(object=RING)).apply(scene, Views()).save(folder / "python.ply")
    assert (folder / "out.ply").read_bytes() == (folder / "python.ply").read_bytes()
    assert "object 3: 440 surfels from [-0.4" in caplog.text
    assert sorted(path.name for path in folder.iterdir()) == [
        "edits.yaml",
        "out.ply",
        "python.ply",
        "scene.ply",
    ]


def test_insert_then_remove_gives_the_scene_back(folder):
    """What is inserted is found from the folder of the list, wherever the command runs."""
    insert = (
        "- {action: insert, file: scene.ply, at: [9, 0, 0], standing: false, take: {object: 2}, object: 5}\n"
    )
    assert edit(folder, insert + "- {action: remove, select: {object: 5}}") == 0
    assert (folder / "out.ply").read_bytes() == (folder / "scene.ply").read_bytes()


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("named", [None, "views.json", "capture", "relight.json"])
def test_masks_and_clicks_find_their_views(folder, named):
    """A camera above: a mask of the ball's outline, a click on the ball, by name and by number."""
    (folder / "capture").mkdir()
    path = folder / {None: "cameras.json", "capture": "capture/cameras.json"}.get(named, str(named))
    # relight.json of tron-relight has the number of its frames, too.
    path.write_text(json.dumps({"names": ["top.jpg"], "cameras": [TOP.to_dict()], "frames": 1}))
    pixels, _ = TOP.project(np.array([[0.1, -0.4, 0.8], [1.0, 1.0, 0.0]]))
    (ball, floor) = pixels.tolist()
    outline = np.linalg.norm(np.indices((64, 64))[::-1].transpose(1, 2, 0) + 0.5 - ball, axis=-1) < 6
    write_image(folder / "mask.png", outline.astype(np.float32)[..., None])
    clicks = f"{{view: 0, inside: [{ball}], outside: [{floor}]}}"
    edits = f"""
- {{action: material, select: {{masks: {{top.jpg: mask.png}}}}, roughness: 0.9}}
- {{action: remove, select: {{object: [1, 2], clicks: {clicks}}}}}
"""
    assert edit(folder, edits, *([] if named is None else [f"cameras={folder / named}"])) == 0
    out = GaussianScene.load(folder / "out.ply")
    assert set(np.unique(out.object_id)) == {FLOOR, RING}
    before = GaussianScene.load(folder / "scene.ply")
    masked = EditList.of([{"action": "remove", "select": {"masks": {"0": "mask.png"}}}], folder)
    left = masked.apply(before, Views([TOP]))
    gone = len(before) - len(left)
    assert 20 < gone == (before.object_id == BALL).sum() - (left.object_id == BALL).sum()


def test_up_of_a_scan_that_does_not_say_is_kept(folder):
    scene = GaussianScene.load(folder / "scene.ply")
    scene.up, scene.up_guessed = np.array([0.0, -1.0, 0.0]), True
    scene.save(folder / "scene.ply")
    assert edit(folder, "- {action: move, select: {object: 2}, turn: 90}", "up=[0,0,2]") == 0
    out = GaussianScene.load(folder / "out.ply")
    np.testing.assert_array_equal(out.up, [0, 0, 1])
    assert not out.up_guessed
    np.testing.assert_allclose(out.means[:, 2], scene.means[:, 2], atol=1e-6)


@pytest.mark.parametrize(
    ("edits", "said"),
    [
        ("- {action: remove, select: {sphere: {center: [9, 9, 9], radius: 1}}}", "no surfel is selected"),
        ("- {action: remove, select: {object: [3, 3]}}", "object 3 is named twice"),
        ("- {action: duplicate, select: {object: 3}, object: 2}", "there is an object 2 already"),
        ("- {action: remove, select: {object: 8}}", "there is no object 8"),
        ("- {action: remove, slect: {object: 3}}", "unknown key 'slect'"),
        ("- {action: move, select: {object: 3}, by: [.nan, 0, 0]}", "'by.0': nan"),
        ("- {action: remove, select: {box: {low: [1, 0, 0], high: [0, 1, 1]}}}", "box is inverted: x goes"),
        ("- {action: remove, select: {grow: {view: 0, at: [[3, 3]]}}}", "give the cameras too"),
        ("- {action: insert, file: nowhere.ply, at: [0, 0, 0]}", "nowhere.ply"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_the_last_output_as_it_was(folder, capsys, edits, said):
    (folder / "out.ply").write_text("of the last run")
    assert edit(folder, "- {action: material, select: {object: 2}, hue: 9}\n" + edits) == 2
    lines = capsys.readouterr().err.splitlines()
    errors = [line for line in lines if line.startswith("tron-edit: ")]
    assert len(errors) == 1
    assert said in errors[0]
    assert "edit 2" in errors[0] or "nowhere" in said
    assert (folder / "out.ply").read_text() == "of the last run"


def commented(path: Path) -> list[str]:
    return [line for line in header_comments(path) if line.startswith(("tron up", "tron materials"))]


def test_what_was_guessed_is_said_once(folder, caplog):
    """The next command reads it from the file, and neither warns nor guesses again."""
    scene = GaussianScene.load(folder / "scene.ply")
    scene.up_guessed = True
    scene.save(folder / "scene.ply")
    assert edit(folder, "- {action: remove, select: {object: 3}}") == 0
    assert caplog.text.count("does not say which way is up") == 1
    caplog.clear()
    assert Scan.open(folder / "out.ply", materials="as_is").loaded.up.tolist() == scene.up.tolist()
    assert caplog.text == ""


def test_an_up_that_was_given_is_known_of_all_that_is_written(folder):
    scene = GaussianScene.load(folder / "scene.ply")
    scene.up_guessed = True
    scene.save(folder / "scene.ply")
    Scan.open(folder / "scene.ply", up=(0, 2, 0)).loaded.save(folder / "again.ply")
    assert commented(folder / "again.ply")[0] == "tron up 0.0 1.0 0.0"


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("sky", [False, True])
def test_materials_that_were_found_for_a_scan_are_in_its_edits(folder, caplog, monkeypatch, sky):
    """Those that tron-relight keeps beside it, of all but a sky, which has none."""
    scan = GaussianScene.load(folder / "scene.ply")
    scan.materials_guessed, scan.oriented = True, False
    scan.save(folder / "scene.ply")
    scan = GaussianScene.load(folder / "scene.ply")
    around = (scan.object_id == FLOOR) if sky else np.zeros(len(scan), bool)
    monkeypatch.setattr("tron.tracing.surroundings.find_surroundings", lambda scene: around)
    content = subset(scan, ~around)
    found = replace(content, metallic=np.full(len(content), 0.25), materials_guessed=False)
    comments = [f"materials {fingerprint(content, None)}"]
    write_ply(folder / "scene.materials.ply", vars(found) | {"normals": found.normals()}, comments)
    with caplog.at_level("INFO"):
        assert edit(folder, "- {action: material, select: {object: 2}, roughness: 0.9}") == 0
    out = GaussianScene.load(folder / "out.ply")
    assert not out.materials_guessed
    np.testing.assert_array_equal(out.metallic[~around], np.float32(0.25))
    np.testing.assert_array_equal(out.metallic[around], scan.metallic[around])
    np.testing.assert_array_equal(out.roughness[scan.object_id == BALL], np.float32(0.9))
    assert "materials are those of" in caplog.text
    assert "no materials of its own" not in caplog.text


def test_cameras_and_light_of_a_capture_go_with_the_scene(folder, tmp_path, caplog):
    """In another folder the next command would orbit elsewhere, and find no light of the capture."""
    (folder / "cameras.json").write_text(json.dumps({"names": ["a"], "cameras": [TOP.to_dict()]}))
    (folder / "environment.exr").write_bytes(b"of the capture")
    other = tmp_path / "other"
    for _ in range(2):
        caplog.clear()
        assert edit(folder, "- {action: remove, select: {object: 3}}", f"output={other}/out.ply") == 0
        for name in ("cameras.json", "environment.exr"):
            assert (other / name).read_bytes() == (folder / name).read_bytes()
        assert "of this scene" not in caplog.text
    (other / "environment.exr").write_bytes(b"of another capture")
    assert edit(folder, "- {action: remove, select: {object: 3}}", f"output={other}/out.ply") == 0
    assert (other / "environment.exr").read_bytes() == b"of another capture"
    assert f"{other / 'environment.exr'} is not of this scene" in caplog.text


def test_guessed_materials_are_not_edited_in_silence(folder, caplog):
    scene = GaussianScene.load(folder / "scene.ply")
    scene.materials_guessed = True
    scene.save(folder / "scene.ply")
    assert edit(folder, "- {action: material, select: {object: 2}, hue: 9}", "materials=as_is") == 0
    assert "give it materials=as_is too" in caplog.text
