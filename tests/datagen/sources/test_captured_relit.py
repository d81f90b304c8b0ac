"""Captures relit: guidance is of the light that the folder names, the truth is the folder's, runs go on."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import datagen.sources.captured
from datagen.run.cost import project
from datagen.run.dataset import make
from datagen.run.plan import plan
from datagen.run.validate import validate
from datagen.settings.command import Settings
from datagen.sources import SOURCES
from datagen.sources.captured import photo_clips
from datagen.sources.captured_folder import find_relit, named_by_split, split_by_name
from datagen.sources.captured_reconstruction import load, take_over
from tron.cameras import Camera
from tron.captures import Capture, View
from tron.captures.folder import read_capture_folder, write_capture
from tron.cli.recipes import check, compose_recipe
from tron.errors import TronError
from tron.io.images import encode_exr
from tron.seeds import generator
from tron.shading.environments.environment import EnvironmentMap
from tron.shards.manifest import Manifest
from tron.shards.reader import read_clips

NAME = "test-000001"
LIGHTS = {"1_sun": (1.0, 0.5), "2_studio": (2.0, 0.25)}
"""Light -> factor on the map, exposure."""

Recipe = Callable[..., Settings]
SOURCE = SOURCES["captured"]


@pytest.fixture(scope="module")
def relit(tiny_captures: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two views of a capture under two lights, the second twice the first."""
    folder = tmp_path_factory.mktemp("relit") / "relit"
    rng = generator(9, "test", "relit")
    light = rng.uniform(0.1, 2.0, (8, 16, 3)).astype(np.float32)
    views = read_capture_folder(tiny_captures / NAME).test_views
    shots = [gaussian_filter(rng.uniform(0, 3, (24, 24, 3)), (2, 2, 0)).astype(np.float32) for _ in views]
    mask = (np.arange(24) >= 8) * np.ones((24, 1), np.float32)
    for name, (factor, exposure) in LIGHTS.items():
        seen = tuple(
            View(view.name, view.camera, factor * shot, "linear", mask=mask)
            for view, shot in zip(views, shots)
        )
        capture = Capture(seen, up=np.array([0.0, 0.0, 1.0]), exposure=exposure)
        beside = {"environment.exr": encode_exr(factor * light, half=False)}
        write_capture(folder / f"{NAME}_{name}", capture, beside=beside)
    return folder


@pytest.fixture(scope="module")
def recipe(variant: str, tiny_captures: Path, quick_reconstruction: list[str], relit: Path) -> Recipe:
    def recipe(output: Path, *overrides: str) -> Settings:
        wanted = [
            *("source=captured", f"captures={tiny_captures}", f"output_dir={output}", "cluster=none"),
            *("prior=ground_truth", f"captured.names=[{NAME}]", "captured.split_by_name=true"),
            f"captured.relit={relit}",
        ]
        values = compose_recipe("conf.datagen", Settings, [*wanted, *quick_reconstruction, *overrides])
        return check(values, Settings)

    return recipe


