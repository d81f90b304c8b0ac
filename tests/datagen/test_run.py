"""The engine's promises: resumable, repeatable, accounted for, finite, never two datasets in one folder."""

import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
import yaml

import datagen.scene_geometry
from datagen.card import command_line
from datagen.plan import Sources, Work, adopt, plan
from datagen.run import make, make_scene
from datagen.scene import SceneSpec
from datagen.settings import ESTIMATED, Settings
from datagen.synthetic import make_clips
from datagen.validate import validate
from tron.cli.recipes import check, compose_recipe
from tron.errors import TronError
from tron.estimation import FINAL
from tron.gaussians.scene import GaussianScene
from tron.images import read_image, write_image
from tron.shards.manifest import Manifest
from tron.shards.reader import read_clips
from tron.shards.schema import MEMBERS, clip_members
from tron.shards.verify import verify
from tron.storage import locked

pytestmark = pytest.mark.usefixtures("variant")

TINY = [
    "train.scenes=2",
    "train_b.scenes=1",
    "validation.scenes=1",
    "test.scenes=1",
    "views=6",
    "view_width=32",
    "view_height=32",
    "surfels=1500",
    "refine_steps=3",
    "mesh_edge=0.2",
    "environment_height=16",
    "path_frames=8",
    "objects=[2,2]",
    "cluster=none",
]
for _split in ("train", "train_b", "validation", "test"):
    TINY += [
        f"{_split}.lights=[overcast,any]",
        f"{_split}.frames=2",
        f"{_split}.width=16",
        f"{_split}.height=12",
        f"{_split}.path_spp=2",
        f"{_split}.guidance_spp=2",
        f"{_split}.reference_spp=2",
    ]


def tiny(output: Path, *overrides: str) -> Settings:
    return check(
        compose_recipe("conf.datagen", Settings, [*TINY, f"output_dir={output}", *overrides]), Settings
    )


@pytest.fixture(scope="module")
def dataset(variant, tmp_path_factory) -> Path:
    output = tmp_path_factory.mktemp("dataset")
    assert make(tiny(output)) == 0
    return output


def test_a_dataset_is_whole_and_has_everything_beside_its_shards(dataset):
    assert verify(dataset) == []
    assert validate(dataset) == 0
    manifest = Manifest.load(dataset)
    assert manifest.splits() == ["test", "train", "train_b", "validation"]
    assert sum(entry.samples for entry in manifest.shards) == 10
    for name in (
        "config.yaml",
        "index.html",
        "README.md",
        "scenes/train-000001/spec.json",
        "previews/test-00000.png",
    ):
        assert (dataset / name).is_file()
    GaussianScene.load(dataset / "scenes/train_b-000000/surfels.ply").validate()
    assert not (dataset / "failures.jsonl").exists()
    card = (dataset / "README.md").read_text()
    assert "| train | 2 | 4 | 8 | 16 x 12 |" in card
    assert "mitsuba" in card
    page = (dataset / "index.html").read_text()
    assert "previews/train-00001.png" in page
    assert "http" not in page


def test_clips_hold_consecutive_frames_with_true_metadata(dataset):
    clips = list(read_clips(dataset, "test"))
    assert clips[0].meta.light_family == "overcast"
    for clip in clips:
        assert set(clip.frames) == set(MEMBERS)
        seen = clip.frames["foreground"][..., 0] > 0
        shadowed, unshadowed = (clip.frames[name][seen] for name in ("irradiance_ref", "unshadowed_ref"))
        assert (shadowed <= unshadowed * 1.001).all()
        assert (shadowed < 0.9 * unshadowed).any()
        true, ours = (clip.frames[name][..., 0] for name in ("depth_ref", "depth"))
        assert true[seen].min() > 3
        assert (true[~seen] == 0).all()
        assert np.median(np.abs(true - ours)[seen]) < 0.05
        assert len(clip.meta.cameras) == clip.meta.frames == 2
        assert clip.meta.exposure > 0
        foreground = clip.frames["foreground"]
        assert set(np.unique(foreground)) <= {0.0, 1.0}
        # Where the truth has a surface, so have the surfels, but for their rims.
        assert clip.frames["mask"][foreground > 0].mean() > 0.9
        normal = clip.frames["normal_ref"][foreground[..., 0] > 0]
        np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), 1.0, atol=1e-3)
    for split in ("train", "validation"):
        for clip in read_clips(dataset, split):
            assert set(clip.frames) == set(clip_members(reference=False))


