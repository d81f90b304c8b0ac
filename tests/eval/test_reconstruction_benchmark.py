"""The reconstruction benchmark: lights against closed forms, orchestration."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from eval import stages as stages_module
from eval.cli import cli
from eval.reconstruction.light import brightest_direction, irradiance, light_errors, sun_error_deg, texels
from eval.reconstruction.runs import Report, Run, light_rows, read_report, rows_of
from eval.results import Results
from eval.tracing.scene import surfels
from tron.captures import Capture, View
from tron.captures.folder import write_capture
from tron.errors import TronError
from tron.io.images import encode_exr, write_image
from tron.seeds import generator
from tron.shading import EnvironmentMap
from tron.tracing import SurfelTracer
from tron.trajectories import spiral

SCENE = "test-000000"
SCENE_FIGURES = ("test_psnr", "normal_mae_deg", "base_color_psnr", "surfels", "seconds")


def unit(count: int) -> np.ndarray:
    normals = generator(0, "test normals").normal(size=(count, 3))
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def sky(height: int = 96) -> EnvironmentMap:
    """Smooth, different in every direction and channel: 1 + a . d."""
    map_ = EnvironmentMap.constant(1.0, height)
    polar = np.arange(height)[:, None] * np.pi / (height - 1)
    around = (np.arange(2 * height) + 0.5)[None] * np.pi / height
    x, y = np.sin(polar) * np.sin(around), np.sin(polar) * np.cos(around)
    z = np.cos(polar) + 0 * around
    tilt = np.array([[0.5, 0.1, -0.3], [0.0, 0.6, 0.2], [-0.4, 0.2, 0.5]])
    return replace(map_, image=(1 + np.stack([x, y, z], -1) @ tilt).astype(np.float32))


def test_irradiance_is_the_cosine_integral(variant: str):
    normals = unit(40)
    light = sky()
    found, even = irradiance([light, EnvironmentMap.constant(0.7)], normals)
    np.testing.assert_allclose(even, 0.7, rtol=2e-3)
    # The integral of (1 + a . d) max(n . d, 0) / pi over the sphere is 1 + 2/3 a . n; a from lookups.
    tilt = np.stack([light.lookup(axis) - light.lookup(-axis) for axis in np.eye(3)]) / 2
    np.testing.assert_allclose(found, 1 + normals @ tilt * 2 / 3, rtol=2e-3)


def test_light_errors_know_scale_from_direction(variant: str):
    light = sky()
    assert light_errors(light, light) == pytest.approx({"irradiance_error": 0, "scaled_error": 0}, abs=1e-9)
    dimmed = light_errors(replace(light, image=light.image * 0.6), light)
    assert dimmed["irradiance_error"] == pytest.approx(0.4, abs=1e-5)
    assert dimmed["scaled_error"] == pytest.approx(0, abs=1e-5)
    turned = light_errors(light.rotated(90), light)
    assert turned["scaled_error"] > 0.1
    assert turned["scaled_error"] <= turned["irradiance_error"]
    assert light_errors(replace(light, image=0 * light.image), light)["irradiance_error"] == 1


def test_the_brightest_spot_is_found_finer_than_a_texel(variant: str):
    directions, _ = texels(EnvironmentMap.constant(0.3, 96))
    for towards in unit(2):
        near = (directions @ towards > np.cos(np.radians(4.0))).reshape(96, 192, 1)
        sun = replace(EnvironmentMap.constant(0.3, 96), image=np.float32(0.3 + 300 * near) * np.ones(3, "f4"))
        assert np.degrees(np.arccos(brightest_direction(sun) @ towards)) < 0.8
    straight_up = brightest_direction(sun)[2]
    turned = sun_error_deg(sun.rotated(40), sun)
    # A turn about z moves a direction by less than its angle, the less the higher it stands.
    chord = 2 * np.sqrt(1 - straight_up**2) * np.sin(np.radians(20))
    assert turned == pytest.approx(np.degrees(2 * np.arcsin(chord / 2)), abs=0.8)


def test_light_rows_keep_suns_apart():
    here, light = Path(), {"irradiance_error": 9.0, "scaled_error": 0.1}
    runs = [
        Run("a-1", here, here, report(), 7.0, light, "overcast"),
        Run("b-2", here, here, report(), 7.0, light | {"scaled_error": 0.5, "sun_direction_deg": 4.0}, "sun"),
        Run("c-3", here, here, report(), 7.0),
    ]
    found = {row.metric: row.value for row in light_rows("reconstruction.photos", runs)}
    assert found == pytest.approx(
        {
            "reconstruction.photos.irradiance_error": 0.3,
            "reconstruction.photos.irradiance_error_soft": 0.1,
            "reconstruction.photos.irradiance_error_sun": 0.5,
            "reconstruction.photos.sun_direction_deg": 4.0,
        }
    )
    assert not list(light_rows("reconstruction.photos", runs[2:]))


def report(**test: float) -> Report:
    return Report.model_validate(
        {
            "capture": {"views": 9, "held_out": ["a", "b"]},
            "surfels": int(test.pop("surfels", 10)),
            "test": {"psnr": 30.0, **test},
            "train": {"psnr": 31.0, "views": 7},
            "views": {},
            "seconds": {"surfels": 3.0, "light": 2.0},
            "something else": 1,
        }
    )


def test_rows_are_means_but_the_most_of_seconds_and_surfels():
    here = Path()
    runs = [
        Run("a-1", here, here, report(psnr=30, surfels=10, ssim=0.5), 7.0, {"irradiance_error": 0.1}),
        Run("b-2", here, here, report(psnr=20, surfels=30), 5.0, {"irradiance_error": 0.3}),
    ]
    found = {row.metric: row for row in rows_of("reconstruction", runs)}
    assert found["reconstruction.test_psnr"].value == 25
    assert found["reconstruction.test_psnr"].n == 2
    assert (found["reconstruction.test_psnr"].low, found["reconstruction.test_psnr"].high) == (20, 30)
    assert found["reconstruction.light.irradiance_error"].scenes == 2
    assert all(row.low is None for name, row in found.items() if "seconds" in name or name.endswith("_2"))
    assert found["reconstruction.test_psnr.b_2"].value == 20
    assert found["reconstruction.surfels"].value == 30
    assert found["reconstruction.seconds"].value == 7
    assert found["reconstruction.light.irradiance_error"].value == pytest.approx(0.2)
    # One scene lacks it: a mean of the other would stand beside means of both.
    assert "reconstruction.test_ssim" not in found
    assert found["reconstruction.test_ssim.a_1"].value == 0.5


def test_metrics_that_are_none_are_refused(tmp_path: Path):
    with pytest.raises(TronError, match="cannot read"):
        read_report(tmp_path)
    (tmp_path / "metrics.json").write_text('{"surfels": 3}')
    with pytest.raises(TronError, match="not tron-reconstruct's metrics: capture"):
        read_report(tmp_path)
    nan = json.loads(report().model_dump_json()) | {"test": {"psnr": float("nan")}}
    (tmp_path / "metrics.json").write_text(json.dumps(nan))
    with pytest.raises(TronError, match=r"test\.psnr"):
        read_report(tmp_path)


# Stand-ins for the commands: they copy what those would make.
STAND_IN = """#!{python}
import pathlib, shutil, sys
given = dict(argument.split("=", 1) for argument in sys.argv[1:])
with open({log!r}, "a") as log:
    log.write(" ".join(["{name}", *sys.argv[1:]]) + "\\n")
