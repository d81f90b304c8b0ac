"""Suites and methods on disk: what is written comes back, and every fault is found and named."""

# pyright: reportOptionalSubscript=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportOptionalOperand=false, reportReturnType=false, reportOperatorIssue=false
import json
import shutil
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image
from scipy.spatial.transform import Rotation

from eval.cli import cli, main
from eval.protocol.export import Photos, Synthetic, Tensoir, from_tensoir
from eval.protocol.method import Method, MethodFolder, write_method
from eval.protocol.pictures import Fault
from eval.protocol.suite import Suite, SuiteScene
from tron.captures import Capture, View
from tron.captures.folder import read_capture_folder, write_capture
from tron.color import linear_to_srgb
from tron.errors import TronError
from tron.io.images import encode_exr, write_image
from tron.seeds import generator
from tron.shading.environments.environment import EnvironmentMap
from tron.shards.schema import Clip

LINEAR = {"name": "ours", "color_space": "linear", "background": "black"}


@pytest.fixture(scope="module")
def suite(drawn_suite: Path) -> Suite:
    return Suite.load(drawn_suite)


@pytest.fixture
def method(suite: Suite, tmp_path: Path) -> MethodFolder:
    """The truth itself as a method's folder, linear, with albedo and normals."""
    folder = tmp_path / "ours"
    with write_method(folder, Method(suite=suite.id, **LINEAR)) as out:
        for scene in suite.scenes.values():
            for light in scene.lights:
                out.frames(scene.name, light, scene.truth(light))
            out.albedo(scene.name, scene.albedo())
            out.normals(scene.name, scene.normals())
    return MethodFolder.load(folder, suite)


def first(suite: Suite) -> SuiteScene:
    return next(iter(suite.scenes.values()))


def test_a_suite_comes_back_as_it_was_drawn(suite: Suite, drawn_clip: Callable[..., Clip]):
    scene = first(suite)
    assert list(suite.scenes) == ["drawn-000000", "drawn-000001"]
    assert [each.kind for each in suite.scenes.values()] == ["object", "table"]
    drawn = drawn_clip("dusk").frames
    np.testing.assert_array_equal(scene.truth("2_dusk"), drawn["rgb"].astype(np.float16))
    np.testing.assert_allclose(scene.normals(), drawn["normal_ref"], atol=1e-7)
    np.testing.assert_array_equal(scene.mask(), drawn["foreground"][..., 0])
    assert scene.light("1_noon").image[0, 0, 0] == 1.0
    capture = read_capture_folder(scene.train)
    # Two roads to the same cameras: the capture's writer and the suite's.
    for camera, view in zip(scene.cameras, capture.views, strict=True):
        np.testing.assert_allclose(camera.world_to_camera, view.camera.world_to_camera, atol=1e-12)
        assert camera.to_dict()["fx"] == pytest.approx(view.camera.fx, rel=1e-12)


def test_the_id_tells_suites_apart_by_what_is_judged(write_drawn_suite: Callable[..., Path], tmp_path: Path):
    first, again, more = (
        Suite.load(write_drawn_suite(tmp_path / name, frames=count)).id
        for name, count in (("a", 1), ("b", 1), ("c", 2))
    )
    assert first == again != more
    truth = next((tmp_path / "a" / "drawn-000000/truth/1_noon").iterdir())
    truth.write_bytes(encode_exr(np.zeros((32, 32, 3), np.float32)))
    with pytest.raises(TronError, match=f"are not those of {first}"):
        Suite.load(tmp_path / "a")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda file: file.update(tone_curve="filmic"), "tone_curve: Input should be 'agx' or 'srgb'"),
        (lambda file: file.update(surprise=1), "surprise: Extra inputs"),
        (lambda file: file["scenes"].update({"../out": deepcopy(file["scenes"]["drawn-000000"])}), "scenes"),
        (lambda file: file["scenes"].update({"gone": deepcopy(file["scenes"]["drawn-000000"])}), "gone"),
        (lambda file: file["scenes"]["drawn-000000"].update(frames=7), "2 test cameras do not fit"),
    ],
)
def test_a_damaged_suite_is_one_line(drawn_suite: Path, tmp_path: Path, change: Callable, words: str):
    folder = shutil.copytree(drawn_suite, tmp_path / "suite")
    file = yaml.safe_load((folder / "suite.yaml").read_text())
    change(file)
    (folder / "suite.yaml").write_text(yaml.safe_dump(file))
    with pytest.raises(TronError, match=words):
        Suite.load(folder)


