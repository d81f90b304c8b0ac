"""The benchmark `exchange`: other programs' readers against what was written, and all of it at toy sizes."""

import os
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from eval.cli import cli
from eval.exchange import readers, splats
from eval.exchange.mesh import FILLED, METRICS, View, mesh_rows, true_maps
from eval.exchange.models import METRIC, Pair, model_rows
from eval.exchange.playcanvas import lacking
from eval.exchange.splats import FORMATS, Baked, alike, draw, equal_share, exchange, find_readers
from eval.exchange.viewer import measure_viewer
from eval.renderers.blender import Seen, lat_long
from eval.report.outcome import Outcome
from eval.results import Results
from tron.cameras import Camera
from tron.errors import TronError
from tron.gaussians.formats.registry import WRITTEN
from tron.gaussians.harmonics import eval_sh, spread_directions
from tron.gaussians.scene import GaussianScene
from tron.gaussians.splat_files import write_splats
from tron.models.parts import Part
from tron.models.shapes import textured
from tron.shading.environments.environment import EnvironmentMap

pytestmark = pytest.mark.usefixtures("variant")
BLENDER = os.environ.get("TRON_BLENDER_PYTHON")
"""A Python that has bpy, of an environment of its own."""


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as end:
        cli(["benchmark=exchange", *arguments])
    return int(end.value.code or 0)


@pytest.fixture(scope="module")
def world() -> Baked:
    """A small one; its cameras are small too."""
    made = Baked.drawn(1, 1500, 9)
    return replace(made, cameras=[camera.resized(48, 48) for camera in made.cameras[:2]])


def test_every_format_that_is_written_is_exchanged():
    assert {each.suffix for each in FORMATS if each.ours} == set(WRITTEN)
    assert {each.reader for each in FORMATS} == set(find_readers(None))


@pytest.mark.parametrize("suffix", [".glb", ".usda", ".usdz"])
def test_what_other_libraries_read_is_what_was_written(world, tmp_path: Path, suffix: str):
    file, other = tmp_path / f"a{suffix}", tmp_path / "b.ply"
    write_splats(file, world.scene)
    (readers.trimesh_gltf if suffix == ".glb" else readers.usd_core)(file, other)
    found, wanted = GaussianScene.load(other), world.standing().plain
    np.testing.assert_allclose(found.means, wanted.means, atol=1e-5)
    np.testing.assert_allclose(np.sort(found.log_scales), np.sort(wanted.log_scales), atol=1e-4)
    np.testing.assert_allclose(found.opacities(), wanted.opacities(), atol=1e-5)
    for direction in spread_directions(4):
        seen = np.broadcast_to(direction, found.means.shape)
        np.testing.assert_allclose(eval_sh(found.sh, seen), eval_sh(wanted.sh, seen), atol=1e-4)


def test_a_trip_tells_a_sound_file_from_one_whose_colours_changed(world, tmp_path: Path):
    glb = next(each for each in FORMATS if each.name == "glb")
    standing = world.standing()
    plain, own = (draw(each, standing.cameras) for each in (standing.plain, standing.scene))
    sound = exchange(glb, readers.trimesh_gltf, world.scene, standing, plain, own, tmp_path)
    assert min(sound.psnr) > 50
    assert max(sound.scene_psnr) < min(sound.psnr)  # degree 2 is lost, and the side that a surfel shows
    assert sound.size == (tmp_path / "glb.glb").stat().st_size
    assert sound.write is not None
    assert sound.read is not None
    changed = replace(world.scene, sh=world.scene.sh + np.float32(0.1))
    assert max(exchange(glb, readers.trimesh_gltf, changed, standing, plain, own, tmp_path).psnr) < 40


def test_values_of_a_ply_are_compared_bit_by_bit(world, tmp_path: Path):
    write_splats(tmp_path / "a.ply", world.scene)
    means = world.scene.means.copy()
    means[0, 0] = np.nextafter(means[0, 0], np.float32(9))
    write_splats(tmp_path / "b.ply", replace(world.scene, means=means))
    assert equal_share(tmp_path / "a.ply", tmp_path / "a.ply") == 1
    share = equal_share(tmp_path / "a.ply", tmp_path / "b.ply")
    assert 0 < 1 - share < 2 / means.size


