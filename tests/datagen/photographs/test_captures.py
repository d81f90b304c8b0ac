"""Captures of scenes: what they show is what the path tracer and the true buffers say, twice the same."""

import json
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

import datagen.photographs.perfect
from datagen.files.sources import Sources
from datagen.photographs.camera_model import straightened
from datagen.run.captures import make_captures
from datagen.run.validate import validate
from datagen.settings.command import Settings
from datagen.truth.build import scene_geometry
from datagen.truth.pathtrace import direct_irradiance, gbuffers, render_frames
from datagen.world.scene import SceneSpec
from tron.captures import Capture
from tron.captures.folder import read_capture_folder
from tron.cli.recipes import check, compose_recipe
from tron.color import to_display
from tron.errors import TronError
from tron.shading.environments.environment import EnvironmentMap

pytestmark = pytest.mark.usefixtures("variant")

EDGE = 0.1
TINY = [
    "mode=captures",
    "cluster=none",
    "test.style=object",
    "objects=[2,3]",
    f"mesh_edge={EDGE}",
    "environment_height=16",
    "capture.scenes=2",
    "capture.views=9",
    "capture.width=28",
    "capture.height=20",
    "capture.path_spp=64",
    "capture.reference_spp=64",
    "capture.lights=[overcast,studio]",
]


def tiny(output: Path, *overrides: str) -> Settings:
    return check(
        compose_recipe("conf.datagen", Settings, [*TINY, f"output_dir={output}", *overrides]), Settings
    )


@pytest.fixture(scope="module")
def output(variant, tmp_path_factory) -> Path:
    output = tmp_path_factory.mktemp("captures")
    assert make_captures(tiny(output)) == 0
    return output


@pytest.fixture(scope="module")
def folder(output) -> Path:
    return output / "captures" / "test-000001"


@pytest.fixture(scope="module")
def capture(folder) -> Capture:
    return read_capture_folder(folder)


@pytest.fixture(scope="module")
def spec(folder) -> SceneSpec:
    return SceneSpec.model_validate_json((folder / "spec.json").read_bytes())


@pytest.fixture(scope="module")
def geometry(spec, output):
    return scene_geometry(spec, tiny(output), Sources())


@pytest.fixture(scope="module")
def light(folder) -> EnvironmentMap:
    return EnvironmentMap.load(folder / "environment.exr")


def test_a_capture_is_a_spiral_around_a_test_scene_under_its_own_light(capture, spec, light, output):
    assert spec.name == "test-000001"
    assert [light.family for light in spec.lights] == ["studio"]
    first = SceneSpec.model_validate_json((output / "captures/test-000000/spec.json").read_bytes())
    assert [light.family for light in first.lights] == ["overcast"]
    assert [view.name for view in capture.views] == sorted(view.name for view in capture.views)
    assert capture.test == {"view_00000", "view_00008"}
    assert capture.up.tolist() == [0, 0, 1]
    assert capture.exposure == light.exposure()
    assert str(output) not in (output / "captures" / "config.yaml").read_text()
    for view, camera in zip(capture.views, spec.views(9, 28, 20)):
        np.testing.assert_allclose(view.camera.world_to_camera, camera.world_to_camera, rtol=0, atol=1e-12)
        assert view.camera.fx == camera.fx


def test_maps_are_the_true_buffers_of_the_pixel_centres(capture, geometry):
    for view, truth in zip(capture.views, gbuffers(geometry, [v.camera for v in capture.views])):
        seen = truth.valid
        np.testing.assert_allclose(view.read("base_color")[seen], truth.base_color[seen], atol=1e-3)
        np.testing.assert_allclose(view.read("roughness")[seen], truth.roughness[seen], atol=1e-3)
        np.testing.assert_allclose(view.read("metallic")[seen], truth.metallic[seen], atol=1e-3)
        np.testing.assert_allclose(view.read("normal")[seen], truth.normal[seen], atol=1e-3)
        reached = view.camera.position + view.camera.rays() * view.read("depth")[..., None]
        np.testing.assert_allclose(reached[seen], truth.position[seen], atol=1e-4)
        for field in ("base_color", "normal", "depth", "irradiance"):
            assert not view.read(field)[~seen].any()
        assert seen.mean() > 0.3


def test_irradiance_is_that_of_the_stored_light(capture, geometry, light):
    scene = geometry.lit(light)
    for view in capture.views[::4]:
        expected = direct_irradiance(geometry, scene, view.camera, 512, seed=99).shadowed
        found, lit = view.read("irradiance"), view.read("depth") > 0
        assert np.abs(found - expected)[lit].mean() < 0.08 * expected[lit].mean()
        assert found[lit].mean() == pytest.approx(expected[lit].mean(), rel=0.02)