def test_a_method_comes_back_and_goes_on(suite: Suite, method: MethodFolder):
    scene = first(suite)
    np.testing.assert_array_equal(method.frames(scene, "1_noon"), scene.truth("1_noon"))
    np.testing.assert_allclose(method.albedo(scene), scene.albedo(), atol=1e-6)
    np.testing.assert_array_equal(method.normals(scene), scene.normals())
    with write_method(method.folder, Method(suite=suite.id, **LINEAR)) as out:
        assert out.has(scene.name, "1_noon")
        assert not out.has(scene.name, "3_none")
        out.seconds(fit=2.0)
    assert MethodFolder.load(method.folder, suite).method.seconds.fit == 2.0
    with (
        pytest.raises(TronError, match="made with name=ours"),
        write_method(method.folder, Method(suite=suite.id, **(LINEAR | {"name": "other"}))),
    ):
        pass


@pytest.mark.parametrize("frame", ["opencv", "opengl"])
@pytest.mark.parametrize("suffix", [".exr", ".png"])
def test_normals_of_cameras_come_to_the_world(suite: Suite, tmp_path: Path, frame: str, suffix: str):
    scene = first(suite)
    x = np.zeros((2, 32, 32, 3), np.float32)
    x[..., 2] = -1.0 if frame == "opencv" else 1.0  # towards the camera, in either
    with write_method(tmp_path / "m", Method(suite=suite.id, normals=frame, **LINEAR)) as out:
        out.normals(scene.name, x, suffix)
    world = MethodFolder.load(tmp_path / "m", suite).normals(scene)
    for camera, found in zip(scene.cameras, world):
        np.testing.assert_allclose(found[0, 0], -camera.forward, atol=0.008 if suffix == ".png" else 1e-6)


def _png(mode: str, size: tuple[int, int] = (32, 32)) -> Callable[[Path], None]:
    def damage(path: Path) -> None:
        path.unlink()
        Image.new(mode, size).save(path.with_suffix(".png"))

    return damage


def _exr(value: float, shape: tuple[int, ...] = (32, 32, 3)) -> Callable[[Path], None]:
    return lambda path: path.write_bytes(encode_exr(np.full(shape, value, np.float32)))


FAULTS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "wrong sizes": ("wrong_size", _exr(0.5, (16, 32, 3))),
    "wrong size of PNG": ("wrong_size", _png("RGB", (8, 8))),
    "NaN": ("not_finite", _exr(np.nan)),
    "infinity": ("not_finite", _exr(np.inf)),
    "16-bit PNG": ("bit_depth", _png("I;16")),
    "palette": ("palette", _png("P")),
    "alpha": ("alpha", _png("RGBA")),
    "1-bit PNG": ("bit_depth", _png("1")),
    "brighter than display": ("out_of_range", _exr(1.5)),
    "no image": ("unreadable", lambda path: path.write_bytes(b"<html>")),
    "cut short": ("unreadable", lambda path: path.write_bytes(path.read_bytes()[:200])),
    "a missing light": ("missing_light", lambda path: shutil.rmtree(path.parent)),
    "a missing scene": ("missing_scene", lambda path: shutil.rmtree(path.parent.parent)),
    "a missing frame": ("missing_frame", lambda path: path.unlink()),
    "a frame too many": ("missing_frame", lambda path: shutil.copy(path, path.with_stem("0002"))),
    "two formats": (
        "mixed_suffixes",
        lambda path: Image.new("RGB", (32, 32)).save(path.with_name("0001.png")),
    ),
}