def test_splats_without_a_sign_are_seen_from_both_sides(world):
    over = world.plain.turned_over(np.arange(len(world.plain)) % 2 == 0)
    assert min(alike(draw(over, world.cameras), draw(world.plain, world.cameras))) > 60
    signed = draw(replace(over, oriented=True), world.cameras)
    assert max(alike(signed, draw(world.plain, world.cameras))) < 30


def test_a_program_that_fails_is_named_with_its_words(world, tmp_path: Path, monkeypatch):
    monkeypatch.setattr(splats, "ROUNDS", 1)
    failing = tmp_path / "fails"
    failing.write_text("#!/bin/sh\necho no such thing >&2\nexit 3\n")
    failing.chmod(0o755)
    write_splats(tmp_path / "a.ply", world.scene)
    with pytest.raises(TronError, match="no such thing"):
        readers.splat_transform(failing, tmp_path / "a.ply", tmp_path / "b.ply")
    found = splats.Splats()
    programs = find_readers(None)
    programs["splat_transform"] = splats.Reader("it", partial(readers.splat_transform, failing))
    splats._measure_world(world, programs, found, tmp_path)
    assert "no such thing" in found.lacking["spz"]
    assert set(found.trips) == {each.name for each in FORMATS if each.stands}
    assert found.rasteriser["world_1"][0] > 20


def test_blenders_pictures_of_light_look_along_x():
    image = np.zeros((64, 128, 3), np.float32)
    light = EnvironmentMap(image)
    for direction, row, column in (((1, 0, 0), 32, 64), ((0, 1, 0), 32, 32), ((0.1, 0, 1), 2, 64)):
        toward = light.directions() @ (np.array(direction) / np.linalg.norm(direction))
        spot = lat_long(EnvironmentMap(np.repeat((toward > 0.99)[..., None], 3, 2).astype(np.float32)))[
            ..., 0
        ]
        rows, columns = np.nonzero(spot > 0.5)
        assert abs(rows.mean() - row) < 2.5
        assert abs(columns.mean() - column) < 2.5


def test_a_scan_is_seen_as_viewers_show_it_and_not_as_disks(world, tmp_path: Path):
    write_splats(tmp_path / "little-scan.ply", world.plain)
    outcome = Outcome(tmp_path)
    measure_viewer([tmp_path / "little-scan.ply"], world, 2, [40, 56], None, tmp_path, 0, outcome)
    rows = {row.metric: row for row in outcome.rows}
    assert rows["viewer.worst"].value > 40 > rows["viewer.disks_psnr"].value
    assert rows["viewer.psnr"].value == pytest.approx(rows["viewer.little_scan.psnr"].value)
    assert rows["viewer.psnr"].n == 4
    assert rows["viewer.worst"].value <= rows["viewer.little_scan.psnr"].value
    assert min(rows[f"viewer.harmonics_{degree}.psnr"].value for degree in (1, 2, 3)) > 40
    assert (tmp_path / "pictures" / "viewer.png").is_file()


@pytest.mark.parametrize(("engine", "words"), [(None, "npm install playcanvas"), (Path("no"), "npm install")])
def test_a_viewer_that_is_not_there_is_named_with_how_to_get_it(engine, words):
    assert words in (lacking(engine) or "")


def square(tilt: float = 0.0) -> Part:
    """Before a camera at -y: one side is red, in a mesh of two triangles."""
    corners = np.array([[-1.0, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]])
    normals = np.tile([np.sin(tilt), -np.cos(tilt), 0], (4, 1))
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return Part(corners, normals, faces, None, np.array([0.5, 0.1, 0.1], np.float32), 0.5, 0.0, None)


