"""tron-reconstruct from end to end on a tiny capture: files, figures, resuming, beginning anew, refusals."""

import json
import math
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml

from tron.apps.reconstruct import run as app
from tron.apps.reconstruct.cli import cli
from tron.apps.reconstruct.pictures import sheet_estimation
from tron.apps.relight.cli import cli as relight_cli
from tron.cameras import Camera
from tron.captures import Capture, View
from tron.captures.folder import write_capture
from tron.gaussians import GaussianScene
from tron.io.cameras.registry import cameras_of
from tron.io.images import read_image, write_image
from tron.reconstruction.geometry import training
from tron.shading.environments.environment import EnvironmentMap
from tron.tracing import SurfelTracer

SIZE, VIEWS = 32, 9
TINY = (
    "steps_scaler=1", "checkpoint_every=5", "score_every=4", "initial.source=depth", "initial.count=300",
    "radiance.steps=12", "radiance.sh_every=4", "radiance.density.start=0", "radiance.density.every=5",
    "radiance.density.threshold=1e-5", "radiance.density.most=340", "materials.steps=6",
    "light.steps=6", "light.resolution=8", "light.rays=4", "light.pixels=64", "light.scale_steps=3",
    "light.scale_pixels=256", "light.scale_rays=4", "light.split_sum_resolution=64",
    "report.frames=4", "report.side=32", "report.views=2",
)  # fmt: skip


@pytest.fixture(scope="module")
def capture_path(variant, ball_on_floor, tmp_path_factory) -> Path:
    """Nine views of the ball with every true map, three of them held out."""
    tracer, views = SurfelTracer(ball_on_floor(spacing=0.12)), []
    for i in range(VIEWS):
        turn = 2 * math.pi * i / VIEWS
        eye = (3 * math.cos(turn), 3 * math.sin(turn), 1.5 + 0.5 * (i % 2))
        camera = Camera.look_at(eye, (0, 0, 0.3), fov_deg=45, width=SIZE, height=SIZE)
        seen = tracer.gbuffer(camera).numpy()
        solid = (seen["opacity"] > 0.5)[..., None]
        views.append(
            View(
                f"{i:02d}",
                camera,
                np.clip(seen["rgb"], 0, 1),
                "display",
                normal=seen["normal"] * solid,
                base_color=np.clip(seen["base_color"], 0, 1) * solid,
                roughness=np.clip(seen["roughness"], 0, 1),
                metallic=np.clip(seen["metallic"], 0, 1),
                irradiance=np.full((SIZE, SIZE, 3), 0.4) * solid,
                depth=seen["depth"],
                mask=np.clip(seen["opacity"], 0, 1),
            )
        )
    path = tmp_path_factory.mktemp("captures") / "ball"
    write_capture(path, Capture(tuple(views), test=frozenset({"00", "03", "06"})))
    return path


@pytest.fixture
def reconstruct(variant, capture_path) -> Callable[..., int]:
    """Runs the command in this process on the tiny capture, without its page; gives its exit code."""

    def run(out: Path, *overrides: str, prior: str = "ground_truth", page: bool = False) -> int:
        chosen = (f"capture={capture_path}", f"output_dir={out}", f"variant={variant}", f"prior={prior}")
        with pytest.raises(SystemExit) as exit_info:
            cli([*chosen, *TINY, *([] if page else ["report=null"]), *overrides])
        return int(exit_info.value.code or 0)

    return run


@pytest.fixture
def steps(monkeypatch) -> list[tuple[str, int]]:
    """The steps that a command takes, as they come."""
    taken: list[tuple[str, int]] = []
    watch = app.StageBars.watch

    def counting(self, progress) -> None:
        taken.append((progress.stage, progress.step))
        watch(self, progress)

    monkeypatch.setattr(app.StageBars, "watch", counting)
    return taken


@pytest.fixture(scope="module")
def finished(variant, capture_path, tmp_path_factory) -> Path:
    """The output of a run that nobody disturbed; not to be changed."""
    out = tmp_path_factory.mktemp("finished")
    with pytest.raises(SystemExit) as exit_info:
        cli(
            [
                f"capture={capture_path}",
                f"output_dir={out}",
                f"variant={variant}",
                "prior=ground_truth",
                *TINY,
            ]
        )
    assert not exit_info.value.code
    return out


