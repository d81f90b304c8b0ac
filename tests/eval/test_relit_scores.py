"""Surfels under other lights: the one factor is found, and what is wrong is told from what is only dim."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from eval.light_scale import fitted_factor
from eval.reconstruction.relighting import relight
from eval.reconstruction.scans import THICKNESS, collect_scan, write_scan
from eval.tracing.scene import surfels
from tron.captures import Capture, View
from tron.captures.folder import write_capture
from tron.color import to_display
from tron.estimation import Estimation
from tron.gaussians.scene import GaussianScene
from tron.io.images import encode_exr
from tron.seeds import generator
from tron.shading.bounces.bounce import BounceTransport
from tron.shading.environments.environment import EnvironmentMap
from tron.shading.guidance import Lighting, render_guidance
from tron.tracing import SurfelTracer
from tron.trajectories import spiral

QUICK = Estimation(rays=16)


def sided_light(height: int = 32) -> EnvironmentMap:
    """Bright from one side, dim from the other."""
    image = np.full((height, 2 * height, 3), 0.1, np.float32)
    image[:, :height] = (1.2, 1.0, 0.8)
    return replace(EnvironmentMap.constant(1.0, height), image=image)


@pytest.fixture(autouse=True)
def lit_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    """The scene is a cloud of surfels: thick by the number, and light is to see it as it is."""
    monkeypatch.setattr("tron.relighting.relighter.THICK", 2.0)


@pytest.fixture(scope="module")
def scene(variant, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("relit") / "scene.ply"
    replace(surfels(400, 0), kernel_degree=2).save(path)
    return path


@pytest.fixture(scope="module")
def views(scene: Path) -> list[View]:
    """Radiance of the surfels under the sided light, as the truth would be, and their normals."""
    cameras = spiral(3, target=(0, 0, 0.4), radius=5, width=32, height=24, fov_deg=35)
    tracer, lighting = SurfelTracer(GaussianScene.load(scene)), Lighting(sided_light())
    bounce = BounceTransport.trace(tracer).bake(lighting, QUICK)
    made = []
    for number, camera in enumerate(cameras):
        found = render_guidance(tracer, camera, lighting, QUICK, seed=90 + number, bounce=bounce)
        mask = (found.mask > 0.999).astype(np.float32)
        normal = found.gbuffer["normal"]
        made.append(View(f"v{number}", camera, found.lit, "linear", mask=mask, normal=normal))
    return made


def truth(folder: Path, views: list[View], light: EnvironmentMap, factor: float = 1.0) -> Path:
    """The views as a folder of tron-datagen's relit, all radiance times a factor."""
    scaled = tuple(replace(view, image=factor * view.read()) for view in views)
    beside = {"environment.exr": encode_exr(light.image, half=False)}
    write_capture(folder, Capture(scaled, exposure=light.exposure()), beside=beside)
    return folder


def test_the_factor_is_found_and_forgiven(scene: Path, views: list[View], tmp_path: Path):
    dimmed = truth(tmp_path / "s_1_side", views, sided_light(), factor=0.3)
    found = relight(scene, [dimmed], QUICK)
    assert found.factor == pytest.approx(0.3, rel=0.02)
    assert list(found.lights) == ["side"]
    assert found.psnr > 35
    assert found.lights["side"].shown.shape == (24, 32, 3)


def test_one_factor_does_not_mend_two_lights(scene: Path, views: list[View], tmp_path: Path):
    both = [
        truth(tmp_path / "s_1_dim", views, sided_light(), factor=0.5),
        truth(tmp_path / "s_2_bright", views, sided_light(), factor=2.0),
    ]
    found = relight(scene, both, QUICK)
    assert 0.5 < found.factor < 2.0
    assert found.psnr == pytest.approx(np.mean([light.psnr for light in found.lights.values()]))
    assert max(light.psnr for light in found.lights.values()) < 30