def test_true_maps_and_rows_of_a_square_are_what_it_is():
    camera = Camera.look_at((0, -4, 0), (0, 0, 0), fov_deg=40, width=24, height=24)
    tilt = np.radians(12)
    truth = true_maps([textured(square(tilt), "square")], camera)
    inside = truth.opacity > FILLED
    assert 0.3 < inside.mean() < 0.6
    np.testing.assert_allclose(truth.base_color[inside], [[0.5, 0.1, 0.1]] * inside.sum(), atol=1e-5)
    flat = np.where(inside[..., None], [0, -1.0, 0], 0)
    seen = Seen(np.ones((24, 24, 3)), flat, truth.base_color + 0.1, truth.opacity)
    view = View("sun", 1.0, truth, seen, np.ones((24, 24, 3)), np.zeros((24, 24, 3)))
    rows = {row.metric: row.value for row in mesh_rows([view])}
    assert rows["mesh.base_color_psnr"] == pytest.approx(20, abs=0.01)
    assert rows["mesh.normal_mae_deg"] == pytest.approx(12, abs=0.01)
    assert rows["mesh.relight_psnr"] == 100
    assert rows["mesh.relight_traced_psnr"] < 10
    assert rows["mesh.covered"] == 1


def test_pairs_of_renderers_are_compared_where_the_model_is():
    filled, grey = np.arange(64).reshape(8, 8) % 2 == 0, np.full((8, 8, 3), 0.2)
    pairs = [
        Pair("Some-Model", "sun", 1.0, np.where(filled[..., None], factor * grey, 9.0), grey, filled)
        for factor in (1.0, 1.1)
    ]
    rows = {row.metric: row.value for row in model_rows(pairs)}
    assert rows["blender.ratio.some_model_sun"] == pytest.approx(1.1)
    assert pairs[0].psnr == 100 > pairs[1].psnr > 20
    assert rows["blender.worst"] == pairs[1].psnr
    assert rows["blender.psnr"] == pytest.approx((pairs[0].psnr + pairs[1].psnr) / 2)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("benchmark.splat_transform=nothing", "no such program"),
        ("benchmark.blender_python=nothing", "cannot be run"),
        (f"benchmark.blender_python={shutil.which('python3')}", "no Blender"),
        ("benchmark.real_data=nothing", "no such folder"),
    ],
)
def test_what_is_given_and_not_there_is_one_line(tmp_path: Path, capsys, given: str, words: str):
    out = tmp_path / "out"
    assert run("benchmark.real_data=null", given, f"output_dir={out}") == 2
    assert words in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.long
def test_the_whole_benchmark_runs_and_names_what_is_absent(tmp_path: Path, monkeypatch, shared_data: Path):
    monkeypatch.setattr(splats, "SIDE", 48)
    monkeypatch.setattr(splats, "VIEWS", 1)
    monkeypatch.setattr(splats, "ROUNDS", 1)
    toy = [
        "worlds=1",
        "surfels=1500",
        "mesh_surfels=3000",
        "views=1",
        "width=48",
        "paths=4",
        "texture=128",
        "model_paths=4",
    ]
    write_splats(tmp_path / "scan.ply", Baked.drawn(1, 1500, 9).plain)
    toy += [f"scans=[{tmp_path / 'scan.ply'}]", "scan_views=2", "scan_sides=[40]"]
    toy += [f"real_data={shared_data}", "seed=9"] + ([f"blender_python={BLENDER}"] if BLENDER else [])
    out = tmp_path / "out"
    assert run(*(f"benchmark.{each}" for each in toy), f"output_dir={out}") == 0
    results = Results.load(out / "results.json")
    measured = {row.metric for row in results.rows}
    absent = {target.metric for target in results.targets} - measured
    program = readers.find_splat_transform(None)
    expected = {"viewer.playcanvas.behind"} | (set() if BLENDER else {*METRICS, METRIC})
    if program is None:
        expected |= {f"format.{name}" for name in ("ply.psnr", "ply.bit_equal", "spz.psnr", "sog.psnr")}
    assert absent == expected
    assert absent <= set(results.absent)
    assert (results.value("format.glb.psnr") or 0) > 50
    page = (out / "report.html").read_text()
    assert '<section id="formats">' in page
    assert list((out / "pictures").glob("formats-*.png"))
    assert bool(BLENDER) == bool(list((out / "pictures").glob("mesh-*.png")))
    assert ("blender_python is not given" in page) == (BLENDER is None)