@pytest.mark.parametrize("case", FAULTS)
def test_every_fault_of_a_method_has_its_name(suite: Suite, tmp_path: Path, case: str):
    kind, damage = FAULTS[case]
    scene, folder = first(suite), tmp_path / "m"
    with write_method(folder, Method(suite=suite.id, **(LINEAR | {"color_space": "display"}))) as out:
        out.frames(scene.name, "1_noon", np.full((2, 32, 32, 3), 0.5))
    read = MethodFolder.load(folder, suite)
    read.frames(scene, "1_noon")
    path = folder / scene.name / "1_noon" / "0000.exr"
    if (case not in ("two formats", "a missing frame", "a frame too many") and "PNG" in case) or case in (
        "palette",
        "alpha",
    ):
        (path.parent / "0001.exr").unlink()
    damage(path)
    with pytest.raises(Fault) as found:
        read.frames(scene, "1_noon")
    assert found.value.kind == kind
    assert "\n" not in str(found.value)
    assert str(folder) in str(found.value)


def test_links_do_not_lead_out(suite: Suite, method: MethodFolder, tmp_path: Path):
    scene = first(suite)
    light = method.folder / scene.name / "1_noon"
    shutil.move(light, tmp_path / "elsewhere")
    light.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(Fault, match="leads out"):
        method.frames(scene, "1_noon")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            {"color_space": "filmic"},
            "color_space: Input should be 'linear', 'display' or 'srgb', not 'filmic'",
        ),
        ({"suite": "drawn-000000000000"}, "of suite drawn-000000000000, and the suite given is drawn-"),
        ({"name": "../x"}, "name"),
        ({"saw": ["everything"]}, "saw.0"),
        ({"color_space": "display", "scale": "scene"}, "cannot be scaled"),
    ],
)
def test_a_wrong_method_yaml_is_one_line(suite: Suite, method: MethodFolder, change: dict, words: str):
    path = method.folder / "method.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | change))
    with pytest.raises(TronError, match=words):
        MethodFolder.load(method.folder, suite)


def test_yaml_that_would_fill_the_memory_is_refused(suite: Suite, method: MethodFolder):
    lines = ["a: &a0 [x, x]", *(f"a{k}: &a{k} [*a{k - 1}, *a{k - 1}]" for k in range(1, 60))]
    (method.folder / "method.yaml").write_text("\n".join([*lines, "name: *a59"]))
    with pytest.raises(TronError, match="has aliases"):
        MethodFolder.load(method.folder, suite)


def test_linear_pictures_are_no_png(suite: Suite, method: MethodFolder):
    scene = first(suite)
    light = method.folder / scene.name / "1_noon"
    for path in light.iterdir():
        _png("RGB")(path)
    with pytest.raises(Fault, match="PNG pictures cannot be linear"):
        method.frames(scene, "1_noon")


def test_captures_of_tron_datagen_become_a_suite(suite: Suite, tmp_path: Path):
    """Laid out as mode=captures does: held-out views are judged, and no training view is one of them."""
    scene, made = first(suite), tmp_path / "made"
    rng = generator(0, "test", "captures")

    def views(space: str, names: list[str]) -> tuple[View, ...]:
        shots = zip(names, scene.cameras * 2)
        image = rng.random((32, 32, 3)).astype(np.float32)
        maps = (
            {}
            if space == "linear"
            else {"base_color": image / 2, "normal": np.eye(3)[np.zeros((32, 32), int)]}
        )
        return tuple(
            View(name, camera, image, space, mask=np.ones((32, 32)), **maps) for name, camera in shots
        )

    names = ["a", "b", "c", "d"]
    light = {"environment.exr": encode_exr(EnvironmentMap.constant(2.0).image, half=False)}
    beside = light | {"spec.json": json.dumps({"style": "object"}).encode()}
    capture = Capture(views("display", names), test=frozenset(("a", "c")))
    write_capture(made / "captures/test-000000", capture, beside=beside)
    for folder in ("test-000000_1_high", "test-000000_2_medium"):
        write_capture(
            made / "relit" / folder, Capture(views("linear", ["a", "c"]), exposure=0.3), beside=light
        )
    found = Synthetic(name="small", captures=made, recipe=[]).write(tmp_path / "suites")
    (exported,) = found.scenes.values()
    assert [view.name for view in read_capture_folder(exported.train).views] == ["b", "d"]
    assert exported.kind == "object"
    assert list(exported.lights) == ["1_high", "2_medium"]
    assert exported.lights["2_medium"].exposure == pytest.approx(0.3)
    relit = read_capture_folder(made / "relit/test-000000_2_medium").views
    np.testing.assert_array_equal(exported.truth("2_medium")[1], relit[1].read())
    np.testing.assert_allclose(exported.albedo()[0], capture.views[0].read("base_color"), atol=1e-3)
    with pytest.raises(TronError, match="folder is not empty"):
        Synthetic(name="small", captures=None, recipe=["mode=nonsense"]).write(tmp_path / "suites")
    shutil.rmtree(made / "relit")
    with pytest.raises(TronError, match="has no views under other lights"):
        Synthetic(name="again", captures=made, recipe=[]).write(tmp_path / "suites")


