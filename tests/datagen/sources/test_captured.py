"""Captures as a source: photos are the truth, guidance is comparable with them, runs repeat and resume."""

import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

import datagen.sources.captured
import datagen.sources.captured_reconstruction
from datagen.dataset.records import Work, starts
from datagen.files.sources import read_source_list
from datagen.photographs.pseudo_captures import write_blind_capture
from datagen.run.cost import estimate_bytes, project
from datagen.run.dataset import make
from datagen.run.merge import merge
from datagen.run.plan import chosen, plan
from datagen.run.validate import validate
from datagen.settings.captures import Shares
from datagen.settings.command import SPLITS, Settings
from datagen.sources import SOURCES
from datagen.sources.captured_clips import balanced, frame_of, in_order, rows_of_photos
from datagen.sources.captured_folder import apportioned, split_of
from datagen.sources.captured_reconstruction import PHASES, load
from tron.cameras import Camera
from tron.captures import Capture, View, load_capture
from tron.cli.recipes import check, compose_recipe
from tron.color import agx, linear_to_srgb, srgb_to_linear
from tron.errors import TronError
from tron.estimation import FINEST
from tron.io.images import encode_png
from tron.seeds import generator
from tron.shards.manifest import Manifest
from tron.shards.reader import read_clips
from tron.shards.schema import MEMBERS, clip_members

Recipe = Callable[..., Settings]
SOURCE = SOURCES["captured"]
CAMERA = Camera.look_at((0, -3, 1), (0, 0, 0), fov_deg=40, width=12, height=8)

pytestmark = pytest.mark.long


def settings_of(*overrides: str) -> Settings:
    return check(compose_recipe("conf.datagen", Settings, overrides), Settings)


@pytest.fixture(scope="module")
def recipe(variant, tiny_captures, pair_words) -> Recipe:
    """Settings of the tiny captures' pairs in a folder."""

    def recipe(output: Path, *overrides: str, captures: Path = tiny_captures) -> Settings:
        return settings_of(*pair_words, f"captures={captures}", f"output_dir={output}", *overrides)

    return recipe


@pytest.fixture(scope="module")
def pairs(tiny_pairs: Path) -> Path:
    return tiny_pairs


def test_every_capture_is_wholly_in_one_split_and_all_of_it_is_accounted_for(pairs: Path):
    assert validate(pairs) == 0
    manifest = Manifest.load(pairs)
    assert manifest.splits() == ["test", "train", "validation"]
    scenes = yaml.safe_load((pairs / "config.yaml").read_text())["scenes"]
    assert sorted(name for names in scenes.values() for name in names) == [f"test-00000{i}" for i in range(3)]
    for split, names in scenes.items():
        assert {clip.meta.extra["capture"] for clip in read_clips(pairs, split)} == set(names)
    assert not list(pairs.glob("scenes/*/work")), "what only an interrupted run needs is left"
    card = (pairs / "README.md").read_text()
    assert "| train | 1 | 3 | 9 | 20 x 16 |" in card
    assert "photos" in card
    assert "Mitsuba's path tracer" not in card
    assert "bytes of linear values, but for `rgb`: photos are display values" in card


def test_clips_hold_neighbouring_photos_as_display_values_and_all_guidance(pairs: Path, tiny_captures: Path):
    for split in ("train", "validation", "test"):
        for clip in read_clips(pairs, split):
            capture = load_capture(tiny_captures / clip.meta.extra["capture"])
            rows = [[view.name for view in row] for row in rows_of_photos(capture)]
            names = clip.meta.extra["photos"]
            assert any(names == row[k : k + 3] for row in rows for k in range(len(row)))
            assert not set(names) & capture.test
            assert set(clip.frames) == set(clip_members(reference=False))
            assert clip.is_display("rgb")
            assert not clip.is_display("lit")
            views = {view.name: view for view in capture.views}
            for k, name in enumerate(names):
                camera = Camera.from_dict(clip.meta.cameras[k])
                np.testing.assert_allclose(camera.position, views[name].camera.position, atol=1e-9)
                assert (camera.width, camera.height) == (20, 16)