def test_coverage_is_anti_aliased_and_agrees_with_the_pixel_centres(capture):
    masks = np.stack([view.read("mask") for view in capture.views])
    seen = np.stack([view.read("depth") > 0 for view in capture.views])
    partial = (masks > 0.02) & (masks < 0.98)
    assert 0.01 < partial.mean() < 0.2
    assert (seen[masks == 1]).mean() > 0.999
    assert not seen[masks == 0].any()
    assert masks[partial & seen].mean() > masks[partial & ~seen].mean() + 0.3


def test_image_times_mask_is_what_a_camera_sees_before_black(capture, geometry, light):
    """Against another rendering, by another seed, with the light visible and blackened where it is seen."""
    scene, rims = geometry.lit(light), 0
    for view in capture.views[::4]:
        frame = render_frames(scene, [view.camera], 256, [12345])[0]
        image, mask = view.read(), view.read("mask")
        expected = to_display(frame, capture.exposure)
        inside, outside = mask == 1, mask == 0
        assert np.abs(image - expected)[inside].mean() < 0.02
        assert abs((image - expected)[inside].mean()) < 0.003
        assert not image[outside].any()
        # Rims are straight colours: over the light itself, in linear radiance, they give the direct frame.
        rim = ~inside & ~outside
        if not rim.any():  # from above the floor fills the view
            continue
        behind = light.lookup(view.camera.rays())
        over = inverse_display(image, capture.exposure) * mask[..., None] + behind * (1 - mask[..., None])
        error = np.abs(to_display(over, capture.exposure) - expected)[rim].mean()
        wrong = np.abs(to_display(behind, capture.exposure) - expected)[rim].mean()
        assert error < 0.04
        assert error < 0.5 * wrong
        rims += rim.sum()
    assert rims > 20


def inverse_display(image: np.ndarray, exposure: float) -> np.ndarray:
    """Radiance that AgX shows as ``image``: by bisection of each grey, then the inset matrix undone."""
    levels = np.geomspace(1e-6, 60.0, 20_000)
    curve = to_display(np.repeat(levels[:, None], 3, 1), 1.0)[:, 0]
    inset = np.interp(image, curve, levels)
    # An inset of pure red, green and blue, one row each, from what a 1 % bright primary is shown as.
    basis = np.interp(to_display(np.eye(3) * 0.1, 1.0), curve, levels) / 0.1
    return np.maximum(inset @ np.linalg.inv(basis), 0) / exposure


def test_colours_are_straightened_before_the_tone_curve():
    radiance, coverage = np.array([0.2, 0.4, 0.8]), np.array([[0.0, 0.25, 1.0]])
    frame = np.concatenate([radiance * coverage[..., None], coverage[..., None]], axis=-1)
    straight, mask = straightened(frame, "here")
    np.testing.assert_array_equal(mask, coverage)
    np.testing.assert_allclose(straight[0, 1:], [radiance] * 2, atol=1e-12)
    assert not straight[0, 0].any()
    with pytest.raises(TronError, match=r"1 values that are not finite.*here"):
        straightened(np.where(np.arange(12).reshape(1, 3, 4) == 5, np.nan, frame), "here")


def test_nothing_that_is_not_finite_is_stored(tmp_path, monkeypatch):
    real = render_frames

    def spoilt(*arguments, **options):
        frames = real(*arguments, **options)
        frames[3, 2, 1] = np.inf
        return frames

    monkeypatch.setattr(datagen.photographs.perfect, "render_frames", spoilt)
    assert make_captures(tiny(tmp_path, "capture.scenes=1", "capture.path_spp=1")) == 1
    listed = tmp_path / "captures" / "failures.jsonl"
    assert {path.name for path in (tmp_path / "captures").iterdir()} == {
        "config.yaml", "manifest.json", "failures.jsonl", "failures",
    }  # fmt: skip
    assert "in straightened" in (tmp_path / "captures/failures/test-000000.txt").read_text()
    assert validate(tmp_path) == 0, "tracebacks are no capture"
    told = json.loads(listed.read_text())
    assert told["scene"] == "test-000000"
    assert "values that are not finite" in told["reason"]
    monkeypatch.undo()
    words = shlex.split(told["command"])
    assert make_captures(check(compose_recipe("conf.datagen", Settings, words[1:]), Settings)) == 0
    assert not listed.exists()
    assert not (tmp_path / "captures/failures").exists()


def test_validation_finds_what_no_single_file_shows(output, tmp_path, caplog):
    """Damage of files is found as in pseudo-captures."""
    copy = tmp_path / "copy"
    shutil.copytree(output, copy)
    assert validate(copy) == 0
    folder = copy / "captures"
    (folder / "test-000000" / "notes.txt").write_text("mine")
    shutil.rmtree(folder / "test-000001")
    assert validate(copy) == 2
    assert "captures/test-000000/notes.txt: not in the manifest" in caplog.text
    assert "captures/test-000001: missing" in caplog.text
    (folder / "manifest.json").write_text("{")
    assert validate(copy) == 1
    assert "captures/the manifest of the captures is damaged" in caplog.text


