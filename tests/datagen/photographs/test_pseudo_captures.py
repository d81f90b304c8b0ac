"""Pseudo-captures: blind folders, photos and poses as far off as asked for, truth beside."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

import datagen.photographs.pseudo_captures
import datagen.run.captures
from datagen.dataset.records import Work
from datagen.photographs.camera_model import view_names
from datagen.photographs.phone import draw_phone
from datagen.photographs.pseudo_captures import PhoneCamera, before_light, disturbed
from datagen.run.account import LIST_NAME
from datagen.run.captures import make_captures
from datagen.run.plan import plan
from datagen.run.validate import validate
from datagen.settings.captures import PseudoCaptureSettings, SensorSettings
from datagen.settings.command import Settings
from datagen.truth.build import texels_per_unit
from datagen.world.scene import SceneSpec
from tron.apps.reconstruct.settings import Settings as ReconstructSettings
from tron.cameras import Camera
from tron.captures import LoadSettings, load_capture
from tron.captures.folder import read_capture_folder
from tron.captures.view import MAPS, inverse_agx
from tron.cli.recipes import check, compose_recipe
from tron.color import agx, linear_to_srgb, luminance, srgb_to_linear, to_display
from tron.errors import TronError
from tron.seeds import generator
from tron.shading.environments.environment import EnvironmentMap
from tron.storage import locked

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.long]

TINY = [
    "experiment=pseudo_captures",
    "cluster=none",
    "objects=[2,2]",
    "mesh_edge=0.1",
    "environment_height=16",
    "train.scenes=1",
    "test.scenes=1",
    "train.style=object",
    "test.style=object",
    "pseudo_capture.views=[9,12]",
    "pseudo_capture.width=24",
    "pseudo_capture.height=24",
    "pseudo_capture.path_spp=16",
    "pseudo_capture.reference_spp=4",
    "pseudo_capture.relights=[sun]",
    "pseudo_capture.relight_spp=4",
    "pseudo_capture.points=50",
]
PERFECT = [
    "train.scenes=0",
    "pseudo_capture.file=png",
    "pseudo_capture.lens={spread:[0,0],motion:0,vignetting:[0,0]}",
    "pseudo_capture.pose_noise={rotation_deg:0,translation:0,points:0}",
    "pseudo_capture.sensor={exposure_stops:0,white_balance:0,electrons:1e12,read_noise:0}",
]
NAMES = ("test-000000", "train-000000")


def tiny(output: Path, *overrides: str) -> Settings:
    return check(
        compose_recipe("conf.datagen", Settings, [*TINY, f"output_dir={output}", *overrides]), Settings
    )


@pytest.fixture(scope="module")
def output(variant, tmp_path_factory) -> Path:
    output = tmp_path_factory.mktemp("pseudo")
    assert make_captures(tiny(output)) == 0
    return output


@pytest.fixture(scope="module")
def perfect(variant, tmp_path_factory) -> dict[str, Path]:
    """Outputs without any error but rounding, by tone curve."""
    outputs = {}
    for curve, share in (("agx", 1), ("srgb", 0)):
        outputs[curve] = tmp_path_factory.mktemp(curve)
        settings = tiny(outputs[curve], *PERFECT, f"pseudo_capture.filmic_share={share}")
        assert make_captures(settings) == 0
    return outputs


def test_a_capture_holds_photos_poses_and_points_and_nothing_of_the_truth(output):
    assert sorted(path.name for path in (output / "captures").iterdir()) == ["manifest.json", *NAMES]
    for name in NAMES:
        folder = output / "captures" / name
        item = next(item for item in plan(tiny(output)) if item.name == name)
        photos = view_names(PhoneCamera().views(item, tiny(output)))
        found = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
        assert found == [*(f"images/{photo}.jpg" for photo in photos), "sparse.ply", "transforms.json"]
        said = json.loads((folder / "transforms.json").read_text())
        assert set(said) <= {
            *("camera_model", "fl_x", "fl_y", "cx", "cy", "w", "h", "ply_file_path", "frames"),
        }
        for frame in said["frames"]:
            assert set(frame) <= {"file_path", "transform_matrix", "fl_x", "fl_y", "cx", "cy", "w", "h"}
        assert not any(b"Exif" in path.read_bytes()[:64] for path in (folder / "images").iterdir())


def test_the_reader_of_reconstructions_sees_photos_and_no_map(output, tmp_path):
    for name in NAMES:
        overrides = [f"capture={output / 'captures' / name}", f"output_dir={tmp_path}"]
        settings = check(
            compose_recipe("conf.reconstruct", ReconstructSettings, overrides), ReconstructSettings
        )
        capture = load_capture(settings.capture, settings.of_loading())
        truth = read_capture_folder(output / "truth" / name)
        assert [view.name for view in capture.views] == [view.name for view in truth.views]
        assert capture.test == truth.test, "photos that reconstructions hold out have true maps"
        assert not capture.skipped
        assert capture.tone_curve == "srgb"
        assert capture.exposure == 1
        for view in capture.views:
            assert [field for field in MAPS if view.has(field)] == ["image"]
            assert view.space == "display"
        assert capture.points is not None
        assert len(capture.points) == 50


def test_masks_are_stored_where_they_are_asked_for_and_read_as_the_subject(tmp_path, variant):
    settings = tiny(tmp_path, "test.scenes=0", "pseudo_capture.masks=true")
    assert make_captures(settings) == 0
    folder = tmp_path / "captures/train-000000"
    capture = load_capture(folder, LoadSettings(masks="subject"))
    truth = {view.name: view for view in read_capture_folder(tmp_path / "truth/train-000000").views}
    assert len(list((folder / "masks").iterdir())) == len(capture.views)
    for view in capture.views:
        np.testing.assert_allclose(view.read("mask"), truth[view.name].read("mask"), atol=1 / 255)
    assert 0 < np.mean([view.read("mask").mean() for view in capture.views]) < 1


def test_truth_allows_to_judge_and_to_relight(output):
    for name in NAMES:
        folder = output / "truth" / name
        truth, spec = (
            read_capture_folder(folder),
            SceneSpec.model_validate_json((folder / "spec.json").read_bytes()),
        )
        assert spec.name == name
        for view, camera in zip(truth.views, spec.views(len(truth.views), 24, 24)):
            np.testing.assert_allclose(view.camera.world_to_camera, camera.world_to_camera, atol=1e-12)
            assert view.space == "linear"
            assert view.has("mask")
            assert view.has("normal") == view.has("depth") == (view.name in truth.test)
        relit = read_capture_folder(output / "relit" / f"{name}_1_sun")
        assert {view.name for view in relit.views} == truth.test
        assert all(view.has("mask") for view in relit.views)
        assert (output / "relit" / f"{name}_1_sun" / "environment.exr").is_file()
        told = json.loads((folder / "photographs.json").read_text())
        assert told["exposure"] == pytest.approx(truth.exposure)
        assert list(told["photos"]) == [view.name for view in truth.views]


def test_the_phone_balances_white_and_shows_the_mean_as_middle_grey(output):
    for name in NAMES:
        truth = read_capture_folder(output / "truth" / name)
        inside = {view.name: view.read("mask") == 1 for view in truth.views}
        arrived = [view.read("irradiance")[inside[view.name]] for view in truth.test_views]
        light = np.concatenate(arrived).mean(axis=0)
        np.testing.assert_allclose(light / light.mean(), 1, atol=0.05)  # two views; eight others were metered
        shown = np.concatenate([view.read()[inside[view.name]] for view in truth.views]).mean(axis=0)
        assert luminance(shown) * truth.exposure == pytest.approx(0.18, rel=0.15)


@pytest.mark.parametrize("curve", ["agx", "srgb"])
def test_without_errors_a_photo_is_the_truth_within_rounding(perfect, curve):
    output = perfect[curve]
    truth = read_capture_folder(output / "truth/test-000000")
    photos = load_capture(output / "captures/test-000000")
    light = EnvironmentMap.load(output / "truth/test-000000/environment.exr")
    rims = 0
    for photo, true in zip(photos.views, truth.views):
        np.testing.assert_allclose(photo.camera.world_to_camera, true.camera.world_to_camera, atol=1e-12)
        mask = true.read("mask")
        frame = np.concatenate([true.read() * mask[..., None], mask[..., None]], axis=-1)
        exposed = truth.exposure * before_light(frame, light, true.camera)
        shown = to_display(exposed, 1.0) if curve == "agx" else np.clip(linear_to_srgb(exposed), 0, 1)
        # Half a step of 8 bits, and as much for the truth's half precision.
        assert np.abs(photo.read() - shown).max() < 1 / 255
        rims += int(((mask > 0) & (mask < 1)).sum())
    assert rims > 0


def test_each_curve_is_undone_by_its_own_inverse_and_no_other(perfect):
    decode = {"agx": inverse_agx, "srgb": srgb_to_linear}
    for curve, output in perfect.items():
        truth = read_capture_folder(output / "truth/test-000000")
        photos = load_capture(output / "captures/test-000000")
        errors = {}
        for name, inverse in decode.items():
            apart = []
            for photo, true in zip(photos.views, truth.views):
                light = true.read() * truth.exposure
                usable = (true.read("mask") == 1) & (light.max(axis=-1) < 0.95)
                apart.append(np.abs(inverse(photo.read()) - light)[usable].mean())
            errors[name] = np.mean(apart)
        other = "srgb" if curve == "agx" else "agx"
        assert errors[curve] < 0.005
        assert errors[other] > 5 * errors[curve]


def test_poses_are_disturbed_by_normal_errors_of_the_stated_size():
    camera = Camera.look_at((3, 1, 2), (0, 0, 0), fov_deg=60, width=8, height=8)
    rng = generator(5, "poses")
    turns, moves = [], []
    for _ in range(1500):
        found = disturbed(camera, 0.2, 0.03, rng)
        turn = found.world_to_camera[:3, :3] @ camera.world_to_camera[:3, :3].T
        turns.append(np.degrees([turn[2, 1], turn[0, 2], turn[1, 0]]))
        moves.append(found.position - camera.position)
    np.testing.assert_allclose(np.std(turns, axis=0), 0.2, rtol=0.08)
    np.testing.assert_allclose(np.std(moves, axis=0), 0.03, rtol=0.08)
    assert np.abs(np.mean(turns, axis=0)).max() < 0.02
    assert np.abs(np.mean(moves, axis=0)).max() < 0.003


def test_the_folder_names_disturbed_poses_and_points_near_surfaces(output):
    noise = tiny(output).pseudo_capture.pose_noise
    for name in NAMES:
        truth, said = read_capture_folder(output / "truth" / name), load_capture(output / "captures" / name)
        # Held-out views of the truth have depth: an eighth of the pixels that the median is taken of.
        depths = [view.read("depth") for view in truth.test_views]
        distance = float(np.median(np.concatenate([depth[depth > 0] for depth in depths])))
        moves, turns = [], []
        for view, true in zip(said.views, truth.views):
            moves.append(view.camera.position - true.camera.position)
            turn = view.camera.world_to_camera[:3, :3] @ true.camera.world_to_camera[:3, :3].T
            turns.append(np.degrees([turn[2, 1], turn[0, 2], turn[1, 0]]))
        assert 0.5 < np.std(moves) / (noise.translation * distance) < 1.6
        assert 0.5 < np.std(turns) / noise.rotation_deg < 1.6
        assert said.points is not None
        view = truth.test_views[0]
        surface = (view.camera.position + view.camera.rays() * view.read("depth")[..., None])[
            view.read("depth") > 0
        ]
        nearest = np.linalg.norm(said.points[:, None] - surface, axis=-1).min(axis=1)
        assert np.median(nearest) < 2 * distance / view.camera.fx


def test_the_number_of_photos_spans_the_range_and_names_carry_the_split():
    settings = tiny(Path("nowhere"), "pseudo_capture.views=[40,44]")
    works = [Work("train", i, f"train-{i:06d}", 0) for i in range(60)]
    numbers = [PhoneCamera().views(work, settings) for work in works]
    assert set(numbers) == {40, 41, 42, 43, 44}
    assert numbers == [PhoneCamera().views(work, settings) for work in works]
    assert {item.name for item in plan(settings)} == set(NAMES)


def test_what_the_recipe_leaves_out_decides_nothing(output):
    """Sizes of a dataset's frames and views are not kept, so textures may not depend on them."""
    spec = SceneSpec.model_validate_json((output / "truth/test-000000/spec.json").read_bytes())
    plain, other = tiny(output), tiny(output, "view_width=999", "test.width=999", "capture.width=999")
    assert plain.pseudo_capture_recipe() == other.pseudo_capture_recipe()
    assert texels_per_unit(spec, plain) == texels_per_unit(spec, other)
    assert texels_per_unit(spec, tiny(output, "pseudo_capture.width=48")) != texels_per_unit(spec, plain)