@pytest.mark.long
def test_captures_are_lit_at_a_quality_of_tron_relight(recipe: Recipe, pairs: Path, tmp_path: Path):
    wanted = recipe(tmp_path / "final", "captured.guidance_spp=final", f"captured.reconstructed={pairs}")
    assert make(wanted) == 0
    final = next(read_clips(tmp_path / "final", "test"))
    assert final.meta.spp == {"guidance": FINEST.rays, "reflections": FINEST.reflections}
    assert final.meta.extra["sub_pixels"] == FINEST.supersample
    even = next(clip for clip in read_clips(pairs, "test") if clip.meta.key == final.meta.key)
    assert even.meta.spp == {"guidance": 2}
    assert (final.frames["sampling"] > even.frames["sampling"]).any()


def test_guidance_times_exposure_is_as_bright_as_the_photos(pairs: Path):
    """Through AgX, as training and evaluation look at both: the median over what both show."""
    for split in ("train", "validation", "test"):
        clips = list(read_clips(pairs, split))
        photos, shown = (
            np.concatenate([c.displayed(name).ravel() for c in clips]) for name in ("rgb", "lit")
        )
        solid = np.concatenate(
            [np.repeat((c.frames["mask"] > 0.9) & (c.frames["foreground"] > 0), 3) for c in clips]
        )
        assert abs(np.median(photos[solid]) - np.median(shown[solid])) < 0.08


def test_linear_photos_are_the_light_that_their_curve_was_given(pairs, recipe, tiny_captures, tmp_path):
    output = tmp_path / "linear"
    assert make(recipe(output, "captured.linear=true", f"captured.reconstructed={pairs}")) == 0
    for split in ("train", "validation", "test"):
        for clip, shown in zip(read_clips(output, split), read_clips(pairs, split), strict=True):
            capture = load_capture(tiny_captures / clip.meta.extra["capture"])
            light = clip.frames["rgb"].astype(np.float64) * capture.exposure
            assert capture.tone_curve == "agx"
            np.testing.assert_allclose(agx(light), shown.frames["rgb"], atol=0.01)  # 8 bits, out of gamut
            assert not clip.is_display("rgb")
            np.testing.assert_array_equal(clip.frames["lit"], shown.frames["lit"])
            assert clip.meta.exposure == shown.meta.exposure
    assert "bytes of linear values." in (output / "README.md").read_text().replace("\n", " ")


def test_training_reads_the_pairs_as_they_are(pairs: Path):
    from train.examples.framing import Sample

    clip = next(iter(read_clips(pairs, "train")))
    sample = Sample.of(clip)
    assert sample.display == frozenset({"rgb"})
    assert float(sample.buffers["rgb"].max()) <= 1
    np.testing.assert_allclose(
        sample.buffers["lit"].numpy().transpose(1, 2, 3, 0),
        clip.frames["lit"] * clip.meta.exposure,
        rtol=1e-5,
    )


def test_captures_are_drawn_from_no_seed(pairs: Path):
    """Else a benchmark of the same seed would be said to share its scenes with them."""
    assert read_source_list(pairs).splits == ()


@pytest.mark.long
def test_a_run_that_ends_before_its_clips_goes_on_to_the_same_bytes(
    pairs, recipe, tmp_path, monkeypatch, files_of
):
    def ends(*arguments, **keywords):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(datagen.sources.captured, "write_clips", ends)
        with pytest.raises(KeyboardInterrupt):
            make(recipe(tmp_path / "again"))
    assert make(recipe(tmp_path / "again")) == 0
    assert files_of(tmp_path / "again") == files_of(pairs)


def test_a_run_that_ends_between_two_steps_goes_on_to_the_same_bytes(
    pairs, recipe, tmp_path, monkeypatch, files_of, caplog
):
    real = datagen.sources.captured_reconstruction.reconstruct

    def ends_at_step_6(*arguments, watch, **keywords):
        def watched(progress, stage):
            watch(progress, stage)
            if progress.step == 6:
                raise KeyboardInterrupt

        return real(*arguments, watch=watched, **keywords)

    with monkeypatch.context() as patch:
        patch.setattr(datagen.sources.captured_reconstruction, "reconstruct", ends_at_step_6)
        with pytest.raises(KeyboardInterrupt):
            make(recipe(tmp_path / "again"))
    with caplog.at_level("INFO"):
        assert make(recipe(tmp_path / "again")) == 0
    assert "resuming from step 4 of stage radiance" in caplog.text
    assert files_of(tmp_path / "again") == files_of(pairs)