shutil.copytree({made!r}, given["output_dir"], dirs_exist_ok=True)
"""


def small_capture() -> Capture:
    """Nine views of drawn surfels with their true maps."""
    scene = surfels(300, seed=0)
    tracer, views = SurfelTracer(scene), []
    cameras = spiral(9, target=(0, 0, 0.4), radius=5, width=24, height=32, fov_deg=35)
    for number, camera in enumerate(cameras):
        seen = tracer.gbuffer(camera).numpy()
        maps = {name: np.clip(seen[name], 0, 1) for name in ("base_color", "roughness", "metallic")}
        mask, image = (seen["opacity"] > 0.5).astype(np.float32), np.clip(seen["rgb"], 0, 1)
        views.append(View(f"v{number}", camera, image, "display", normal=seen["normal"], mask=mask, **maps))
    return Capture(tuple(views), frozenset({"v0", "v8"}))


@pytest.fixture
def stand_ins(variant: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Puts stand-ins in place and real_data beside; returns the file that lists the commands that ran."""
    made = {name: tmp_path / "made" / name for name in ("tron-datagen", "tron-reconstruct", "tron-relight")}
    light = EnvironmentMap.constant(0.5, 16)
    beside = {"environment.exr": encode_exr(light.image, half=False)}
    write_capture(made["tron-datagen"] / "captures" / SCENE, small_capture(), beside=beside)
    (made["tron-datagen"] / "relit").mkdir()
    for name in ("1_sun", "2_studio"):
        relit = made["tron-datagen"] / "relit" / f"{SCENE}_{name}"
        even = np.full((32, 24, 3), 0.4, np.float32)
        views = [replace(view, space="linear", irradiance=even) for view in small_capture().test_views]
        write_capture(relit, Capture(tuple(views)), beside=beside)
    write_capture(tmp_path / "real" / "captures" / "fox", small_capture())
    light.save(tmp_path / "real" / "noon.exr")
    (tmp_path / "real" / "hdri").mkdir()
    (tmp_path / "real" / "noon.exr").rename(tmp_path / "real" / "hdri" / "noon.exr")

    folder = made["tron-reconstruct"]
    folder.mkdir(parents=True)
    surfels(300, seed=0).save(folder / "scene.ply")
    light.save(folder / "environment.exr")
    (folder / "cameras.json").write_text("[]")
    figures = {"psnr": 33.0, "ssim": 0.9, "normal_mae_deg": 4.0, "base_color_psnr": 31.0}
    metrics = {
        "capture": {"views": 9, "held_out": ["v0", "v8"], "skipped": {"v9": "image not found"}},
        "surfels": 300,
        "test": {"views": 2, **figures},
        "train": {"views": 7, "psnr": 34.0},
        "views": {"v0": figures, "v8": figures},
        "seconds": {"surfels": 3.0, "light": 2.0},
        "curve": [
            {"stage": "radiance", "step": n, "seconds": n / 10, "test_psnr": 20 + n / 10, "surfels": 300}
            for n in (10, 20, 30)
        ],
    }
    (folder / "metrics.json").write_text(json.dumps(metrics))
    write_image(folder / "contact_sheet.png", np.full((20, 30, 3), 0.5))

    frames = made["tron-relight"] / "frames"
    frames.mkdir(parents=True)
    for index in range(2):
        write_image(frames / f"{index:04d}.lit.exr", np.full((64, 48, 3), 0.2), half=True)
    (frames.parent / "relight.json").write_text('{"exposure": 0.8}')

    log = tmp_path / "commands.txt"
    for name, source in made.items():
        path = tmp_path / name
        path.write_text(STAND_IN.format(python=sys.executable, log=str(log), name=name, made=str(source)))
        path.chmod(0o755)
    monkeypatch.setattr(stages_module, "script_path", lambda name: str(tmp_path / name))
    return log


