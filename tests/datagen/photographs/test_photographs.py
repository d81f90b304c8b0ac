"""Photographs of a capture: drift that is centred, noise of the stated size, held-out views left true."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.special import erf

from datagen.photographs.camera_model import held_out, view_names
from datagen.photographs.meter import balanced
from datagen.photographs.phone import Blur, Photograph, drift, vignette
from datagen.run.captures import make_captures
from datagen.settings.captures import CaptureSettings, SensorSettings
from datagen.settings.command import Settings
from datagen.truth.build import build
from datagen.truth.pathtrace import gbuffers, render_frames
from datagen.world.scene import SceneSpec
from tron.captures.folder import read_capture_folder, write_capture
from tron.captures.view import linear_light
from tron.cli.recipes import check, compose_recipe
from tron.color import luminance, to_display
from tron.errors import TronError
from tron.seeds import generator
from tron.shading.environments.environment import EnvironmentMap

EDGE = 0.1
TINY = [
    "experiment=photographs",
    "cluster=none",
    "objects=[2,2]",
    f"mesh_edge={EDGE}",
    "environment_height=16",
    "capture.scenes=1",
    "capture.views=9",
    "capture.width=24",
    "capture.height=24",
    "capture.path_spp=16",
    "capture.reference_spp=4",
    "capture.relight_spp=64",
]


def tiny(output: Path, *overrides: str) -> Settings:
    recipe = compose_recipe("conf.datagen", Settings, [*TINY, f"output_dir={output}", *overrides])
    return check(recipe, Settings)


@pytest.fixture(scope="module")
def output(variant, tmp_path_factory) -> Path:
    output = tmp_path_factory.mktemp("photographs")
    assert make_captures(tiny(output)) == 0
    return output


@pytest.fixture(scope="module")
def true_output(variant, tmp_path_factory) -> Path:
    output = tmp_path_factory.mktemp("renders")
    assert make_captures(tiny(output, "capture.photographs=false", "capture.relights=[]")) == 0
    return output


def test_points_of_photographs_lie_on_surfaces_and_have_their_colours(output, tmp_path):
    assert make_captures(tiny(tmp_path, "capture.points=60", "capture.relights=[]")) == 0
    capture = read_capture_folder(tmp_path / "captures" / "test-000000")
    assert capture.points is not None
    assert capture.point_colors is not None
    assert len(capture.points) == 60
    spec = SceneSpec.model_validate_json((tmp_path / "captures/test-000000/spec.json").read_text())
    geometry = build(spec, edge=EDGE)
    shares = np.diff(np.arange(len(capture.train_views) + 1) * 60 // len(capture.train_views))
    starts = np.cumsum([0, *shares])
    for view, first, last in zip(capture.train_views, starts, starts[1:]):
        assert not view.has("depth")
        pixel, _ = view.camera.project(capture.points[first:last])
        columns, rows = np.floor(pixel).astype(int).T
        (truth,) = gbuffers(geometry, [view.camera])
        np.testing.assert_allclose(capture.points[first:last], truth.position[rows, columns], atol=1e-3)
        np.testing.assert_allclose(
            capture.point_colors[first:last], view.read()[rows, columns], atol=0.51 / 255
        )
    for old in (output / "captures/test-000000/images").iterdir():
        assert (tmp_path / "captures/test-000000/images" / old.name).read_bytes() == old.read_bytes()


def test_drift_is_centred_and_as_wide_as_asked_for():
    settings = SensorSettings(exposure_stops=0.5, white_balance=0.1)
    taken = drift(4000, settings, 7, "here")
    stops = np.array([each.exposure_stops for each in taken])
    gains = np.log([each.white_balance for each in taken])
    assert abs(stops.mean()) < 1e-12
    assert np.abs(gains.mean(axis=0)).max() < 1e-12
    assert stops.std() == pytest.approx(0.5, rel=0.05)
    np.testing.assert_allclose(gains.std(axis=0), [0.1, 0, 0.1], rtol=0.05)
    assert drift(5, settings, 7, "here") != drift(5, settings, 8, "here")


def test_noise_has_the_variance_of_counted_electrons():
    settings = SensorSettings(electrons=1000, read_noise=5)
    photograph = Photograph(1.0, (2.0, 1.0, 0.5))
    for level in (0.0, 0.05, 0.7):
        noisy = photograph.take(np.full((300, 300, 3), level), settings, generator(1, "noise"))
        light = 2 * level
        deviation = np.sqrt(light / 1000 + (5 / 1000) ** 2)
        for channel, gain in enumerate((2.0, 1.0, 0.5)):
            assert noisy[..., channel].mean() == pytest.approx(gain * light, abs=4 * gain * deviation / 300)
            assert noisy[..., channel].std() == pytest.approx(gain * deviation, rel=0.02)


def test_training_views_drift_by_what_the_file_says_and_held_out_views_do_not(output, true_output):
    folder = output / "captures" / "test-000000"
    photos, true = (read_capture_folder(o / "captures" / "test-000000") for o in (output, true_output))
    told = json.loads((folder / "photographs.json").read_text())
    assert set(told) == {view.name for view in photos.train_views}
    assert not (true_output / "captures/test-000000/photographs.json").exists()
    levels = np.linspace(0, 4, 20_000)
    curve = to_display(np.repeat(levels[:, None], 3, 1), 1.0)[:, 0]
    for photo, render in zip(photos.views, true.views):
        inside, held_out = photo.read("mask") == 1, photo.name in photos.test
        np.testing.assert_array_equal(photo.read("mask"), render.read("mask"))
        for field in ("normal", "base_color", "depth", "irradiance", "roughness", "metallic"):
            assert render.has(field)
            assert photo.has(field) == held_out, "a photograph comes without truth"
        if held_out:
            for field in ("normal", "base_color", "depth"):
                np.testing.assert_array_equal(photo.read(field), render.read(field))
            continue
        # Inset by AgX's matrix grey stays grey: gains are read off the luminance's curve.
        taken = told[photo.name]
        shown, was = (
            np.interp(x.mean(axis=-1)[inside], curve, levels) for x in (photo.read(), render.read())
        )
        found = np.log2(np.median(shown / np.maximum(was, 1e-6)))
        metered = np.log2(photos.exposure / true.exposure)
        assert found - metered == pytest.approx(taken["exposure_stops"], abs=0.12)


def test_the_camera_balances_white_and_shows_the_mean_as_middle_grey(output, true_output):
    folders = [where / "captures/test-000000" for where in (output, true_output)]
    photos, true = (read_capture_folder(folder) for folder in folders)
    ours, theirs = (EnvironmentMap.load(folder / "environment.exr").image for folder in folders)
    gains = ours.mean(axis=(0, 1)) / theirs.mean(axis=(0, 1))
    np.testing.assert_allclose(ours, gains * theirs, rtol=1e-4, atol=1e-6)
    arrived, shown = [], []
    for photo, render in zip(photos.test_views, true.test_views):
        inside = photo.read("mask") == 1
        irradiance = photo.read("irradiance")
        np.testing.assert_allclose(irradiance, gains * render.read("irradiance"), rtol=2e-3, atol=1e-3)
        arrived.append(irradiance[inside])
        shown.append(linear_light(photo, photos.exposure, "agx")[inside])
    light = np.concatenate(arrived).mean(axis=0)
    np.testing.assert_allclose(light / light.mean(), 1, atol=0.05)  # two views of nine, eight others metered
    assert luminance(np.concatenate(shown).mean(axis=0)) == pytest.approx(0.18, rel=0.3)


def test_relit_views_are_path_traced_under_the_stored_light(output):
    folders = sorted(path for path in (output / "relit").iterdir() if path.is_dir())
    assert [folder.name for folder in folders] == ["test-000000_1_sun", "test-000000_2_studio"]
    text = (output / "captures/test-000000/spec.json").read_bytes()
    spec = SceneSpec.model_validate_json(text)
    cameras = held_out(dict(zip(view_names(9), spec.views(9, 24, 24))))
    geometry = build(spec, edge=EDGE)
    for folder in folders:
        relit, light = read_capture_folder(folder), EnvironmentMap.load(folder / "environment.exr")
        assert [view.name for view in relit.views] == list(cameras)
        assert relit.exposure == pytest.approx(light.exposure())
        for view in relit.views:
            frame = render_frames(geometry.lit(light), [cameras[view.name]], 256, [4321])[0]
            inside = view.read("mask") == 1
            shown, expected = (to_display(x, relit.exposure)[inside] for x in (view.read(), frame))
            assert np.abs(shown - expected).mean() < 0.02
            assert abs((shown - expected).mean()) < 0.004
    own = EnvironmentMap.load(output / "captures/test-000000/environment.exr")
    assert all(not np.allclose(own.image, EnvironmentMap.load(f / "environment.exr").image) for f in folders)


def test_captures_whose_relit_views_lack_irradiance_are_made_anew(output, tmp_path, files_of, caplog):
    """Versions that did not path-trace it left such folders."""
    copy = tmp_path / "copy"
    shutil.copytree(output, copy)
    assert make_captures(tiny(copy)) == 0
    assert "made anew" not in caplog.text
    relit = copy / "relit/test-000000_2_studio"
    capture = read_capture_folder(relit)
    views = tuple(
        replace(view, image=view.read(), mask=view.read("mask"), irradiance=None) for view in capture.views
    )
    light = (relit / "environment.exr").read_bytes()
    write_capture(relit, replace(capture, views=views), overwrite=True, beside={"environment.exr": light})
    assert make_captures(tiny(copy)) == 0
    assert "test-000000: relit views lack irradiance" in caplog.text
    assert files_of(copy / "relit") == files_of(output / "relit")


def test_a_scene_without_light_is_named(output, variant):
    spec = SceneSpec.model_validate_json((output / "captures/test-000000/spec.json").read_text())
    dark = EnvironmentMap(np.zeros((4, 8, 3), np.float32))
    with pytest.raises(TronError, match=r"nothing can be metered: .* \(test-000000\)"):
        balanced(spec, build(spec, edge=EDGE), dark, CaptureSettings(width=8, height=8), "capture")


def test_further_lights_change_nothing_of_the_capture(output, true_output):
    specs = [
        json.loads((each / "captures/test-000000/spec.json").read_text()) for each in (output, true_output)
    ]
    assert [len(spec["lights"]) for spec in specs] == [3, 1]
    assert specs[0]["lights"][0] == specs[1]["lights"][0]
    for spec in specs:
        del spec["lights"], spec["cameras"]["first_frame"]
    assert specs[0] == specs[1]


@pytest.mark.parametrize("blur", [Blur(0.6), Blur(0.6, 2.0, 35.0), Blur(1.5, 0.5, 10.0)])
def test_kernels_have_the_covariance_of_spread_and_shake(blur):
    kernel = blur.kernel()
    assert kernel.sum() == pytest.approx(1)
    assert kernel.min() >= 0
    np.testing.assert_allclose(kernel, kernel[::-1, ::-1], atol=1e-15)
    offsets = np.arange(len(kernel)) - len(kernel) // 2
    rows, columns = np.meshgrid(offsets, offsets, indexing="ij")
    angle = np.radians(blur.motion_deg)
    along = np.array([np.cos(angle), np.sin(angle)])
    # A pixel's own width adds a twelfth; the mean over a straight way, a twelfth of its square.
    expected = (blur.spread**2 + 1 / 12) * np.eye(2) + blur.motion**2 / 12 * np.outer(along, along)
    found = [[(kernel * a * b).sum() for b in (columns, rows)] for a in (columns, rows)]
    np.testing.assert_allclose(found, expected, rtol=0.05, atol=0.01)


def test_a_narrow_spread_is_integrated_over_pixels():
    inside = erf(0.5 / (0.3 * np.sqrt(2)))  # of a Gaussian's weight, along each axis
    kernel = Blur(0.3).kernel()
    assert kernel[len(kernel) // 2, len(kernel) // 2] == pytest.approx(inside**2, rel=1e-3)


def test_without_spread_and_shake_nothing_changes():
    light = generator(0, "light").random((9, 7, 3)).astype(np.float32)
    np.testing.assert_array_equal(Blur().on(light), light)


def test_a_flat_wall_stays_flat_to_its_edge():
    light = np.full((12, 10, 3), 3.5, np.float32)
    np.testing.assert_allclose(Blur(1.0, 2.0, 20.0).on(light), light, rtol=1e-5)


def test_blur_of_a_bright_disc_makes_no_dark_rim():
    light = np.zeros((31, 31, 3), np.float32)
    light[15, 15] = 1e5
    blurred = Blur(0.4, 1.0, 45.0).on(light)
    assert blurred.min() >= 0
    assert blurred.sum() == pytest.approx(light.sum(), rel=1e-4)


def test_vignetting_darkens_the_corners_alone():
    share = vignette(40, 30, 0.3)[..., 0]
    assert share[14:16, 19:21] == pytest.approx(1, abs=2e-3)
    assert share[0, 0] == pytest.approx(0.7, abs=0.03)
    np.testing.assert_allclose(share, share[::-1, ::-1], atol=1e-6)
    assert share[0, 20] > share[0, 0]