def test_captures_of_anyone_stand_under_maps_of_anyone(suite: Suite, tmp_path: Path):
    scene = first(suite)
    image = np.full((32, 32, 3), 0.5, np.float32)
    views = tuple(View(name, camera, image, "display") for name, camera in zip("abcd", scene.cameras * 2))
    write_capture(tmp_path / "mine/room", Capture(views, test=frozenset("c")))
    spot = np.zeros((16, 32, 3), np.float32)
    spot[8, 4] = 9.0
    for name in ("day", "night"):
        write_image(tmp_path / f"{name}.hdr", spot + 0.01)
    export = Photos(
        name="mine",
        captures=tmp_path / "mine",
        lights=[tmp_path / "day.hdr", tmp_path / "night.hdr"],
        turns_deg=[0.0, 90.0],
        max_side=None,
    )
    room = export.write(tmp_path / "suites").scenes["room"]
    assert list(room.lights) == ["0_day", "1_night"]
    assert not any(light.truth for light in room.lights.values())
    np.testing.assert_allclose(room.cameras[0].world_to_camera, views[2].camera.world_to_camera, atol=1e-12)
    assert [view.name for view in read_capture_folder(room.train).views] == ["a", "b", "d"]
    # Counter-clockwise seen from above: what came from east comes from north.
    day, night = (
        found.directions()[np.unravel_index(found.image[..., 0].argmax(), (16, 32))]
        for found in map(room.light, room.lights)
    )
    np.testing.assert_allclose(night[:2], [-day[1], day[0]], atol=1e-6)
    with pytest.raises(Fault, match="no truth"):
        room.truth("0_day")


def test_mip_nerf_360s_layout_is_read(suite: Suite, tmp_path: Path):
    """bicycle/sparse/0 beside bicycle/images_4, a quarter as large as cameras say; each eighth held out."""
    scene, folder = first(suite), tmp_path / "mip/bicycle"
    (folder / "sparse/0").mkdir(parents=True)
    (folder / "images_4").mkdir()
    camera, lines = scene.cameras[0], []
    whole = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    sizes = " ".join(str(4 * each) for each in whole)
    (folder / "sparse/0/cameras.txt").write_text(f"1 PINHOLE {sizes}\n")
    for k in range(9):
        pose = scene.cameras[k % len(scene.cameras)].world_to_camera
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        numbers = " ".join(map(repr, map(float, (w, x, y, z, *pose[:3, 3]))))
        lines += [f"{k + 1} {numbers} 1 DSC{k}.JPG", ""]
        write_image(
            folder / f"images_4/DSC{k}.JPG", np.full((camera.height, camera.width, 3), k / 9, np.float32)
        )
    (folder / "sparse/0/images.txt").write_text("\n".join(lines) + "\n")
    (folder / "sparse/0/points3D.txt").write_text("")
    write_image(tmp_path / "day.hdr", np.ones((16, 32, 3), np.float32))
    given = [f"export.captures={tmp_path / 'mip'}", f"export.lights=[{tmp_path / 'day.hdr'}]"]
    main(cli.compose("export=mip360", *given, f"output_dir={tmp_path / 'suites'}"))
    found = Suite.load(tmp_path / "suites/mip360").scenes["bicycle"]
    trained = {view.name for view in read_capture_folder(found.train).views}
    assert len(found.cameras) == 2
    assert trained == {f"DSC{k}" for k in range(1, 8)} or trained == {f"DSC{k}.JPG" for k in range(1, 8)}
    assert found.cameras[0].fx == pytest.approx(camera.fx)
    np.testing.assert_allclose(found.cameras[0].world_to_camera, scene.cameras[0].world_to_camera, atol=1e-9)