def test_a_capture_that_cannot_be_used_is_a_failure_and_the_others_are_made(
    recipe, tiny_captures, tmp_path, pairs
):
    captures = tmp_path / "captures"
    shutil.copytree(tiny_captures / "test-000000", captures / "good")
    (captures / "bad").mkdir()
    for k in range(4):
        Image.new("RGB", (24, 24), (40 * k, 9, 9)).save(captures / "bad" / f"{k}.png")
    settings = recipe(tmp_path / "out", "captured.shares.validation=0", "captured.shares.test=0",
                      captures=captures)  # fmt: skip
    assert make(settings) == 1
    (line,) = [json.loads(text) for text in (tmp_path / "out/failures.jsonl").read_text().splitlines()]
    assert line["capture"] == "bad"
    assert Manifest.load(tmp_path / "out").splits() == ["train"]
    shutil.rmtree(captures / "bad")
    again = settings_of(*shlex.split(line["command"])[1:])
    assert again.recipe() == settings.recipe()
    assert again.captures == captures
    assert make(recipe(tmp_path / "joint", "prior=joint", "captured.prior.sun=1", captures=captures)) == 0
    assert "captured.prior.sun=1" in (tmp_path / "joint/README.md").read_text()
    with pytest.raises(TronError, match="other captures: bad"):
        make(settings)


def test_photos_that_are_too_small_or_too_few_in_a_row_are_told(recipe, tmp_path):
    for override, said in (("captured.width=32", "fewer than a frame"), ("captured.frames=8", "in a row")):
        output = tmp_path / override.partition("=")[0]
        assert make(recipe(output, override, "only=[train-000000]")) == 1
        assert said in (output / "failures.jsonl").read_text()


def test_a_photo_that_is_no_image_is_told_once(recipe, tiny_captures, tmp_path, caplog):
    """A capture is read twice, its photos reduced and as they are."""
    poses = {view.name: view.camera for view in load_capture(tiny_captures / "test-000000").views}
    files = {name: encode_png(np.zeros((pose.height, pose.width, 3))) for name, pose in poses.items()}
    broken = next(iter(files))
    files[broken] = b"no image"
    write_blind_capture(tmp_path / "captures" / "mine", poses, files, ".png", None)
    item = Work("train", 0, "train-000000", 0, "mine")
    settings = recipe(tmp_path / "out", captures=tmp_path / "captures")
    for reduced in (True, False):
        (reason,) = load(item, settings, tmp_path / "work", reduced).skipped.values()
        assert reason == "damaged, or not an image"
    assert caplog.text.count("(damaged, or not an image)") == 1


def test_a_plan_says_what_is_missing_and_makes_nothing(recipe, tmp_path):
    text = project(recipe(tmp_path / "out"))
    assert "3 of 3: train-000000" in text
    assert "within a factor of two" in text
    assert not (tmp_path / "out").exists()


def gigabytes(text: str, row: str) -> float:
    return float(text.split(f"\n{row}")[1].split()[0])


def test_what_is_asked_for_bounds_what_stays_and_clips_are_those_that_photos_give(recipe, tmp_path):
    """Scenes of several splits are under way at once no more than those of one."""
    text = project(recipe(tmp_path / "out", "cluster=local", "workers=3"))
    assert gigabytes(text, "asked for") > gigabytes(text, "bytes on disk") > 0
    for photos, frames, every, clips in ((48, 5, 8, 12), (48, 5, 0, 10), (12, 5, 0, 3), (3, 5, 0, 1)):
        settings = recipe(tmp_path, f"captured.frames={frames}", f"captured.photos.test_every={every}")
        assert SOURCE.clips(Work("train", 0, "a", 0, "a", photos), settings) == clips