@pytest.fixture(scope="module")
def pairs(recipe: Recipe, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("pairs") / "pairs"
    assert make(recipe(output)) == 0
    return output


def test_relit_clips_are_a_split_of_their_own_and_all_of_it_is_accounted_for(pairs: Path, recipe: Recipe):
    assert validate(pairs) == 0
    assert Manifest.load(pairs).splits() == ["test", "test_relit"]
    assert "| test_relit | 1 | 4 | 4 | 20 x 16 | 2 studio, 2 sun |" in (pairs / "README.md").read_text()
    clips = list(read_clips(pairs, "test_relit"))
    assert {clip.meta.scene for clip in clips} == {clip.meta.scene for clip in read_clips(pairs, "test")}
    assert {clip.meta.extra["relit"] for clip in clips} == {f"{NAME}_{name}" for name in LIGHTS}
    (work,) = plan(recipe(pairs))
    assert SOURCE.clips(work, recipe(pairs)) == len(clips) + photo_clips(work, recipe(pairs))
    before = {path: path.stat().st_mtime_ns for path in pairs.rglob("*") if path.is_file()}
    assert make(recipe(pairs)) == 0
    assert {path: path.stat().st_mtime_ns for path in pairs.rglob("*") if path.is_file()} == before


def test_the_truth_is_the_folders_in_front_of_its_light_under_its_exposure(pairs: Path, relit: Path):
    for clip in read_clips(pairs, "test_relit"):
        folder = relit / clip.meta.extra["relit"]
        (name,) = clip.meta.extra["photos"]
        views = {view.name: view for view in read_capture_folder(folder).views}
        camera = Camera.from_dict(clip.meta.cameras[0])
        np.testing.assert_allclose(camera.position, views[name].camera.position, atol=1e-9)
        assert not clip.is_display("rgb")
        assert clip.meta.exposure == LIGHTS[folder.name.removeprefix(f"{NAME}_")][1]
        # What a pixel shows is the folder's where the same ray meets it; that picture is smooth.
        pixels, _ = views[name].camera.project(camera.position + camera.rays().reshape(-1, 3))
        column, row = np.clip(np.floor(pixels).astype(int), 0, 23).T
        mask = views[name].read("mask")[row, column].reshape(16, 20)
        seen = clip.frames["foreground"][0, ..., 0] > 0.5
        sure = (mask == 1) & seen
        expected = views[name].read()[row, column].reshape(16, 20, 3)
        assert sure.sum() > 40
        np.testing.assert_allclose(clip.frames["rgb"][0][sure], expected[sure], rtol=0.15, atol=0.05)
        behind = EnvironmentMap.load(folder / "environment.exr").lookup(camera.rays())
        assert ((mask == 0) == ~seen).mean() > 0.9
        far = (mask == 0) & ~seen
        assert far.sum() > 40
        assert np.median(np.abs(clip.frames["rgb"][0] - behind)[far]) < 0.1


def test_guidance_is_of_the_surfels_under_that_light(pairs: Path):
    """Light is linear: under twice the light every noiseless buffer is twice as bright."""
    by_light: dict[str, list[np.ndarray]] = {}
    for clip in read_clips(pairs, "test_relit"):
        by_light.setdefault(clip.meta.light_family, []).append(clip.frames["pbr"])
    one, two = (np.concatenate(by_light[family]) for family in ("sun", "studio"))
    assert one.max() > 0.05
    np.testing.assert_allclose(two, 2 * one, rtol=2e-3, atol=1e-3)


@pytest.mark.long
def test_base_color_is_brought_to_the_scale_of_the_truth(
    pairs: Path, recipe: Recipe, tiny_captures: Path, tmp_path: Path
):
    true = read_capture_folder(tiny_captures / NAME)
    mapped = [view for view in true.views if view.has("base_color")]
    made = []
    for factor in (0.5, 0.25):
        folder = tmp_path / str(factor)
        darker = tuple(replace(view, base_color=factor * view.read("base_color")) for view in mapped)
        write_capture(folder / "truth" / NAME, replace(true, views=darker, test=frozenset()))
        again = [f"captured.truth={folder / 'truth'}", f"captured.reconstructed={pairs}"]
        assert make(recipe(folder / "pairs", *again)) == 0
        made.append(folder / "pairs")
    for plain, bright, dark in zip(*(read_clips(folder, "test_relit") for folder in (pairs, *made))):
        assert "albedo_scale" not in plain.meta.extra
        scales = [np.array(clip.meta.extra["albedo_scale"]) for clip in (bright, dark)]
        np.testing.assert_allclose(scales[0], 2 * scales[1], rtol=1e-2)
        one, other = bright.frames["pbr"], dark.frames["pbr"]
        surfels = (one != other).any(-1)  # not the light behind them
        assert surfels.mean() > 0.1
        assert (other[surfels] <= one[surfels]).all()
        assert other[surfels].mean() < 0.95 * one[surfels].mean()  # what a dark surface reflects stays
    for plain, dark in zip(read_clips(pairs, "test"), read_clips(made[1], "test")):
        np.testing.assert_array_equal(dark.frames["pbr"], plain.frames["pbr"])
    with pytest.raises(TronError, match=r"made with captured\.truth=None"):
        make(recipe(pairs, f"captured.truth={tmp_path / '0.5' / 'truth'}"))


def test_another_captures_truth_is_refused_before_the_reconstruction(
    recipe: Recipe, tiny_captures: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    views = read_capture_folder(tiny_captures / NAME).views
    turned = tuple(replace(view, camera=other.camera) for view, other in zip(views, views[1:] + views[:1]))
    write_capture(tmp_path / "turned" / NAME, Capture(turned, up=np.array([0.0, 0.0, 1.0])))
    bare = tuple(replace(view, base_color=None) for view in views)
    write_capture(tmp_path / "bare" / NAME, Capture(bare, up=np.array([0.0, 0.0, 1.0])))
    (tmp_path / "empty").mkdir()
    for name, words in (
        ("turned", "is not seen from where the photo of that name was taken"),
        ("bare", "no true view has base color and a mask"),
        ("empty", "captured.truth holds nothing of this capture"),
    ):
        assert make(recipe(tmp_path / f"{name}_pairs", f"captured.truth={tmp_path / name}")) == 1
        assert words in caplog.text
        assert "surfels are learnt" not in caplog.text
    with pytest.raises(TronError, match=r"give captured\.relit too"):
        recipe(tmp_path / "x", f"captured.truth={tmp_path}", "captured.relit=null")


@pytest.mark.long
def test_a_run_that_ends_before_the_relit_clips_goes_on_to_the_same_bytes(
    pairs: Path, recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, files_of
):
    real = datagen.sources.captured.relit_clips

    def ends_after_one(*arguments):
        yield next(iter(real(*arguments)))
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(datagen.sources.captured, "relit_clips", ends_after_one)
        with pytest.raises(KeyboardInterrupt):
            make(recipe(tmp_path / "again"))
    assert not list((tmp_path / "again").glob("*_relit-*.tar"))
    assert make(recipe(tmp_path / "again")) == 0
    assert files_of(tmp_path / "again") == files_of(pairs)


def test_a_reconstruction_is_taken_over_and_gives_the_same_bytes(
    pairs: Path, recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, files_of
):
    def find(*arguments):
        raise AssertionError("it is reconstructed again")

    monkeypatch.setattr(datagen.sources.captured, "find", find)
    again = recipe(tmp_path / "again", f"captured.reconstructed={pairs}")
    assert make(again) == 0
    theirs, ours = files_of(pairs), files_of(again.output_dir)
    card = "README.md"  # names the command, which says where it came from
    assert ours.pop(card) != theirs.pop(card)
    assert ours == theirs
    with pytest.raises(TronError, match=r"captured\.reconstruction\.steps_scaler"):
        make(
            recipe(
                tmp_path / "other",
                f"captured.reconstructed={pairs}",
                "captured.reconstruction.steps_scaler=2",
            )
        )
    with pytest.raises(TronError, match="no dataset of captures"):
        make(recipe(tmp_path / "other", f"captured.reconstructed={tmp_path}"))


def test_a_dataset_whose_surfels_are_gone_gives_no_reconstruction(
    pairs: Path, recipe: Recipe, tmp_path: Path
):
    (item,) = plan(recipe(pairs))
    other, mine = tmp_path / "other", tmp_path / "mine"
    shutil.copytree(pairs / "scenes", other / "scenes")
    (other / "scenes" / item.name / "environment.exr").unlink()
    settings = recipe(tmp_path, f"captured.reconstructed={other}")
    capture = load(item, settings, tmp_path, reduced=True)
    mine.mkdir()
    assert not take_over(item, settings, capture, mine)
    assert not list(mine.iterdir())
    shutil.copy(pairs / "scenes" / item.name / "environment.exr", other / "scenes" / item.name)
    assert take_over(item, settings, capture, mine)


def test_a_plan_counts_no_reconstruction_that_is_taken_over(pairs: Path, recipe: Recipe, tmp_path: Path):
    found = recipe(tmp_path / "out", f"captured.reconstructed={pairs}")
    whole, rest = (SOURCE.cost(plan(each)[0], each).seconds for each in (recipe(tmp_path / "out"), found))
    assert 0 < rest < 0.1 * whole
    with pytest.raises(TronError, match="no dataset of captures"):
        project(recipe(tmp_path / "out", f"captured.reconstructed={tmp_path}"))


def test_a_captures_name_is_no_pattern(recipe: Recipe, relit: Path, tmp_path: Path):
    shutil.copytree(relit / f"{NAME}_1_sun", tmp_path / "relit" / "scan[1]_1_sun")
    shutil.copytree(relit / f"{NAME}_1_sun", tmp_path / "relit" / "scan1_2_sun")
    settings = recipe(tmp_path / "out", f"captured.relit={tmp_path / 'relit'}")
    assert [truth.number for truth in find_relit(settings, "scan[1]")] == [1]


def test_a_dataset_without_relit_clips_is_another(pairs: Path, recipe: Recipe):
    with pytest.raises(TronError, match=r"captured\.relit"):
        make(recipe(pairs, "captured.relit=null"))


def test_a_folder_that_does_not_go_with_the_captures_is_refused_in_a_line(
    recipe: Recipe, relit: Path, tmp_path: Path
):
    without_light, photos = tmp_path / "a", tmp_path / "b"
    shutil.copytree(relit, without_light)
    (without_light / f"{NAME}_2_studio" / "environment.exr").unlink()
    (photos / f"{NAME}_1_sun").mkdir(parents=True)
    (photos / f"{NAME}_1_sun" / "environment.exr").touch()
    for overrides, said in (
        (["captured.names=[test-000000]"], "holds nothing of the capture test-000000"),
        ([f"captured.relit={tmp_path / 'nothing'}"], "no folder"),
        ([f"captured.relit={without_light}"], "light of the relit views is missing"),
        ([f"captured.relit={photos}"], "no such capture folder|transforms"),
    ):
        with pytest.raises(TronError, match=said) as error:
            make(recipe(tmp_path / "out", *overrides))
        assert "\n" not in str(error.value)
        assert not (tmp_path / "out").exists()


def test_truth_of_another_capture_under_this_name_fails_before_reconstruction(
    recipe: Recipe, relit: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Names alone would pair a scene's surfels with another scene's truth."""
    monkeypatch.setattr(datagen.sources.captured, "find", never)
    for name in LIGHTS:
        truth = read_capture_folder(relit / f"{NAME}_{name}")
        views = [replace(view, camera=_turned(view.camera)) for view in truth.views]
        light = {"environment.exr": (relit / f"{NAME}_{name}" / "environment.exr").read_bytes()}
        write_capture(tmp_path / "relit" / f"{NAME}_{name}", replace(truth, views=tuple(views)), beside=light)
    assert make(recipe(tmp_path / "out", f"captured.relit={tmp_path / 'relit'}")) == 1
    assert "is not seen from where the photo" in (tmp_path / "out/failures.jsonl").read_text()


def never(*_: object) -> None:
    raise AssertionError("it is reconstructed")


def _turned(camera: Camera) -> Camera:
    """The camera on the other side of the up axis."""
    half = np.diag([-1.0, -1.0, 1.0, 1.0])
    return replace(camera, world_to_camera=camera.world_to_camera @ half)


def test_captures_that_are_named_by_split_are_noticed(recipe: Recipe, tmp_path: Path):
    assert not named_by_split(recipe(tmp_path / "out"))
    settings = recipe(tmp_path / "out", "captured.split_by_name=false", "captured.relit=null")
    assert named_by_split(settings)


def test_captures_keep_the_split_that_their_names_say():
    found = split_by_name(["train-000002", "test-000000", "train-000001", "train_b-000001"])
    assert found == {
        "train": ["train-000001", "train-000002"], "train_b": ["train_b-000001"], "test": ["test-000000"],
    }  # fmt: skip
    with pytest.raises(TronError, match="the capture fox begins with no split's name"):
        split_by_name(["train-000000", "fox"])