def write_tensoir(folder: Path, suite: Suite, lights: dict[str, str]) -> None:
    """A suite's first scene in TensoIR's own layout; ``lights``: TensoIR's name -> the suite's."""
    scene = first(suite)
    (folder / "Environment_Maps").mkdir(parents=True)
    for split in ("train", "test"):
        for k, camera in enumerate(scene.cameras):
            view = folder / "lego" / f"{split}_{k:03d}"
            view.mkdir(parents=True)
            turn = camera.camera_to_world @ np.diag([1, -1, -1, 1])
            angle = 2 * np.arctan(0.5 * camera.width / camera.fx)
            meta = {
                "imw": 32,
                "imh": 32,
                "cam_angle_x": angle,
                "cam_transform_mat": ",".join(map(repr, turn.ravel().tolist())),
            }
            (view / "metadata.json").write_text(json.dumps(meta))
            alpha = scene.mask()[k][..., None]
            for name, light in {"sunset": "1_noon", **lights}.items():
                shown = linear_to_srgb(np.clip(0.4 * scene.truth(light)[k], 0, 1))
                write_image(view / f"rgba_{name}.png", np.concatenate([shown, alpha], -1))
            write_image(view / "albedo.png", np.concatenate([scene.albedo()[k] ** (1 / 2.2), alpha], -1))
            write_image(
                view / "normal.png", np.concatenate([scene.normals()[k] / 2 + 0.5, alpha], -1), color=False
            )


def test_tensoirs_layout_is_read_back(suite: Suite, tmp_path: Path):
    scene = first(suite)
    write_tensoir(tmp_path / "root", suite, {"city": "2_dusk"})
    spot = np.zeros((16, 32, 3), np.float32)
    spot[8, 16] = (
        7.0  # TensoIR's middle column looks along +x: theta is pi at the left edge, -pi at the right
    )
    write_image(tmp_path / "root/Environment_Maps/city.hdr", spot)
    found = Tensoir(name="tensoir", root=tmp_path / "root", maps=None, lights=["city"]).write(
        tmp_path / "suites"
    )
    lego = found.scenes["lego"]
    mask = scene.mask() > 0.5
    shown = linear_to_srgb(np.clip(0.4 * scene.truth("2_dusk"), 0, 1))
    np.testing.assert_allclose(found.display(lego.truth("city"))[mask], shown[mask], atol=0.003)
    np.testing.assert_allclose(lego.albedo()[mask], scene.albedo()[mask], atol=0.01)
    np.testing.assert_allclose(lego.normals()[mask], scene.normals()[mask], atol=0.02)
    for ours, theirs in zip(lego.cameras, scene.cameras, strict=True):
        np.testing.assert_allclose(ours.world_to_camera, theirs.world_to_camera, atol=1e-9)
    assert len(read_capture_folder(lego.train).views) == 2
    assert read_capture_folder(lego.train).tone_curve == "srgb"
    light = from_tensoir(tmp_path / "root/Environment_Maps/city.hdr")
    brightest = light.directions()[np.unravel_index(light.image[..., 0].argmax(), (16, 32))]
    assert brightest @ (1, 0, 0) > 0.98
    with pytest.raises(TronError, match="no view has a photo under the light 'forest'"):
        Tensoir(name="again", root=tmp_path / "root", maps=None, lights=["forest"]).write(tmp_path / "suites")
    assert not (tmp_path / "suites/again").exists()