def test_curves_are_drawn_by_share():
    curves = [
        draw_phone(PseudoCaptureSettings(filmic_share=0.25), ["a"], 3, "train", i).curve for i in range(400)
    ]
    assert curves.count("agx") / 400 == pytest.approx(0.25, abs=0.065)


def test_photos_of_one_capture_differ_in_exposure_and_noise():
    settings = PseudoCaptureSettings(sensor=SensorSettings(exposure_stops=0.5))
    phone = draw_phone(settings, ["a", "b", "c"], 3, "here")
    exposed = np.full((16, 16, 3), 0.2)
    photos = [phone.photo(name, exposed, settings, generator(3, name)) for name in phone.photographs]
    assert len({round(float(photo.mean()), 3) for photo in photos}) == 3
    for photo in photos:
        assert 0 <= photo.min() <= photo.max() <= 1
        assert photo.std() > 0


def test_a_finished_capture_is_not_made_again_and_a_lost_piece_of_any_folder_is(
    output, tmp_path, monkeypatch, files_of
):
    copy = tmp_path / "copy"
    shutil.copytree(output, copy)
    before = files_of(copy)
    made = []

    def watched(item: Work, *_: object) -> Path:
        """Give what making it gives: that repeats byte by byte, see below."""
        made.append(item.name)
        left = shutil.ignore_patterns("manifest.json", "logs")
        shutil.copytree(output, copy, dirs_exist_ok=True, ignore=left)
        return copy / "captures" / item.name

    monkeypatch.setattr(datagen.run.captures, "make_capture", watched)
    (copy / "captures/.test-000000.part").mkdir()  # half-written by a run that was killed
    assert make_captures(tiny(copy)) == 0
    assert made == []
    for lost in (
        "captures/test-000000/images/view_00003.jpg",
        "truth/test-000000/environment.exr",
        "truth/test-000000/normal/view_00000.exr",
        "relit/test-000000_1_sun/images/view_00000.exr",
    ):
        (copy / lost).unlink()
        made.clear()
        assert make_captures(tiny(copy)) == 0
        assert made == ["test-000000"]
        after = files_of(copy)
        assert {k: v for k, v in after.items() if "logs" not in k} == {
            k: v for k, v in before.items() if "logs" not in k
        }