def test_guidance_and_frames_see_the_same_light(dataset):
    """Means over the foreground agree within a factor: another exposure, rotation or unit would show."""
    for clip in read_clips(dataset, "train"):
        seen = clip.frames["foreground"][..., 0] > 0
        ratio = clip.frames["rgb"][seen].mean() / clip.frames["shadowed"][seen].mean()
        assert 0.5 < ratio < 2.0


def test_lit_is_brighter_than_direct_light_and_equal_to_it_where_nothing_bounces(dataset, variant, tmp_path):
    assert make(tiny(tmp_path, "bounces=0", "only=[test-000000]")) == 0
    pairs = list(zip(read_clips(dataset, "test"), read_clips(tmp_path, "test"), strict=True))
    for clip, direct in pairs:
        seen = clip.frames["foreground"][..., 0] > 0
        for name in ("pbr", "irradiance", "unshadowed", "shadowed", "rgb"):
            np.testing.assert_array_equal(clip.frames[name], direct.frames[name])
        np.testing.assert_array_equal(direct.frames["lit"], direct.frames["shadowed"])
        np.testing.assert_array_equal(direct.frames["lit_reflections"], direct.frames["lit_supersampled"])
        lit, shadowed = (clip.frames[name][seen].mean() for name in ("lit", "shadowed"))
        assert 1.02 * shadowed < lit < 2 * shadowed
        # the finer forms show the same scene: other pixels, other reflections
        for name in ("lit_supersampled", "lit_reflections"):
            assert clip.frames[name][seen].mean() == pytest.approx(lit, rel=0.15)
            assert (clip.frames[name] != clip.frames["lit"]).any()
    assert any((c.frames["lit_reflections"] != c.frames["lit_supersampled"]).any() for c, _ in pairs)


def test_light_on_the_surfels_is_estimated_as_everywhere_else_unless_told_otherwise(tmp_path):
    settings = tiny(tmp_path, "test.guidance_spp=64")
    assert settings.estimation("test") == FINAL
    chosen = {"estimator": "plain", "two_sided": False, "diffuse": "lambert", "bounces": 1}
    chosen |= {"reflections": 4, "supersample": 2}
    assert set(chosen) == set(ESTIMATED)
    other = tiny(tmp_path, "test.guidance_spp=64", *(f"{key}={value}" for key, value in chosen.items()))
    assert other.estimation("test") == FINAL.model_copy(update=chosen)


def test_the_recipe_of_models_makes_test_scenes_alone_under_every_map(variant, tmp_path):
    for number in range(4):
        (tmp_path / "maps").mkdir(exist_ok=True)
        sky = np.full((8, 16, 3), 0.2 + 0.2 * number, np.float32)
        write_image(tmp_path / "maps" / f"sky{number}.hdr", sky)
    (tmp_path / "models").mkdir()
    trimesh.creation.box().export(tmp_path / "models" / "box.obj")
    (tmp_path / "models" / "broken.obj").write_text("v 0 0 0\n")
    settings = check(
        compose_recipe(
            "conf.datagen",
            Settings,
            [
                "experiment=models",
                *(word for word in TINY if not word.startswith(("train", "validation", "test.lights"))),
                "test.lights=[hdri,hdri,hdri,hdri,hdri,hdri]",
                "path_frames=24",
                f"assets={tmp_path / 'models'}",
                "asset_names=[box]",
                f"environments={tmp_path / 'maps'}",
                "allow_unlicensed=[box,sky0,sky1,sky2,sky3]",
                f"output_dir={tmp_path / 'out'}",
            ],
        ),
        Settings,
    )
    assert (settings.used_splits(), settings.split("test").reference_buffers) == (["test"], True)
    assert make(settings) == 0
    clips = list(read_clips(tmp_path / "out", "test", ("lit", "lit_reflections")))
    assert {clip.meta.light_family for clip in clips} == {"hdri"}
    # with maps held out only the last of the four would light the test split
    assert len({json.loads(clip.meta.extra["light_spec"])["path"] for clip in clips}) > 1
    spec = SceneSpec.model_validate_json((tmp_path / "out/scenes/test-000000/spec.json").read_text())
    assert {item.asset for item in spec.objects} == {"box"}