def test_hours_of_captures_are_near_what_sixteen_took(recipe, tmp_path):
    how = ("steps_scaler=0.1", "radiance.steps=30000", "materials.steps=7000")
    size = ("captured.width=128", "captured.height=96")
    settings = recipe(tmp_path, *size, *(f"captured.reconstruction.{key}" for key in how))
    cost = SOURCE.cost(Work("train", 0, "a", 0, "a", 47), settings)
    assert 0.8 < cost.seconds / (7.6 * 60) < 1.25


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("captures=null", "captures=DIR"),
        ("captures=s3://bucket/captures", "local folder"),
        ("train.scenes=3", "train.scenes is of source=synthetic"),
        ("environments=maps", "environments is of source=synthetic"),
        ("mode=captures", "mode=captures is of source=synthetic"),
        ("disjoint_from=[outputs/demo]", "disjoint_from is of source=synthetic"),
        ("captured.shares={train:0,validation:0,test:0}", "all shares are 0"),
        ("prior=magic", "unknown prior"),
    ],
)
def test_settings_that_do_not_go_with_captures_are_refused_in_a_line(override, said):
    with pytest.raises(TronError, match=said) as error:
        settings_of("source=captured", "captures=photos", "output_dir=out", override)
    assert "\n" not in str(error.value)


@pytest.mark.long
def test_parts_and_a_store_have_the_bytes_of_one_run(pairs, recipe, files_of, tmp_path):
    parts, merged, kept, store = (
        [tmp_path / "1", tmp_path / "2"],
        *(tmp_path / name for name in ("m", "s", "u")),
    )
    for number, part in enumerate(parts, start=1):
        assert make(recipe(part, f"shard={number}/2")) == 0
    assert merge(recipe(merged, "mode=merge", f"merge=[{parts[0]},{parts[1]}]")) == 0
    assert files_of(merged) == files_of(pairs)
    sent = recipe(kept, f"store=file://{store}")
    for _ in range(2):
        assert make(sent) == 0
    assert files_of(pairs) == files_of(kept) | {
        name: data for name, data in files_of(store).items() if name.endswith((".tar", ".idx"))
    }
    assert "scenes to make  0 of 3" in project(sent), "what is in the store is not missing"


def test_the_space_of_a_capture_grows_with_its_photos(recipe, tmp_path):
    """All its frames wait on disk until they are cut into clips, beside the shards of the same."""
    settings = recipe(tmp_path)
    few, many = (estimate_bytes(settings, [Work("train", 0, "a", 0, "a", n)], shards=False) for n in (3, 300))
    frames = 297 * 20 * 16 * sum(MEMBERS[name].channels * 2 for name in clip_members(reference=False))
    assert many - few >= frames


def test_captures_without_the_source_are_refused():
    with pytest.raises(TronError, match="give source=captured"):
        settings_of("captures=photos", "output_dir=out")


def test_a_folder_that_is_no_folder_of_captures_is_refused(recipe, tiny_captures, tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "above/captures").mkdir(parents=True)
    (tmp_path / "above/captures/manifest.json").touch()
    for captures, said in (
        (tmp_path / "nothing", "no folder"),
        (tmp_path / "empty", "holds no captures"),
        (tiny_captures / "test-000000", "a capture itself"),
        (tmp_path / "above", "one folder down"),
        (tmp_path, "output_dir lies in captures"),
    ):
        with pytest.raises(TronError, match=said):
            plan(recipe(tmp_path / "out", captures=captures))


def test_only_takes_the_scene_of_a_name_and_a_capture_where_no_scene_has_it():
    items = [
        Work("train", 0, "train-000000", 0, "train-000001"),
        Work("train", 1, "train-000001", 100, "test-000000"),
        Work("train", 2, "train-000002", 200, "fox"),
    ]
    assert [item.name for item in chosen(items, ["train-000001"])] == ["train-000001"]
    assert [item.name for item in chosen(items, ["fox", "test-000000"])] == ["train-000001", "train-000002"]
    with pytest.raises(TronError, match="no such scene"):
        chosen(items, ["horse"])


def test_the_folder_of_another_source_is_refused(pairs, tmp_path, tiny_scenes):
    shutil.copy(pairs / "config.yaml", tmp_path)
    with pytest.raises(TronError, match="source"):
        make(settings_of(f"output_dir={tmp_path}", "cluster=none", *tiny_scenes))