def test_validation_finds_damage_of_photos_and_of_truth(output, tmp_path, caplog):
    copy = tmp_path / "copy"
    shutil.copytree(output, copy)
    damage = {
        "captures/train-000000/images/view_00002.jpg": lambda data: data[:-20],
        "captures/train-000000/transforms.json": lambda data: data[:-20],
        "captures/test-000000/images/view_00002.jpg": lambda data: (
            data[:-9] + bytes([data[-9] ^ 1]) + data[-8:]
        ),
        "truth/train-000000/images/view_00002.exr": lambda data: (
            data[:-9] + bytes([data[-9] ^ 1]) + data[-8:]
        ),
        "truth/train-000000/photographs.json": None,
        "truth/test-000000/images/view_00002.exr": lambda data: data[:-20],
        "relit/train-000000_1_sun/environment.exr": None,
    }
    for file, changed in damage.items():
        data = (copy / file).read_bytes()
        (copy / file).unlink()
        if changed is not None:
            (copy / file).write_bytes(changed(data))
    assert validate(copy) >= len(damage)
    for file in damage:
        assert f"{file}: " in caplog.text


def test_whole_folders_are_valid_and_what_was_looked_at_is_said(output, caplog):
    caplog.set_level("INFO")
    assert validate(output) == 0
    assert "2 captures, 2 folders of their truth, 2 folders of relit views" in caplog.text
    assert "0 problems" in caplog.text