def test_a_finished_dataset_is_not_touched(dataset, monkeypatch, files_of):
    def never(*_):
        raise AssertionError("nothing is left to make")

    monkeypatch.setattr(datagen.run, "make_scene", never)
    before = {path: os.stat(dataset / path).st_mtime_ns for path in files_of(dataset)}
    assert make(tiny(dataset)) == 0
    assert {path: os.stat(dataset / path).st_mtime_ns for path in files_of(dataset)} == before


@pytest.fixture
def unfinished(dataset, tmp_path) -> Path:
    """A copy of the dataset whose last training scene has never been made."""
    copy = tmp_path / "unfinished"
    shutil.copytree(dataset, copy)
    shutil.rmtree(copy / "scenes" / "train-000001")
    for file in ("train-00001.tar", "previews/train-00001.png"):
        (copy / file).unlink()
    return copy


def test_an_interrupted_run_ends_with_the_same_bytes(dataset, unfinished, files_of, monkeypatch):
    """Killed between scenes and between a scene's shards and its record, with files half-written."""
    shutil.rmtree(unfinished / "scenes" / "test-000000")
    made = []

    def stops_after_one(item: Work, settings: Settings, sources: Sources):
        if made:
            raise KeyboardInterrupt
        made.append(item.name)
        return make_scene(item, settings, sources)

    monkeypatch.setattr(datagen.run, "make_scene", stops_after_one)
    with pytest.raises(KeyboardInterrupt):
        make(tiny(unfinished))
    monkeypatch.undo()
    assert made == ["train-000001"]
    (unfinished / "scenes" / made[0] / "record.json").unlink()
    (unfinished / ".train-00000.abcd.tar").write_bytes(b"half a shard")
    assert make(tiny(unfinished)) == 0
    assert files_of(unfinished) == files_of(dataset)


def test_a_scene_depends_on_nothing_else_that_is_made(dataset, tmp_path, files_of):
    settings = tiny(tmp_path, "only=[train-000001]")
    assert make(settings) == 0
    alone = files_of(tmp_path)
    whole = files_of(dataset)
    for path in ("train-00001.tar", "scenes/train-000001/surfels.ply", "scenes/train-000001/spec.json"):
        assert alone[path] == whole[path]
    assert [entry.name for entry in Manifest.load(tmp_path).shards] == ["train-00001.tar"]


@pytest.mark.long
def test_a_dataset_grows_without_making_the_old_scenes_again(tmp_path, monkeypatch, files_of):
    small = ["train.scenes=1", "train_b.scenes=0", "validation.scenes=0", "test.scenes=0"]
    assert make(tiny(tmp_path, *small)) == 0
    names = []
    real = make_scene
    monkeypatch.setattr(
        datagen.run, "make_scene", lambda item, *rest: (names.append(item.name), real(item, *rest))[1]
    )
    assert make(tiny(tmp_path, *small, "train.scenes=2")) == 0
    assert names == ["train-000001"]
    with pytest.raises(TronError, match="holds 2 scenes"):
        make(tiny(tmp_path, *small))
    # A split that has no scenes yet may still become anything: so older datasets get a validation split.
    names.clear()
    made = ["train.scenes=2", "validation.scenes=1", "validation.lights=[studio]"]
    before = files_of(tmp_path)
    assert make(tiny(tmp_path, *small, *made)) == 0
    assert names == ["validation-000000"]
    after = files_of(tmp_path)
    assert {path: after[path] for path in before if path.startswith(("scenes/", "train"))} == {
        path: data for path, data in before.items() if path.startswith(("scenes/", "train"))
    }