@pytest.fixture
def copied(finished: Path, tmp_path: Path) -> Path:
    """A copy of the finished output, to be changed."""
    return Path(shutil.copytree(finished, tmp_path / "out"))


def test_it_writes_everything_that_it_says(finished: Path):
    assert {path.name for path in finished.iterdir() if not path.name.startswith(".")} == {
        "scene.ply",
        "cameras.json",
        "environment.exr",
        "metrics.json",
        "curve.json",
        "contact_sheet.png",
        "light.png",
        "report.html",
        "config.yaml",
        "checkpoint.safetensors",
    }
    scene = GaussianScene.load(finished / "scene.ply").validate()
    assert 200 < len(scene) <= 340
    assert scene.kernel_degree == 4  # the recipe's
    assert EnvironmentMap.load(finished / "environment.exr").image.min() >= 0
    sheet = read_image(finished / "contact_sheet.png")
    rows = 13  # photo, radiance, error, opacity, depth, position, normal, three materials, three of light
    assert sheet.shape == (18 + rows * (180 + 2), 110 + 3 * (180 + 2), 3)
    photo = sheet[18:198, 110:290]
    assert np.ptp(photo) > 0.3
    config = yaml.safe_load((finished / "config.yaml").read_text())
    assert config["radiance"]["steps"] == 12
    assert config["prior"]["_target_"] == "tron.reconstruction.priors.GroundTruth"


@pytest.mark.parametrize("fidelity", [None, "paper"])
def test_the_sheet_estimates_shadows_as_the_run_does(fidelity: str | None):
    chosen = [] if fidelity is None else [f"fidelity={fidelity}"]
    light = cli.compose("capture=x", "output_dir=y", *chosen).light
    assert light is not None
    shown = sheet_estimation(light)
    paper = fidelity == "paper"
    assert (shown.estimator, shown.two_sided, shown.filtered) == (
        ("plain", False, False) if paper else ("ratio", True, True)
    )


def test_the_report_is_whole_and_strict_json(finished: Path):
    def refuse(word: str):
        raise AssertionError(word)

    report = json.loads((finished / "metrics.json").read_text(), parse_constant=refuse)
    assert {"version", "capture", "surfels", "materials_learnt", "test", "train", "views", "light"} < set(
        report
    )
    assert {"albedo_scaling", "seconds", "settings", "machine", "curve"} < set(report)
    assert report["capture"]["held_out"] == ["00", "03", "06"]
    assert report["first_surfels"] == {"source": "depth", "stereo_confident": None}
    assert report["materials_learnt"] == ["base_color", "roughness", "metallic"]
    figures = {"psnr", "psnr_subject", "ssim", "normal_mae_deg", "normal_median_deg"}
    figures |= {"base_color_psnr", "roughness_mae", "metallic_mae", "metallic_wrong"}
    assert set(report["test"]) == set(report["train"]) == figures | {"views"}
    assert (report["test"]["views"], report["train"]["views"]) == (3, 6)
    assert report["test"]["psnr"] > 18  # from depth maps: good before it begins
    assert report["test"]["normal_mae_deg"] < 20
    assert report["surfels"] == len(GaussianScene.load(finished / "scene.ply"))
    assert [point["step"] for point in report["curve"]] == [4, 8, 12]
    assert report["seconds"]["surfels"] > 0


def test_what_it_writes_can_be_relit(variant, finished: Path, tmp_path: Path):
    out = tmp_path / "relit"
    chosen = [f"scene={finished / 'scene.ply'}", f"environment={finished / 'environment.exr'}"]
    with pytest.raises(SystemExit) as exit_info:
        relight_cli([*chosen, f"output_dir={out}", "frames=1", "width=24", "height=24", f"variant={variant}"])
    assert not exit_info.value.code
    report = json.loads((out / "relight.json").read_text())
    assert report["scene"]["materials_guessed"] is False
    filmed = np.stack([camera.position for camera in cameras_of(finished / "cameras.json")])
    place = Camera.from_dict(report["cameras"][0]).position
    assert filmed.min(axis=0)[2] < place[2] < filmed.max(axis=0)[2]
    assert np.linalg.norm(place[:2]) == pytest.approx(3, abs=0.1)  # as far as the photos were taken from
    assert read_image(out / "frames" / "0000.mask.exr").max() > 0.9