def test_splits_follow_seed_and_name_and_small_sets_fill_the_largest_shares_first():
    names = [f"capture{i}" for i in range(20)]
    shares = Shares(train=0.5, train_b=0.3, validation=0.1, test=0.1)
    found = split_of(names, shares, seed=3)
    assert sorted(name for each in found.values() for name in each) == sorted(names)
    assert {split: len(each) for split, each in found.items()} == {
        "train": 10, "train_b": 6, "validation": 2, "test": 2,
    }  # fmt: skip
    assert split_of(names[::-1], shares, seed=3) == found
    assert split_of(names, shares, seed=4) != found
    assert list(split_of(names[:2], shares, seed=3)) == ["train", "train_b"]
    assert set(split_of(names[:4], shares, seed=3)) == set(SPLITS)
    for total in range(30):
        assert sum(apportioned(shares.model_dump(), total).values()) == total


def test_rows_are_in_the_order_that_people_number_and_end_at_lost_photos():
    image = np.zeros((8, 12, 3))
    views = tuple(View(f"img_{i}", CAMERA, image, "display") for i in (1, 10, 2, 3, 9, 5, 6))
    capture = Capture(views, test=frozenset({"img_3"}), skipped={"img_4.jpg": "damaged", "img_8": "no pose"})
    assert [[view.name for view in row] for row in rows_of_photos(capture)] == [
        ["img_1", "img_2"], ["img_5", "img_6"], ["img_9", "img_10"],
    ]  # fmt: skip
    assert sorted(["b10", "b9", "a"], key=in_order) == ["a", "b9", "b10"]


@pytest.mark.parametrize("frames", [1, 3, 5])
def test_clips_of_a_row_hold_all_its_photos_if_it_is_long_enough(frames):
    for count in range(20):
        found = starts(count, frames)
        covered = {start + k for start in found for k in range(frames)}
        assert covered == (set(range(count)) if count >= frames else set())


def test_a_balanced_photo_is_the_mean_photo_and_no_gain_changes_no_bit():
    rng = generator(3, "test")
    mean = rng.uniform(0.2, 0.6, (8, 12, 3)).astype(np.float32)
    gain = np.array([1.3, 0.9, 0.7])
    photo = linear_to_srgb(srgb_to_linear(mean) * gain).astype(np.float32)
    np.testing.assert_allclose(balanced(photo, gain, "srgb"), mean, atol=1e-5)
    np.testing.assert_array_equal(balanced(photo, np.ones(3), "srgb"), photo)


def test_a_photo_in_a_frame_shows_points_where_its_camera_says():
    """A ramp along x: what a frame shows at a pixel is what the photo shows along the same ray."""
    camera = Camera.look_at((0, -3, 1), (0, 0, 0), fov_deg=50, width=90, height=40)
    ramp = np.broadcast_to(((np.arange(90) + 0.5) / 90)[None, :, None], (40, 90, 3))
    photo = frame_of(View("a", camera, ramp, "display"), np.ones(3), "srgb", 20, 16)
    rays = photo.camera.rays()
    pixels, _ = camera.project(camera.position + rays.reshape(-1, 3))
    np.testing.assert_allclose(photo.shown.reshape(-1, 3)[:, 0], pixels[:, 0] / 90, atol=2e-3)


@pytest.mark.long
@pytest.mark.parametrize("phase", PHASES)
def test_a_run_that_is_killed_in_any_phase_goes_on_to_the_same_bytes(
    phase, pairs, recipe, pair_words, tmp_path, files_of
):
    output, log = tmp_path / "again", tmp_path / "log"
    with log.open("wb") as file:
        command = [sys.executable, "-c", "from datagen.cli import cli; cli()"]
        command += [*pair_words, f"output_dir={output}"]
        process = subprocess.Popen(command, stdout=file, stderr=file, start_new_session=True)
        while PHASES[phase].encode() not in log.read_bytes():
            assert process.poll() is None, log.read_text()
            time.sleep(0.01)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    assert not (output / "manifest.json").exists()
    assert make(recipe(output)) == 0
    assert files_of(output) == files_of(pairs)