def test_what_a_split_without_scenes_says_does_not_matter(tmp_path):
    unused = ["validation.scenes=0", "validation.lights=[]", "validation.frames=99", "validation.width=1"]
    settings = tiny(tmp_path, *unused, "test.scenes=0", "test.lights=[hdri]", "test.guidance_spp=3")
    assert [item.split for item in plan(settings)] == ["train", "train", "train_b"]
    assert settings.recipe() == tiny(tmp_path, "validation.scenes=0", "test.scenes=0").recipe()
    with pytest.raises(TronError, match="lights"):
        tiny(tmp_path, "validation.lights=[]")
    with pytest.raises(TronError, match="path_frames"):
        tiny(tmp_path, "test.frames=9")
    with pytest.raises(TronError, match=r"path_frames"):
        tiny(tmp_path, "mode=captures", "test.scenes=0", "test.frames=9")
    with pytest.raises(TronError, match=r"train"):
        tiny(tmp_path, "mode=captures", "train=5")


def test_another_recipe_is_refused_before_anything_is_written(dataset, files_of):
    before = files_of(dataset)
    with pytest.raises(TronError, match=r"path_spp=2, not 3"):
        make(tiny(dataset, "test.path_spp=3"))
    assert files_of(dataset) == before


def test_a_key_that_an_older_dataset_did_not_know_has_its_default(tmp_path):
    adopt(tiny(tmp_path))
    older = yaml.safe_load((tmp_path / "config.yaml").read_text())
    del older["recipe"]["estimator"], older["recipe"]["two_sided"], older["recipe"]["train"]["guidance_spp"]
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(older))
    with pytest.raises(TronError, match=r"a dataset made with train\.guidance_spp=64, not 8"):
        adopt(tiny(tmp_path, "train.guidance_spp=8"))
    with pytest.raises(TronError, match="a dataset made with estimator=ratio, not plain"):
        adopt(tiny(tmp_path, "train.guidance_spp=64", "estimator=plain"))
    adopt(tiny(tmp_path, "train.guidance_spp=64"))


def test_failures_are_listed_and_retried_by_their_command(dataset, unfinished, files_of, monkeypatch, caplog):
    def fails(*_, **__):
        raise RuntimeError("no memory\nfor this")

    monkeypatch.setattr(datagen.scene_geometry, "build", fails)
    settings = tiny(unfinished)
    assert make(settings) == 1
    failure = json.loads((unfinished / "failures.jsonl").read_text())
    assert failure["scene"] == "train-000001"
    assert failure["reason"] == "RuntimeError: no memory for this"
    trace = (unfinished / failure["traceback"]).read_text()
    assert failure["traceback"] == "failures/train-000001.txt"
    assert "in scene_geometry" in trace
    assert trace.endswith("RuntimeError: no memory\nfor this\n")
    assert (
        f"listed in {unfinished / 'failures.jsonl'}, tracebacks in {unfinished / 'failures'}" in caplog.text
    )
    assert Manifest.load(unfinished).failures == 1
    assert verify(unfinished) == []
    assert make(tiny(unfinished, "only=[train-000000]")) == 1, "what is not tried again stays listed"
    assert (unfinished / failure["traceback"]).is_file()

    monkeypatch.undo()
    words = shlex.split(failure["command"])
    assert words[0] == "tron-datagen"
    again = check(compose_recipe("conf.datagen", Settings, words[1:]), Settings)
    assert again.only == ["train-000001"]
    assert again.recipe() == settings.recipe()
    assert make(again) == 0
    assert files_of(unfinished) == files_of(dataset), "no failure and no traceback is left"


def test_values_that_are_not_finite_never_reach_a_shard(tmp_path, monkeypatch):
    def spoilt(*arguments):
        for meta, frames in make_clips(*arguments):
            frames = list(frames)
            if meta.key == "test-000000-l1":
                frames[1]["pbr"][3, 4] = np.nan
            yield meta, frames

    monkeypatch.setattr(datagen.run, "make_clips", spoilt)
    settings = tiny(tmp_path, "train.scenes=0", "train_b.scenes=0", "validation.scenes=0")
    assert make(settings) == 1
    failure = json.loads((tmp_path / "failures.jsonl").read_text())
    assert failure["clip"] == "test-000000-l1"
    assert "frame 1: pbr has 3 values" in failure["reason"]
    assert [clip.meta.key for clip in read_clips(tmp_path, "test")] == ["test-000000-l0"]
    with np.load(tmp_path / "quarantine" / "test-000000-l1.npz") as aside:
        assert np.isnan(aside["pbr"]).sum() == 3
    assert make(settings) == 1, "made again it would be the same; it stays accounted for"