def test_a_finished_run_is_left_as_it_is(reconstruct, steps, finished: Path, caplog):
    out = finished
    before = {path.name: path.stat().st_mtime_ns for path in out.iterdir() if path.name != "config.yaml"}
    caplog.set_level("INFO")
    assert reconstruct(out, page=True) == 0
    assert steps == []
    assert "finished before" in caplog.text
    assert "test, 3 views: psnr" in caplog.text
    after = {path.name: path.stat().st_mtime_ns for path in out.iterdir() if path.name != "config.yaml"}
    assert {name: time for name, time in after.items() if not name.startswith(".")} == {
        name: time for name, time in before.items() if not name.startswith(".")
    }


def test_lost_results_come_back_without_training(reconstruct, steps, copied: Path):
    out = copied
    scene, report = (out / "scene.ply").read_bytes(), json.loads((out / "metrics.json").read_text())
    (out / "scene.ply").unlink()
    assert reconstruct(out) == 0
    assert steps == []
    assert (out / "scene.ply").read_bytes() == scene
    again = json.loads((out / "metrics.json").read_text())
    assert again["test"] == pytest.approx(report["test"])
    assert again["curve"] == report["curve"]


def test_an_interrupted_run_goes_on_where_it_was_saved(
    reconstruct, steps, tmp_path: Path, monkeypatch, capsys
):
    out, counting = tmp_path / "out", app.StageBars.watch

    def interrupting(self, progress) -> None:
        counting(self, progress)
        if (progress.stage, progress.step) == ("radiance", 8):
            raise KeyboardInterrupt

    monkeypatch.setattr(app.StageBars, "watch", interrupting)
    assert reconstruct(out) == 130
    assert capsys.readouterr().err.splitlines()[-1] == (
        "tron-reconstruct: interrupted; what is finished is kept, and the same command goes on from it"
    )
    assert not (out / "metrics.json").exists()
    monkeypatch.setattr(app.StageBars, "watch", counting)
    steps.clear()
    assert reconstruct(out) == 0
    assert steps[0] == ("radiance", 6)
    assert steps[-1] == ("materials", 6)
    report = json.loads((out / "metrics.json").read_text())
    assert [point["step"] for point in report["curve"]] == [4, 8, 12]
    assert report["test"]["psnr"] > 18


@pytest.mark.long
def test_signals_keep_the_step_in_hand_and_one_thread_repeats_bit_by_bit(
    variant: str, reconstruct, steps, tmp_path: Path, monkeypatch, capfd, caplog
):
    """Behind the step, though no periodic checkpoint is there yet (the first comes after five).

    Each part of a run names itself as it begins: before its first step, for which kernels are compiled, and
    between stages.
    """
    render = training.render
    stops = [
        ("radiance", 3, signal.SIGINT),
        ("radiance", 12, signal.SIGTERM),
        ("materials", 2, signal.SIGINT),
    ]

    def signalled(*arguments, **more):
        done = steps[-1] if steps else ("radiance", 0)
        for stop in stops:
            if stop[:2] == (done[0], done[1] + 1):
                stops.remove(stop)
                signal.raise_signal(stop[2])
        return render(*arguments, **more)

    with caplog.at_level("INFO", "tron.cli.progress"):
        assert reconstruct(tmp_path / "whole", "threads=1", page=True) == 0
    begun = ["reading the capture", "first surfels", "radiance: 0 of 12 steps", "light and materials",
             "materials: 0 of 6 steps", "scores: 0 of 3", "contact sheet", "report"]  # fmt: skip
    assert [line for line in caplog.messages if line in begun] == begun
    steps.clear()
    monkeypatch.setattr(training, "render", signalled)
    for kept, number, verb in ((("radiance", 3), 130, "interrupted"), (("radiance", 12), 143, "terminated"),
                               (("materials", 2), 130, "interrupted")):  # fmt: skip
        capfd.readouterr()
        assert reconstruct(tmp_path / "cut", "threads=1") == number
        assert steps[-1] == kept
        said = capfd.readouterr().err.splitlines()
        assert any(line.startswith("stopping behind the step in hand") for line in said)
        assert said[-1].startswith(f"tron-reconstruct: {verb}; what is finished is kept")
    assert reconstruct(tmp_path / "cut", "threads=1") == 0
    assert not stops
    assert len(steps) == len(set(steps)), "no step was taken twice"
    if variant.startswith("cuda"):
        return  # a GPU adds in no fixed order: nothing repeats there bit by bit
    whole, cut = ((tmp_path / name / "scene.ply").read_bytes() for name in ("whole", "cut"))
    assert whole == cut
    maps = [EnvironmentMap.load(tmp_path / name / "environment.exr").image for name in ("whole", "cut")]
    np.testing.assert_array_equal(maps[0], maps[1])


