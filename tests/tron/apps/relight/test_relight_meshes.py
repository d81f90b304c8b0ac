"""tron-relight meshes=[...]: models stand where they are told, in every buffer, and bad ones are one line."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from tron.apps.relight.cli import main
from tron.apps.relight.settings import Settings
from tron.gaussians.scene import GaussianScene
from tron.io.images import read_image

STILL = ("trajectory=still", "frames=1", "checkpoint=null", "exposure=1", "proxy=never", "distance=2")
SIZE = ("width=64", "height=64")
BUFFERS = "buffers=[lit,irradiance,position,normal,base_color,mask,share]"
SIDE, TALL = 2.0, 5.0  # of the model, in its own units


@pytest.fixture
def model(tmp_path) -> Path:
    """A red slab, y up as OBJ has it, about (10, 7.5, -3): SIDE x TALL x SIDE."""
    corners = [(x, y, z) for x in (9, 11) for y in (5, 10) for z in (-4, -2)]
    faces = ["1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4"]
    text = ["mtllib slab.mtl", "usemtl red", *(f"v {x} {y} {z}" for x, y, z in corners)]
    (tmp_path / "slab.obj").write_text("\n".join([*text, *(f"f {face}" for face in faces)]))
    (tmp_path / "slab.mtl").write_text("newmtl red\nKd 0.8 0.05 0.05\n")
    return tmp_path / "slab.obj"


@pytest.fixture
def film(relight, scene_path, light_path, tmp_path):
    """Films the ball with meshes beside it; gives the folder."""

    def film(*given: str, name: str = "out", scene: Path = scene_path) -> Path:
        base = [f"scene={scene}", f"environment={light_path}", f"output_dir={tmp_path / name}", BUFFERS]
        assert relight(*base, *STILL, *SIZE, *given) == 0
        return tmp_path / name

    return film


def read(folder: Path, name: str) -> np.ndarray:
    return read_image(folder / "frames" / f"0000.{name}.exr")


def on_model(folder: Path) -> np.ndarray:
    """(H, W) bool: pixels of the slab, which is redder than the ball."""
    color = read(folder, "base_color")
    return (color[..., 0] > 8 * color[..., 1]) & (read(folder, "mask")[..., 0] > 0.99)


def test_a_model_stands_upright_on_what_lies_below_in_every_buffer(film, model):
    folder = film(f"meshes=[{{file: {model}, at: [0.2, -0.8, 2], height: 0.5, turn: 30}}]")
    seen, position = on_model(folder), read(folder, "position")
    assert seen.sum() > 50
    points = position[seen]
    assert points[:, 2].max() < 0.5 + 0.02
    assert points[:, 2].max() > 0.4
    # Turned by 30 degrees about its foot, its half diagonal reaches as far.
    half = 0.5 * SIDE / TALL * 0.5
    offset = points[:, :2] - [0.2, -0.8]
    turn = np.radians(-30)
    own = offset @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    assert np.abs(own).max() < half + 0.01
    assert np.abs(own).max() > 0.9 * half
    np.testing.assert_allclose(read(folder, "mask")[seen], 1, atol=1e-2)
    np.testing.assert_allclose(read(folder, "share")[seen], 0, atol=1e-2)
    bare = film(name="bare")
    assert not on_model(bare).any()
    changed = np.abs(read(folder, "irradiance") - read(bare, "irradiance")).max(-1) > 0.05
    assert (changed & ~seen & (np.abs(position[..., 2]) < 0.02)).sum() > 10  # its shadow on the floor
    report = json.loads((folder / "relight.json").read_text())
    assert report["settings"]["meshes"][0]["height"] == 0.5


def test_a_scene_that_is_not_z_up_has_its_models_upright_too(film, model, scene_path, tmp_path):
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # y -> z
    scene = GaussianScene.load(scene_path)
    turned = scene.rotated(turn)
    turned.up = turn @ [0.0, 0, 1]
    turned.save(tmp_path / "turned.ply")
    at = turn @ [0.2, -0.8, 2]
    placed = f"meshes=[{{file: {model}, at: {[float(v) for v in at]}, height: 0.5}}]".replace(" ", "")
    other = film(placed, scene=tmp_path / "turned.ply", name="turned")
    folder = film(f"meshes=[{{file: {model}, at: [0.2, -0.8, 2], height: 0.5}}]")
    heights = [read(each, "position")[on_model(each)][:, 2] for each in (folder, other)]
    assert len(heights[0]) > 30
    assert len(heights[0]) == pytest.approx(len(heights[1]), abs=3)
    np.testing.assert_allclose(np.sort(heights[0])[-20:], np.sort(heights[1])[-20:], atol=2e-3)


def test_a_run_goes_on_with_the_same_models_alone(
    film, model, relight, scene_path, light_path, tmp_path, capsys
):
    given = f"meshes=[{{file: {model}, at: [0.2, -0.8, 2], height: 0.5}}]"
    folder = film(given)
    kept = (folder / "frames" / "0000.lit.exr").stat().st_mtime_ns
    film(given)
    assert (folder / "frames" / "0000.lit.exr").stat().st_mtime_ns == kept
    base = [
        f"scene={scene_path}",
        f"environment={light_path}",
        f"output_dir={folder}",
        BUFFERS,
        *STILL,
        *SIZE,
    ]
    assert relight(*base, given.replace("0.5", "0.6")) == 2
    assert "meshes" in capsys.readouterr().err


def test_models_move_and_the_last_frame_is_that_of_one_put_there(film, model, tmp_path):
    motion = tmp_path / "motion.yaml"
    keys = [{"time": 0}, {"time": 1, "by": [-0.3, 0.2, 0.25], "turn": 40}]
    motion.write_text(yaml.safe_dump({"meshes": [{"mesh": 2, "keys": keys}]}))
    still = f"{{file: {model}, at: [0.3, 0.8, 2], height: 0.4}}"

    def both(at: str) -> str:
        return f"meshes=[{still},{{file: {model}, height: 0.5, {at}}}]"

    folder = film(both("at: [0.2, -0.8, 2]"), f"motion={motion}", "frames=2", "fps=1")
    moved = both("at: [-0.1, -0.6, 0.25], turn: 40, standing: false")
    there = film(moved, f"cameras={folder / 'relight.json'}", "frames=2", name="there")
    for name in ("position", "normal", "base_color"):
        found, wanted = (read_image(each / "frames" / f"0001.{name}.exr") for each in (folder, there))
        np.testing.assert_allclose(found, wanted, atol=2e-3, err_msg=name)
    lit = [read_image(each / "frames" / "0001.lit.exr") for each in (folder, there)]
    assert np.abs(lit[0] - lit[1]).mean() < 0.01 * lit[1].mean()
    first = read_image(folder / "frames" / "0000.lit.exr")
    assert np.abs(first - lit[1]).mean() > 0.02 * lit[1].mean()


@pytest.mark.parametrize(
    ("paths", "words"),
    [
        ([{"mesh": 2, "keys": [{"time": 1}]}], "there is no mesh 2"),
        ([{"mesh": 1, "keys": [{"time": 1}]}] * 2, "mesh 1 moves already"),
    ],
)
def test_motions_of_no_mesh_are_one_line(
    model, relight, scene_path, light_path, tmp_path, capsys, paths, words
):
    motion = tmp_path / "motion.yaml"
    motion.write_text(yaml.safe_dump({"meshes": paths}))
    base = [f"scene={scene_path}", f"environment={light_path}", f"output_dir={tmp_path / 'out'}"]
    meshes = f"meshes=[{{file: {model}, at: [0.2, -0.8, 2], height: 0.5}}]"
    assert relight(*base, *STILL, *SIZE, meshes, f"motion={motion}") == 2
    assert words in capsys.readouterr().err.strip().splitlines()[-1]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("missing", "file not found"),
        ("no faces", "no opaque triangles"),
        ("no texture", "missing.png"),
        ("scale: 1000", "say how high it is"),
        ("scale: 1e-6", "say how high it is"),
        ("heigth: 0.5", "did you mean"),
        ("height: 0.5, scale: 2", "leave one of the two out"),
        ("at: [50, 0, 1]", "nothing lies below"),
    ],
)
def test_bad_models_are_one_line(model, relight, scene_path, light_path, tmp_path, capsys, change, words):
    at = "at: [0.2, -0.8, 2]"
    if change == "missing":
        model.unlink()
    elif change == "no faces":
        model.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    elif change == "no texture":
        corners = re.sub(
            r"^(f .*)$", lambda line: re.sub(r"(\d)", r"\1/1", line[1]), model.read_text(), flags=re.M
        )
        model.write_text("vt 0 0\n" + corners)
        model.with_suffix(".mtl").write_text("newmtl red\nmap_Kd missing.png\n")
    elif change.startswith("at"):
        at, change = f"{change}, height: 0.5", ""
    else:
        at = f"{at}, {change}"
    base = [
        f"scene={scene_path}",
        f"environment={light_path}",
        f"output_dir={tmp_path / 'out'}",
        *STILL,
        *SIZE,
    ]
    assert relight(*base, "ground=none", f"meshes=[{{file: {model}, {at}}}]") == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("tron-relight: ")
    assert words in error


def test_settings_from_python_take_models_too(model, scene_path, light_path, tmp_path, variant):
    placed = {"file": model, "at": (0.2, -0.8, 2), "height": 0.5}
    settings = Settings.model_validate(
        {"scene": scene_path, "environment": light_path, "output_dir": tmp_path / "out", "frames": 1}
        | {"width": 32, "height": 32, "checkpoint": None, "variant": variant, "meshes": [placed]}
    )
    main(settings)
    assert (tmp_path / "out" / "frames" / "0000.relit.png").is_file()