def run(folder: Path, *arguments: str) -> int:
    with pytest.raises(SystemExit) as end:
        cli(
            [
                "benchmark=reconstruction",
                f"output_dir={folder / 'out'}",
                f"benchmark.real_data={folder / 'real'}",
                "benchmark.hdris=[noon.exr,dusk.exr]",
                "benchmark.fox_downscale=1",
                "benchmark.relit_views=2",
                *arguments,
            ]
        )
    return end.value.code  # type: ignore[return-value]


def test_every_scene_in_every_way_and_the_fox_are_run_once(stand_ins: Path, tmp_path: Path):
    assert run(tmp_path, "benchmark.parts=[scenes,fox]") == 0
    out = tmp_path / "out"
    commands = stand_ins.read_text().splitlines()
    assert commands[0] == f"tron-datagen experiment=captures output_dir={out / 'dataset'}"
    assert [command.split()[0] for command in commands[1:]] == [*["tron-reconstruct"] * 3, "tron-relight"]
    folders = [command.rpartition("output_dir=")[2] for command in commands[1:3]]
    ways = ("random", "depth_init")
    assert folders == [str(out / "scenes" / SCENE / way) for way in ways]
    assert all(f"capture={out / 'dataset' / 'captures' / SCENE}" in command for command in commands[1:3])
    cameras = json.loads((out / "fox_cameras.json").read_text())
    assert [camera["width"] for camera in cameras] == [24, 24]
    assert f"scene={out / 'fox' / 'scene.ply'}" in commands[-1]
    assert "width=24 height=32" in commands[-1]

    results = Results.load(out / "results.json")
    prefixes = ("reconstruction", "reconstruction.depth_init")
    for prefix in prefixes:
        for name in SCENE_FIGURES:
            assert results.find(f"{prefix}.{name}") is not None
            assert results.find(f"{prefix}.{name}.test_000000") is not None
        assert results.value(f"{prefix}.light.irradiance_error") == pytest.approx(0, abs=1e-6)
    stages = json.loads((out / "stages.json").read_text())["stages"]
    assert results.value("reconstruction.seconds") == stages[f"{SCENE} random"]["seconds"]
    for name, value in (("test_psnr", 33.0), ("ssim", 0.9), ("surfels", 300.0), ("views", 9.0)):
        assert results.value(f"fox.{name}") == value
    assert results.find("fox.test_psnr").reference == "target: at least 25 dB"  # type: ignore[union-attr]

    page = (out / "report.html").read_text()
    for anchor in ("targets", "scenes", "light", "fox", "stages"):
        assert f'id="{anchor}"' in page
    assert "no interval is given" in page
    assert "Under noon" in page
    assert page.count("<svg") == 2
    assert (out / "pictures" / f"{SCENE}.png").is_file()

    assert run(tmp_path, "benchmark.parts=[scenes,fox]") == 0
    assert stand_ins.read_text().splitlines() == commands


