"""Splats as a capture: pictures and depths are those of the surfaces, whichever way the disks were turned."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import plyfile
import pytest

from tron.apps.reconstruct.cli import cli
from tron.apps.reconstruct.settings import SplatSettings
from tron.apps.reconstruct.splat_capture import film_splats, is_splats, keeps_surfels, virtual_cameras
from tron.errors import TronError
from tron.gaussians.fields import FIELDS
from tron.gaussians.ply import MATERIAL_PROPERTIES
from tron.gaussians.scene import GaussianScene, quats_from_normals
from tron.reconstruction.progress import untracked
from tron.reconstruction.settings import FusionSettings
from tron.seeds import generator
from tron.tracing import SurfelTracer

SMALL = SplatSettings(views=9, side=32)


def dense(scene: GaussianScene) -> GaussianScene:
    """The scene closed, though its kernel is that of 3DGS."""
    return replace(scene, log_scales=scene.log_scales + np.log(2), kernel_degree=2)


def as_plain(scene: GaussianScene, path: Path) -> Path:
    """A PLY of 3DGS: no materials, no comments, half of the disks turned over."""
    scene.turned_over(generator(0, "test plain").random(len(scene)) < 0.5).save(path)
    vertex = plyfile.PlyData.read(str(path))["vertex"].data
    kept = [name for name in vertex.dtype.names if name not in (*MATERIAL_PROPERTIES, "object_id")]
    rows = np.empty(len(vertex), dtype=[(name, "<f4") for name in kept])
    for name in kept:
        rows[name] = vertex[name]
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")], byte_order="<").write(str(path))
    return path


@pytest.fixture(scope="module")
def plain(ball_on_floor, tmp_path_factory) -> Path:
    return as_plain(dense(ball_on_floor()), tmp_path_factory.mktemp("plain") / "scan.ply")


def test_pictures_and_depths_are_those_of_the_oriented_surfaces(variant, ball_on_floor, plain):
    settings = SplatSettings(views=17, side=48)
    capture = film_splats(plain, settings, (0, 0, 2), 8, FusionSettings(), 0, untracked)
    tracer = SurfelTracer(dense(ball_on_floor()))
    assert capture.up.tolist() == [0, 0, 1]
    assert capture.test == {"film_00000", "film_00008", "film_00016"}
    for view in capture.views:
        assert view.camera.position[2] > 0
        true = tracer.gbuffer(view.camera).numpy()
        solid = (true["opacity"] > 0.99) & (view.read("mask") > 0.99)
        assert solid.mean() > 0.3
        assert np.abs(view.read() - true["rgb"])[solid].mean() < 0.02
        assert view.has("depth") == (view.name not in capture.test)
        if view.has("depth"):
            known = solid & (view.read("depth") > 0)
            assert known.sum() > 0.7 * solid.sum()
            # The ball's far side faces the camera too, behind its near one: at its rim they meet.
            assert np.quantile(np.abs(view.read("depth") - true["depth"])[known], 0.9) < 0.06


def test_every_side_of_a_thing_is_filmed_and_nothing_from_below_a_floor(ball_on_floor):
    scene = ball_on_floor()
    above = virtual_cameras(scene, SplatSettings(views=32), 0)
    assert min(camera.position[2] for camera in above) > 0
    ball = virtual_cameras(replace_surfels(scene, scene.object_id == 1), SplatSettings(views=32), 0)
    positions = np.stack([camera.position for camera in ball]) - [0, 0, 0.5]
    positions /= np.linalg.norm(positions, axis=1, keepdims=True)
    assert positions[:, 2].min() < -0.4
    assert positions[:, 2].max() > 0.9
    for axis in np.concatenate([np.eye(3)[:2], -np.eye(3)[:2]]):
        assert (positions @ axis).max() > 0.8


def replace_surfels(scene: GaussianScene, which: np.ndarray) -> GaussianScene:
    arrays = ("means", "quats", "log_scales", "opacity_logits", "sh", "base_color", "roughness", "metallic")
    return replace(
        scene, object_id=scene.object_id[which], **{name: getattr(scene, name)[which] for name in arrays}
    )


def room(spacing: float = 0.2) -> GaussianScene:
    """The walls of a box of 4 x 4 x 2 around the origin, facing inwards."""
    side = np.arange(-1, 1 + spacing / 4, spacing / 2)
    u, v = (x.ravel() for x in np.meshgrid(side, side))
    means, normals = [], []
    for axis in range(3):
        for sign in (-1, 1):
            wall = np.insert(np.stack([u, v], 1), axis, sign, axis=1)
            means.append(wall * [2, 2, 1])
            normals.append(np.tile(-sign * np.eye(3)[axis], (len(u), 1)))
    count = sum(map(len, means))
    return GaussianScene(
        means=np.concatenate(means),
        quats=quats_from_normals(np.concatenate(normals)),
        log_scales=np.full((count, 2), np.log(0.6 * spacing)),
        opacity_logits=np.full(count, 4.0),
        sh=np.zeros((count, 16, 3)),
        base_color=np.full((count, 3), 0.5),
        roughness=np.full(count, 0.5),
        metallic=np.zeros(count),
        object_id=np.zeros(count, np.int32),
        spacing=spacing,
    )


def test_rooms_are_filmed_from_free_places_inside(variant):
    scene = room()
    cameras = virtual_cameras(scene, SplatSettings(cameras="inside", views=24, side=16), 0)
    assert len(cameras) == 24
    positions = np.stack([camera.position for camera in cameras])
    assert (np.abs(positions) < [1.8, 1.8, 0.8]).all()
    assert len(np.unique(positions.round(6), axis=0)) == 3
    ahead = np.stack([camera.camera_to_world[:3, 2] for camera in cameras])
    for axis in np.concatenate([np.eye(3)[:2], -np.eye(3)[:2]]):
        assert (ahead @ axis).max() > 0.8
    tracer = SurfelTracer(scene)
    assert np.mean([tracer.gbuffer(camera).numpy()["opacity"].mean() for camera in cameras[::5]]) > 0.95
    both = virtual_cameras(scene, SplatSettings(cameras="both", views=10, side=16), 0)
    inside = [(np.abs(camera.position) < [2, 2, 1]).all() for camera in both]
    assert inside == [False] * 5 + [True] * 5


def test_what_is_no_plain_file_of_splats_is_one_line(tmp_path, plain):
    packed = tmp_path / "scan.spz"
    packed.write_bytes(b"\x1f\x8b")
    assert is_splats(packed)
    with pytest.raises(TronError, match=r"cannot be read as Niantic's \.spz"):
        film_splats(packed, SMALL, None, 8, FusionSettings(), 0, untracked)
    points = tmp_path / "points.ply"
    points.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n")
    with pytest.raises(TronError, match="lacks y"):
        film_splats(points, SMALL, None, 8, FusionSettings(), 0, untracked)
    assert not is_splats(tmp_path)


QUICK = [
    "steps_scaler=0.001",
    "initial.count=200",
    "radiance.density.most=300",
    "light=null",
    "report=null",
    "threads=1",
]


def test_a_file_that_does_not_say_its_up_is_told(variant, plain, caplog):
    capture = film_splats(plain, SMALL, None, 0, FusionSettings(), 0, untracked)
    assert capture.up.tolist() == [0, -1, 0]
    assert not capture.test
    assert "does not say which way is up" in caplog.text


def test_paths_go_about_the_up_of_the_file(ball_on_floor):
    lying = ball_on_floor().rotated(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]))
    heights = [camera.position @ lying.up for camera in virtual_cameras(lying, SplatSettings(views=16), 0)]
    assert min(heights) > 0.3


def test_the_command_makes_a_plain_file_relightable(variant, plain, tmp_path):
    with pytest.raises(SystemExit) as end:
        cli(
            [f"capture={plain}", "splats.views=9", "splats.side=32", *QUICK, "splats.geometry=new",
             f"output_dir={tmp_path / 'out'}"]
        )  # fmt: skip
    assert end.value.code == 0
    scene = GaussianScene.load(tmp_path / "out" / "scene.ply")
    assert scene.oriented
    assert not scene.materials_guessed
    assert scene.up.tolist() == [0, -1, 0]


def test_a_thin_scan_is_learnt_anew_and_a_thick_one_keeps_its_surfels(variant, plain, caplog):
    caplog.set_level("INFO")
    thin = GaussianScene.load(plain)
    layers = {name: np.concatenate([getattr(thin, name)] * 12) for name in FIELDS}
    depths = np.repeat(np.arange(12) - 6, len(thin)) * thin.spacing
    layers["means"] = layers["means"] - depths[:, None] * np.tile(thin.normals(), (12, 1))
    fog = replace(thin, **layers | {"opacity_logits": np.full(12 * len(thin), -0.5)})
    assert [keeps_surfels(each, "auto", None) for each in (thin, fog)] == [False, True]
    assert "splats.geometry=scan keeps its own" in caplog.messages[0]
    assert "splats.geometry=new learns others" in caplog.messages[1]
    assert keeps_surfels(thin, "scan", None)
    assert not keeps_surfels(fog, "new", None)


@pytest.fixture
def few_views(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"VIEWS": 12, "SIDE": 64}.items():
        monkeypatch.setattr(f"tron.relighting.proxy.{name}", value)


@pytest.mark.long
@pytest.mark.usefixtures("few_views", "variant")
def test_the_command_keeps_every_surfel_and_finds_the_light(plain, tmp_path, caplog):
    """From the folder's own cameras.json, whose views are filmed again."""
    caplog.set_level("INFO")
    folder = tmp_path / "model"
    folder.mkdir()
    scan = Path(shutil.copy(plain, folder / "scan.ply"))
    cameras = virtual_cameras(GaussianScene.load(plain).upright(), SplatSettings(views=20), 0)
    lying = [replace(camera, width=64, height=48, cy=24.0, cx=32.0) for camera in cameras]
    (folder / "cameras.json").write_text(json.dumps([camera.to_dict() for camera in lying]))
    out = tmp_path / "out"
    with pytest.raises(SystemExit) as end:
        cli([f"capture={scan}", "up=[0,0,1]", "splats.views=12", "splats.side=48", "threads=1",
             "report.frames=0", "prior.light.points=300", "prior.light.steps=20",
             "splats.geometry=scan", f"output_dir={out}"])  # fmt: skip
    assert end.value.code == 0
    found, before = GaussianScene.load(out / "scene.ply"), GaussianScene.load(scan)
    for name in ("means", "log_scales", "opacity_logits", "sh"):
        np.testing.assert_array_equal(getattr(found, name), getattr(before, name), err_msg=name)
    assert not found.materials_guessed
    assert not found.oriented
    report = json.loads((out / "metrics.json").read_text())
    assert report["first_surfels"]["source"] == "scan"
    assert report["materials_learnt"] == ["base_color", "roughness", "metallic"]
    assert len(report["light"]["balance"]) == 3
    assert report["test"]["psnr"] > 30, "the scan looks as it did"
    assert (out / "environment.exr").is_file()
    kept = json.loads((out / "cameras.json").read_text())["cameras"]
    assert (len(kept), kept[0]["width"], kept[0]["height"]) == (12, 48, 36)
    assert "the scan looks as it did to" in caplog.text
    page = (out / "report.html").read_text()
    assert f"All {len(before):,} surfels of the scan were kept" in page
    assert "Under the light that was found it looks as it did to" in page