def test_captures_that_no_manifest_names_are_recorded_by_the_next_run(output, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(output, copy)
    before = (copy / "captures" / "manifest.json").read_bytes()
    (copy / "captures" / "manifest.json").unlink()
    assert validate(copy) == 2, "each capture is not in the manifest"
    assert make_captures(tiny(copy)) == 0
    assert (copy / "captures" / "manifest.json").read_bytes() == before
    assert validate(copy) == 0


def test_captures_repeat_byte_by_byte_in_any_groups_and_company(output, tmp_path, monkeypatch, files_of):
    """Views rendered two at a time, one scene alone: the bytes do not depend on it."""
    monkeypatch.setattr(datagen.photographs.perfect, "GROUP_PIXELS", 2 * 28 * 20)
    assert make_captures(tiny(tmp_path, "only=[test-000001]")) == 0
    whole = files_of(output / "captures" / "test-000001")
    assert files_of(tmp_path / "captures" / "test-000001") == whole
    assert not (tmp_path / "captures" / "test-000000").exists()
    other = tiny(tmp_path / "other", "seed=1", "only=[test-000001]", "capture.path_spp=4")
    assert make_captures(other) == 0
    assert files_of(tmp_path / "other/captures/test-000001")["spec.json"] != whole["spec.json"]


def test_another_recipe_is_refused_before_anything_is_written(output, files_of):
    before = files_of(output)
    for change, message in (
        ("capture.path_spp=81", r"capture\.path_spp=64, not 81"),
        ("capture.points=10", r"capture\.points=None, not 10"),
        ("test.style=table", r"test\.style=.*, not table"),
    ):
        with pytest.raises(TronError, match=message) as caught:
            make_captures(tiny(output, change))
        assert "\n" not in str(caught.value)
    assert files_of(output) == before


def test_more_captures_may_be_added_and_datasets_do_not_care(output):
    assert tiny(output, "capture.scenes=9").capture_recipe() == tiny(output).capture_recipe()
    assert tiny(output, "train.scenes=0", "surfels=999").capture_recipe() == tiny(output).capture_recipe()
    assert tiny(output, "capture.views=99").recipe() == tiny(output).recipe()


def test_points_lie_on_surfaces_and_have_the_colours_of_the_pictures(tmp_path, capture, geometry):
    few = ["only=[test-000001]", "capture.points=200"]
    assert make_captures(tiny(tmp_path, *few)) == 0
    found = read_capture_folder(tmp_path / "captures/test-000001")
    assert found.points is not None
    assert found.point_colors is not None
    assert len(found.points) == 200
    for new, old in zip(found.views, capture.views):
        np.testing.assert_array_equal(new.read(), old.read())
    # On a surface as the meshes have it: the nearest pixel of some view is as near as a pixel is wide.
    truth = gbuffers(geometry, [v.camera for v in capture.views])
    surface = np.concatenate([view.position[view.valid] for view in truth])
    nearest = np.linalg.norm(found.points[:, None] - surface[None], axis=-1).min(axis=1)
    assert nearest.max() < 1e-3
    seen = 0
    for view in found.train_views:
        pixel, _ = view.camera.project(found.points)
        column, row = np.floor(pixel.T).astype(int)
        centred = np.abs(pixel - np.floor(pixel) - 0.5).max(axis=1) < 1e-3
        centred &= (column >= 0) & (column < 28) & (row >= 0) & (row < 20)
        own = np.flatnonzero(centred)
        match = np.abs(view.read()[row[own], column[own]] - found.point_colors[own]).max(axis=1) < 1e-6
        seen += match.sum()
    assert seen >= 200


@pytest.mark.long
def test_two_workers_make_the_bytes_of_one_process(output, tmp_path, files_of):
    assert make_captures(tiny(tmp_path, "cluster=local", "workers=2")) == 0
    assert files_of(tmp_path) == files_of(output)


def test_relit_views_are_of_the_scenes_film_where_asked_for(tmp_path):
    wanted = [
        "capture.scenes=1",
        "capture.views=2",
        "capture.path_spp=4",
        "capture.relights=[sun]",
        "capture.film_frames=3",
    ]
    settings = tiny(tmp_path, *wanted, "capture.relight_spp=4")
    assert make_captures(settings) == 0
    spec = SceneSpec.model_validate_json((tmp_path / "captures/test-000000/spec.json").read_bytes())
    relit = read_capture_folder(tmp_path / "relit/test-000000_1_sun")
    film = spec.cameras.film.cameras(3, 28, 20)
    shot = zip(relit.views, film, gbuffers(scene_geometry(spec, settings, Sources()), film), strict=True)
    for view, camera, truth in shot:
        np.testing.assert_allclose(view.camera.world_to_camera, camera.world_to_camera, rtol=0, atol=1e-12)
        seen = truth.valid
        np.testing.assert_allclose(view.read("base_color")[seen], truth.base_color[seen], atol=1e-3)
        np.testing.assert_allclose(view.read("normal")[seen], truth.normal[seen], atol=1e-3)
        assert not view.read("normal")[~seen].any()