@pytest.mark.long
def test_photographs_and_scans_are_relit_and_have_rows(stand_ins: Path, tmp_path: Path):
    parts = "benchmark.parts=[scenes,photos,splats]"
    assert run(tmp_path, parts, "~benchmark.ways.depth_init") == 0
    out = tmp_path / "out"
    commands = [line.split() for line in stand_ins.read_text().splitlines()]
    assert [command[1] for command in commands if command[0] == "tron-datagen"] == [
        "experiment=captures",
        "experiment=photographs",
        "experiment=photographs",
    ]
    made = {command[-1].partition("=")[2]: command for command in commands}
    photos = made[str(out / "scenes" / SCENE / "photos")]
    assert photos[1] == f"capture={out / 'photographs' / 'captures' / SCENE}"
    assert not [argument for argument in photos if argument.startswith("prior=ground_truth")]
    splats = made[str(out / "scenes" / SCENE / "splats")]
    assert splats[1] == f"capture={out / 'scans' / SCENE / 'scene.ply'}"
    assert made[str(out / "scenes" / SCENE / "scan")][1] == f"capture={out / 'dataset' / 'captures' / SCENE}"
    header = (out / "scans" / SCENE / "scene.ply").read_bytes().partition(b"end_header")[0]
    assert b"tron" not in header
    assert b"base_color" not in header

    results = Results.load(out / "results.json")
    for prefix in ("reconstruction", "reconstruction.photos"):
        for name in ("relight_psnr", "relight_psnr_sun", "relight_psnr_studio", "irradiance_error"):
            assert results.find(f"{prefix}.{name}") is not None
    for prefix in ("splats", "splats.raw"):
        for name in ("normal_mae_deg", "normal_median_deg", "relight_psnr", "surfels", "seconds"):
            assert results.find(f"{prefix}.{name}") is not None
    thick = [command for command in made.values() if command[1].endswith("-thick/scene.ply")]
    assert [command[-1] for command in thick] == [f"output_dir={out / 'scenes' / SCENE / 'carried'}"]
    learnt = made[str(out / "scenes" / SCENE / "thick")]
    assert learnt[1] == f"capture={out / 'scanned' / 'captures' / SCENE}"
    assert "initial.source=points" in learnt
    for way in ("", "raw_", "raw_today_"):
        for name in ("irradiance_psnr", "base_color_psnr", "half"):
            assert results.find(f"splats.thick.{way}{name}") is not None
    assert results.value("splats.thick.light_error") == pytest.approx(0, abs=1e-6)
    # The stand-in is the truth; 300 surfels are thick, so both are judged by the normals of their proxies.
    found, raw = (results.value(f"{way}.normal_mae_deg") for way in ("splats", "splats.raw"))
    assert found is not None
    assert raw is not None
    assert found < 0.75 * raw
    page = (out / "report.html").read_text()
    for anchor in ("relit", "splats"):
        assert f'id="{anchor}"' in page
    assert run(tmp_path, parts, "~benchmark.ways.depth_init") == 0
    assert len(stand_ins.read_text().splitlines()) == len(commands)