def test_a_folder_in_use_is_refused(tmp_path):
    with locked(tmp_path), pytest.raises(TronError, match="in use"):
        make(tiny(tmp_path))


def test_a_full_disk_is_found_before_the_first_scene(tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=1000))
    with pytest.raises(TronError, match="disk space"):
        make(tiny(tmp_path))
    assert not list(tmp_path.glob("*.tar"))


def test_unknown_scenes_and_empty_datasets_are_refused(tmp_path):
    with pytest.raises(TronError, match="no such scene"):
        make(tiny(tmp_path, "only=[train-000009]"))
    with pytest.raises(TronError, match="no scenes"):
        plan(tiny(tmp_path, *(f"{split}.scenes=0" for split in ("train", "train_b", "validation", "test"))))


@pytest.mark.parametrize("cluster", [None, {"_target_": "dask_jobqueue.SLURMCluster", "cores": 8}])
def test_the_command_of_the_card_makes_the_same_settings(dataset, cluster):
    settings = tiny(dataset, "allow_unlicensed=['a b','c']", "only=[train-000001]")
    settings = settings.model_copy(update={"cluster": cluster})
    words = shlex.split(command_line(settings, str(dataset), settings.only))
    assert check(compose_recipe("conf.datagen", Settings, words[1:]), Settings) == settings


def test_previews_are_the_clips_first_frames_side_by_side(dataset):
    sheet = read_image(dataset / "previews" / "train-00000.png")
    columns = [name for name in clip_members(reference=False) if name != "foreground"]
    assert sheet.shape == (2 * (12 + 2), len(columns) * (16 + 2), 3)
    assert sheet.std() > 0.05


def test_validation_finds_what_is_missing(dataset, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(dataset, copy)
    (copy / "scenes/test-000000/surfels.ply").unlink()
    tar = copy / "train-00000.tar"
    tar.write_bytes(tar.read_bytes()[:-20_000])
    assert validate(copy) >= 2


def test_config_says_how_it_was_made_and_not_where(dataset):
    config = yaml.safe_load((dataset / "config.yaml").read_text())
    assert config["scenes"] == {"train": 2, "train_b": 1, "validation": 1, "test": 1}
    assert str(dataset) not in (dataset / "config.yaml").read_text()
    assert str(dataset) not in (dataset / "README.md").read_text()


@pytest.mark.long
def test_two_workers_make_the_bytes_of_one_process(dataset, tmp_path, files_of):
    assert make(tiny(tmp_path, "cluster=local", "workers=2", "recycle_after=2")) == 0
    assert files_of(tmp_path) == files_of(dataset)
    assert len(list((tmp_path / "logs").glob("worker-*.log"))) == 2


@pytest.mark.long
def test_kill_9_at_any_moment_and_again_gives_the_same_bytes(dataset, tmp_path, files_of):
    command = [sys.executable, "-m", "tests_run_tiny"]
    script = tmp_path / "tests_run_tiny.py"
    output = tmp_path / "out"
    arguments = [*TINY, f"output_dir={output}", "cluster=local", "workers=2"]
    script.write_text(f"from datagen.cli import cli\nif __name__ == '__main__':\n    cli({arguments!r})\n")
    for seconds in (6.0, 14.0):
        process = subprocess.Popen(
            command, cwd=tmp_path, env=os.environ | {"PYTHONPATH": f"{Path.cwd()}:{tmp_path}"}
        )
        time.sleep(seconds)
        process.send_signal(signal.SIGKILL)
        process.wait()
        time.sleep(2.0)  # orphaned workers notice and go
    assert make(tiny(output)) == 0
    assert files_of(output) == files_of(dataset)