def test_several_machines_make_a_set_by_only(output, tmp_path, files_of):
    """As docs/guides/clusters.md says: each makes some, copies but manifests, and the command again.

    Captures are the same bytes in any company.
    """
    parts = [tmp_path / "a", tmp_path / "b"]
    for part, name in zip(parts, NAMES):
        assert make_captures(tiny(part, f"only=[{name}]")) == 0
        assert [path.name for path in (part / "truth").iterdir() if path.is_dir()] == [name]
    shutil.copytree(
        parts[1], parts[0], dirs_exist_ok=True, ignore=shutil.ignore_patterns("manifest.json", "logs")
    )
    before = {path: path.stat().st_mtime_ns for path in parts[0].rglob("*.jpg")}
    assert make_captures(tiny(parts[0])) == 0
    assert before == {path: path.stat().st_mtime_ns for path in before}, "nothing is made again"
    assert validate(parts[0]) == 0
    for folder in ("captures", "truth", "relit"):
        assert files_of(parts[0] / folder) == files_of(output / folder)


def test_a_failed_capture_is_accounted_for_and_leaves_nothing(tmp_path, monkeypatch):
    def failing(*arguments, **options):
        raise TronError("the lamp broke", "here")

    monkeypatch.setattr(datagen.photographs.pseudo_captures, "draw_phone", failing)
    settings = tiny(tmp_path, "train.scenes=0")
    assert make_captures(settings) == 1
    assert [path.name for path in (tmp_path / "captures").iterdir()] == ["manifest.json"]
    assert not (tmp_path / "truth" / "test-000000").exists()
    told = json.loads((tmp_path / "truth" / LIST_NAME).read_text())
    assert "the lamp broke" in told["reason"]
    assert "mode=pseudo_captures" in told["command"]