def test_a_way_is_of_scenes_or_of_photos(stand_ins: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    assert run(tmp_path, '+benchmark.photos.random=["prior=joint"]') == 2
    assert "way random is of photos and of scenes" in capfd.readouterr().err


def test_real_data_that_is_nowhere_is_refused(
    stand_ins: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
):
    assert run(tmp_path, "benchmark.parts=[fox]", "benchmark.real_data=nowhere") == 2
    assert "benchmark.real_data" in capfd.readouterr().err


def test_without_real_data_the_fox_has_no_rows_and_no_section(
    stand_ins: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    assert run(tmp_path, "benchmark.parts=[fox]", "benchmark.real_data=null") == 0
    assert "give benchmark.real_data=FOLDER" in caplog.text
    results = Results.load(tmp_path / "out" / "results.json")
    assert results.rows == []
    assert not stand_ins.exists()
    page = (tmp_path / "out" / "report.html").read_text()
    assert 'id="fox"' not in page
    assert "not measured" in page


QUICK = (
    '"steps_scaler=0.002","light.resolution=8","light.steps=5","light.scale_steps=3","light.pixels=64",'
    '"light.split_sum_resolution=64","score_every=10","radiance.density.most=600","initial.count=300","report.frames=2","report.side=32"'
)
CAPTURES = (
    '"experiment=captures","capture.scenes=1","capture.views=9","capture.width=32","capture.height=32",'
    '"capture.path_spp=4","capture.reference_spp=4","mesh_edge=0.2","environment_height=32","cluster=null"'
)

PHOTOGRAPHS = CAPTURES.replace("captures", "photographs", 1) + ',"capture.relight_spp=4"'
POINTS = '"capture.points=300"'
THICK = '"initial.source=points","initial.kernel_degree=2","light=null"'
SPLATS = '"up=[0,0,1]","splats.views=9","splats.side=32"'


@pytest.mark.long
def test_the_whole_benchmark_with_the_real_commands(shared_data: Path, tmp_path: Path, variant: str):
    """One scene of 32 x 32 pixels in a few steps; a way is enough beside the fox."""
    with pytest.raises(SystemExit) as end:
        cli(
            [
                "benchmark=reconstruction",
                f"output_dir={tmp_path}",
                f"benchmark.variant={variant}",
                f"benchmark.real_data={shared_data}",
                f"benchmark.datagen=[{CAPTURES}]",
                f"benchmark.reconstruct=[{QUICK}]",
                "~benchmark.ways.depth_init",
                f"benchmark.photographs=[{PHOTOGRAPHS}]",
                f"benchmark.photos.photos=[{QUICK}]",
                f'benchmark.splats.scan=[{QUICK},"initial.kernel_degree=2","light=null"]',
                f"benchmark.splats.reconstruct=[{QUICK},{SPLATS}]",
                f"benchmark.splats.photographs=[{PHOTOGRAPHS},{POINTS}]",
                f"benchmark.splats.thick=[{QUICK},{THICK}]",
                f'benchmark.splats.carry=[{SPLATS},"report=null"]',
                "benchmark.fox_downscale=32",
                f"benchmark.fox=[{QUICK}]",
                'benchmark.relight=["quality=preview"]',
                "benchmark.hdris=[studio_small_03_1k.hdr]",
                "benchmark.relit_views=2",
            ]
        )
    assert end.value.code == 0
    results = Results.load(tmp_path / "results.json")
    found = {row.metric for row in results.rows}
    assert {f"reconstruction.{name}" for name in SCENE_FIGURES} <= found
    assert {f"reconstruction.photos.{name}" for name in (*SCENE_FIGURES, "relight_psnr")} <= found
    assert {f"splats.{name}" for name in ("normal_mae_deg", "relight_psnr", "raw.relight_psnr")} <= found
    assert {f"splats.thick.{name}" for name in ("relight_psnr", "raw_psnr", "raw_gain", "half")} <= found
    assert {"fox.test_psnr", "fox.seconds", "fox.ssim", "fox.surfels", "fox.relight_seconds"} <= found
    assert results.value("fox.views") == 50
    page = (tmp_path / "report.html").read_text()
    for anchor in ("targets", "scenes", "light", "relit", "splats", "fox", "stages"):
        assert f'id="{anchor}"' in page