def test_other_settings_are_refused_and_change_nothing_unless_told_to(
    reconstruct, steps, copied: Path, capsys
):
    out = copied
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    capsys.readouterr()
    assert reconstruct(out, "radiance.sh_rate=0.01") == 2
    error = capsys.readouterr().err.strip()
    assert error.startswith("tron-reconstruct: ")
    assert "a checkpoint made with radiance.sh_rate=" in error
    assert "overwrite=true" in error
    assert "\n" not in error
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    assert reconstruct(out, "radiance.sh_rate=0.01", "light=null", "overwrite=true") == 0
    assert len(steps) == 12 + 6
    assert (out / "scene.ply").read_bytes() != before["scene.ply"]
    assert not (out / "environment.exr").exists()  # the old light is not the new scene's
    assert json.loads((out / "metrics.json").read_text())["light"] is None


@pytest.mark.long
def test_photos_replaced_under_their_names_are_another_capture(
    reconstruct, steps, capture_path, copied: Path, tmp_path: Path, capsys
):
    other = Path(shutil.copytree(capture_path, tmp_path / "capture"))
    photo = other / "images" / "01.png"
    write_image(photo, read_image(photo, 4)[:, ::-1].copy())
    capsys.readouterr()
    assert reconstruct(copied, f"capture={other}") == 2
    assert "a checkpoint made with another capture (sha256 " in capsys.readouterr().err
    assert reconstruct(copied) == 0  # the same photos are still the same capture
    assert not steps
    report = json.loads((copied / "metrics.json").read_text())
    report["capture"]["content"][1] = "another held-out photo"
    (copied / "metrics.json").write_text(json.dumps(report))
    assert reconstruct(copied) == 0
    assert not steps  # what was learnt stays, what was scored does not
    assert (
        json.loads((copied / "metrics.json").read_text())["capture"]["content"][1] != "another held-out photo"
    )


@pytest.mark.long
def test_without_priors_for_light_there_is_no_light_and_it_is_said(
    reconstruct, capture_path, tmp_path: Path, caplog
):
    """Maps in folders, of which irradiance is not one."""
    maps = tmp_path / "maps"
    shutil.copytree(capture_path / "normal", maps / "normal")
    out = tmp_path / "out"
    assert reconstruct(out, f"prior.folder={maps}", "prior.normal_frame=world", prior="precomputed") == 0
    assert "no light can be fitted" in caplog.text
    assert not (out / "environment.exr").exists()
    assert json.loads((out / "metrics.json").read_text())["materials_learnt"] == []


def test_the_default_prior_needs_nothing_but_photos(reconstruct, tmp_path: Path):
    out = tmp_path / "out"
    assert cli.compose("capture=x", "output_dir=y").prior["_target_"] == "tron.reconstruction.Joint"
    few = ("prior.rounds=1", "prior.light.steps=10")
    assert reconstruct(out, *few, prior="joint") == 0
    report = json.loads((out / "metrics.json").read_text())
    assert report["materials_learnt"] == ["base_color", "roughness", "metallic"]
    assert report["light"]["surfels_seen"] > 0.5
    found = GaussianScene.load(out / "scene.ply")
    assert np.ptp(found.base_color) > 0.05
    light = EnvironmentMap.load(out / "environment.exr")
    assert light.image.min() >= 0 < light.image.max()


@pytest.mark.long
def test_without_held_out_views_the_others_are_shown(reconstruct, capture_path, tmp_path: Path):
    from dataclasses import replace

    from tron.captures.folder import read_capture_folder

    path = tmp_path / "all"
    write_capture(path, replace(read_capture_folder(capture_path), test=frozenset()))
    assert reconstruct(tmp_path / "out", f"capture={path}", "light=null") == 0
    report = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert report["test"] is None
    assert report["train"]["psnr"] > 18
    assert (tmp_path / "out" / "contact_sheet.png").exists()