def test_other_recipes_strangers_folders_and_those_in_use_are_refused(output, tmp_path, files_of):
    before = files_of(output)
    for change, message in (
        ("pseudo_capture.views=[9,13]", r"pseudo_capture\.views"),
        ("train.style=table", r"train\.style=object, not table"),
        ("seed=3", "seed=15, not 3"),
    ):
        with pytest.raises(TronError, match=message):
            make_captures(tiny(output, change))
    assert files_of(output) == before
    with locked(tmp_path), pytest.raises(TronError, match="in use"):
        make_captures(tiny(tmp_path))
    (tmp_path / "captures").mkdir()
    (tmp_path / "captures" / "holiday.jpg").write_bytes(b"")
    with pytest.raises(TronError, match="something else"):
        make_captures(tiny(tmp_path))
    assert not (tmp_path / "truth").exists()


def test_captures_of_the_camera_that_balanced_no_white_are_refused(output, tmp_path):
    """Their bytes are others, and nothing else in their recipe is."""
    copy = tmp_path / "copy"
    shutil.copytree(output, copy)
    recipe = copy / "truth/config.yaml"
    recipe.write_text(re.sub(r"^meter: .*\n", "", recipe.read_text(), flags=re.MULTILINE))
    with pytest.raises(TronError, match="made with meter=None, not balanced"):
        make_captures(tiny(copy))


def test_more_scenes_may_be_added(output, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(output, copy)
    fewer = tiny(copy, "test.scenes=0")
    assert make_captures(fewer) == 0
    recorded = json.loads((copy / "captures/manifest.json").read_text())["captures"]
    assert sorted(recorded) == sorted(NAMES), "captures of a split that is not asked for stay"
    with pytest.raises(TronError, match=r"test\.style"):
        make_captures(tiny(copy, "test.style=table"))


def test_wrong_settings_are_named(tmp_path):
    for wrong in ("shard=1/2", "store=file:///nowhere"):
        with pytest.raises(TronError, match=f"'?{wrong.partition('=')[0]} is of datasets: leave it out"):
            tiny(tmp_path, wrong)
    for wrong in ("views=[9,3]", "lens.spread=[1,0.5]", "file=gif", "lights=[hdri]", "relights=[hdri]"):
        with pytest.raises(TronError, match="pseudo_capture"):
            tiny(tmp_path, f"pseudo_capture.{wrong}")


def test_a_checklist_that_cannot_be_read_is_told_before_anything(tmp_path):
    with pytest.raises(TronError, match="checklist not found"):
        make_captures(tiny(tmp_path / "out", "checklist=nothing"))
    assert not (tmp_path / "out").exists()


def test_nothing_that_a_dataset_trains_on_is_photographed_against_the_recipe(tmp_path):
    with pytest.raises(TronError, match=r"dataset has no sources\.json"):
        make_captures(tiny(tmp_path / "out", f"disjoint_from=[{tmp_path}]"))


def test_light_behind_things_is_the_mean_over_a_pixel():
    image = np.zeros((16, 32, 3), np.float32)
    image[:, ::2] = 1
    light = EnvironmentMap(image)
    camera = Camera.look_at((0, 0, 0), (1, 0, 0), fov_deg=60, width=6, height=4)
    frame = np.zeros((4, 6, 4), np.float32)
    frame[0] = (0.5, 0.25, 0.125, 1.0)
    seen = before_light(frame, light, camera)
    np.testing.assert_array_equal(seen[0], np.broadcast_to(frame[0, :, :3], (6, 3)))
    fine = light.lookup(camera.resized(96, 64).rays()).reshape(4, 16, 6, 16, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(seen[1:], fine[1:], atol=0.01)
    half = frame.copy()
    half[..., 3] = 0.5
    half[..., :3] = 0
    np.testing.assert_allclose(before_light(half, light, camera), fine / 2, atol=0.01)


def test_grey_is_shown_by_the_capture_s_curve():
    sensor = SensorSettings(electrons=1e12, read_noise=0, exposure_stops=0, white_balance=0)
    exposed = np.full((9, 9, 3), 0.18)
    for share, curve in ((1, agx), (0, linear_to_srgb)):
        settings = PseudoCaptureSettings(filmic_share=share, sensor=sensor)
        phone = draw_phone(settings, ["a"], 1, "here")
        shown = phone.photo("a", exposed, settings, generator(1, "noise"))
        np.testing.assert_allclose(shown[4, 4], curve(exposed[4, 4]), atol=1e-3)