def test_what_is_not_all_surface_does_not_count(scene: Path, views: list[View], tmp_path: Path):
    spoilt = [replace(v, image=np.where(v.read("mask")[..., None] > 0.999, v.read(), 9.0)) for v in views]
    clean, dirty = (
        relight(scene, [truth(tmp_path / name / "s_1_side", shown, sided_light())], QUICK)
        for name, shown in (("clean", views), ("dirty", spoilt))
    )
    assert dirty.psnr == pytest.approx(clean.psnr, abs=1e-3)


def test_light_from_the_other_side_is_an_error(scene: Path, views: list[View], tmp_path: Path):
    right = relight(scene, [truth(tmp_path / "s_1_side", views, sided_light())], QUICK).psnr
    turned = sided_light().rotated(180)
    wrong = relight(scene, [truth(tmp_path / "s_1_other", views, turned.baked())], QUICK).psnr
    assert wrong < right - 10


def test_the_factor_minimises_the_displayed_error():
    rng = generator(0, "test factor")
    radiance = rng.uniform(0, 2, (2, 5, 6, 3))
    shown = to_display(0.13 * radiance, 1.7)
    everywhere = np.ones(shown.shape[:3], bool)
    assert fitted_factor([(radiance, 1.7, shown, everywhere)]) == pytest.approx(0.13, rel=1e-3)
    # Pixels that do not count may hold anything.
    spoilt, where = shown.copy(), everywhere.copy()
    spoilt[0, 0], where[0, 0] = 1 - spoilt[0, 0], False
    assert fitted_factor([(radiance, 1.7, spoilt, where)]) == pytest.approx(0.13, rel=1e-3)


def test_a_scan_is_a_plain_file_of_the_same_disks(scene: Path, tmp_path: Path):
    surfels = GaussianScene.load(scene)
    write_scan(tmp_path / "scan.ply", surfels, seed=3)
    scan = GaussianScene.load(tmp_path / "scan.ply")
    assert (scan.oriented, scan.materials_guessed, scan.up_guessed, scan.kernel_degree) == (
        False, True, True, 2,
    )  # fmt: skip
    for name in ("means", "sh", "opacity_logits"):
        np.testing.assert_array_equal(getattr(scan, name), getattr(surfels, name))
    cosines = (scan.normals() * surfels.normals()).sum(axis=1)
    np.testing.assert_allclose(np.abs(cosines), 1, atol=1e-5)
    assert 0.4 < (cosines > 0).mean() < 0.6
    np.testing.assert_allclose(np.sort(scan.scales()), np.sort(surfels.scales()), rtol=1e-5)
    # The disks' spread is the same matrix, whatever the axes are called.
    spread = [(s.rotations()[:, :, :2] * s.scales()[:, None]) for s in (scan, surfels)]
    ours, theirs = (x @ x.transpose(0, 2, 1) for x in spread)
    np.testing.assert_allclose(ours, theirs, atol=1e-6)
    import plyfile

    raw = plyfile.PlyData.read(str(tmp_path / "scan.ply"))["vertex"]
    scales = np.exp(np.stack([raw[f"scale_{axis}"] for axis in range(3)], 1))
    assert set(scales.argmin(1)) == {0, 1, 2}
    np.testing.assert_allclose(scales.min(1), THICKNESS * surfels.scales().min(1), rtol=1e-5)


def test_scans_are_scored_against_true_normals(scene: Path, views: list[View], tmp_path: Path):
    relit = truth(tmp_path / "s_1_side", views, sided_light())
    capture = tmp_path / "capture"
    shown = [replace(view, image=np.clip(view.read(), 0, 1), space="display") for view in views]
    write_capture(capture, Capture((*shown, replace(shown[0], name="train")), frozenset({"v0", "v1", "v2"})))
    true = collect_scan("s", scene, capture, [relit], 1.0)
    assert true.normals["normal_mae_deg"] < 1
    write_scan(tmp_path / "scan.ply", GaussianScene.load(scene), seed=3)
    raw = collect_scan("s", tmp_path / "scan.ply", capture, [relit], 1.0)
    assert raw.relit.psnr < true.relit.psnr
    assert raw.surfels == true.surfels
