"""Photographs of a capture: drift that is centred, noise of the stated size, held-out views left true."""

import json
from pathlib import Path

import numpy as np
import pytest

from datagen.build import build
from datagen.capture_export import held_out_cameras, make_captures
from datagen.capture_settings import SensorSettings
from datagen.pathtrace import render_frames
from datagen.photographs import Photograph, drift
from datagen.scene import SceneSpec
from datagen.settings import Settings
from datagen.validate import validate
from tron.captures.folder import read_capture_folder
from tron.cli.recipes import check, compose_recipe
from tron.color import to_display
from tron.seeds import generator
from tron.shading.environment import EnvironmentMap

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
            for field in ("image", "normal", "base_color", "depth", "irradiance"):
                np.testing.assert_array_equal(photo.read(field), render.read(field))
            continue
        # Inset by AgX's matrix grey stays grey: gains are read off the luminance's curve.
        taken = told[photo.name]
        shown, was = (
            np.interp(x.mean(axis=-1)[inside], curve, levels) for x in (photo.read(), render.read())
        )
        found = np.log2(np.median(shown / np.maximum(was, 1e-6)))
        assert found == pytest.approx(taken["exposure_stops"], abs=0.12)


def test_relit_views_are_path_traced_under_the_stored_light(output):
    folders = sorted(path for path in (output / "relit").iterdir() if path.is_dir())
    assert [folder.name for folder in folders] == ["test-000000_1_sun", "test-000000_2_studio"]
    text = (output / "captures/test-000000/spec.json").read_bytes()
    spec = SceneSpec.model_validate_json(text)
    cameras = held_out_cameras(spec, tiny(output).capture)
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


def test_further_lights_change_nothing_of_the_capture(output, true_output):
    specs = [
        json.loads((each / "captures/test-000000/spec.json").read_text()) for each in (output, true_output)
    ]
    assert [len(spec["lights"]) for spec in specs] == [3, 1]
    assert specs[0]["lights"][0] == specs[1]["lights"][0]
    for spec in specs:
        del spec["lights"], spec["cameras"]["first_frame"]
    assert specs[0] == specs[1]


def test_damaged_relit_views_are_found_and_made_again(output):
    assert validate(output) == 0
    image = output / "relit" / "test-000000_1_sun" / "images" / "view_00000.exr"
    before = image.read_bytes()
    image.unlink()
    assert validate(output) > 0
    assert make_captures(tiny(output)) == 0
    assert image.read_bytes() == before
    assert validate(output) == 0
