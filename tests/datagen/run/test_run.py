"""What a dataset holds and says of itself; kills, failures, damage: tests/robustness/test_promises.py."""

import json
import os
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml

import datagen.truth.build
from datagen.run.dataset import make
from datagen.run.plan import plan
from datagen.run.validate import validate
from datagen.settings.command import ESTIMATED, Settings
from datagen.settings.command_line import command_line
from datagen.sources.synthetic import make_scene
from datagen.world.scene import SceneSpec
from tron.cli.recipes import check, compose_recipe
from tron.errors import TronError
from tron.estimation import FINAL, MATERIAL
from tron.gaussians.scene import GaussianScene
from tron.io.images import read_image, write_image
from tron.shards.manifest import Manifest
from tron.shards.reader import read_clips, verify
from tron.shards.schema import MEMBERS, clip_members

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture(scope="module")
def tiny(small_settings):
    """Settings of the dataset below, and overrides."""
    return small_settings


@pytest.fixture(scope="module")
def dataset(small_dataset) -> Path:
    return small_dataset


def test_a_dataset_is_whole_and_has_everything_beside_its_shards(dataset):
    assert verify(dataset) == []
    assert validate(dataset) == 0
    manifest = Manifest.load(dataset)
    assert manifest.material == MATERIAL
    assert manifest.splits() == ["test", "train", "train_b"]
    assert sum(entry.samples for entry in manifest.shards) == 7
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
    assert "| train | 2 | 4 | 12 | 32 x 24 |" in card
    assert "mitsuba" in card
    page = (dataset / "index.html").read_text()
    assert "previews/train-00001.png" in page
    assert "http" not in page


def test_clips_hold_consecutive_frames_with_true_metadata(dataset):
    clips = list(read_clips(dataset, "test"))
    assert clips[0].meta.light_family == "sun"
    for clip in clips:
        assert set(clip.frames) == set(MEMBERS)
        seen = clip.frames["foreground"][..., 0] > 0
        shadowed, unshadowed = (clip.frames[name][seen] for name in ("irradiance_ref", "unshadowed_ref"))
        assert (shadowed <= unshadowed * 1.001).all()
        assert (shadowed < 0.9 * unshadowed).any()
        true, ours = (clip.frames[name][..., 0] for name in ("depth_ref", "depth"))
        assert true[seen].min() > 0.5
        assert (true[~seen] == 0).all()
        assert np.median(np.abs(true - ours)[seen]) < 0.05
        assert len(clip.meta.cameras) == clip.meta.frames == 3
        assert clip.meta.exposure > 0
        foreground = clip.frames["foreground"]
        assert set(np.unique(foreground)) <= {0.0, 1.0}
        # Where the truth has a surface, so have the surfels, but for their rims.
        assert clip.frames["mask"][foreground > 0].mean() > 0.9
        normal = clip.frames["normal_ref"][foreground[..., 0] > 0]
        np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), 1.0, atol=1e-3)
    for clip in read_clips(dataset, "train"):
        assert set(clip.frames) == set(clip_members(reference=False))


def test_guidance_and_frames_see_the_same_light(dataset):
    """Means over the foreground agree within a factor: another exposure, rotation or unit would show."""
    for clip in read_clips(dataset, "train"):
        seen = clip.frames["foreground"][..., 0] > 0
        ratio = clip.frames["rgb"][seen].mean() / clip.frames["shadowed"][seen].mean()
        assert 0.5 < ratio < 2.0


def test_lit_is_as_bright_as_the_truth_and_equal_to_direct_light_where_nothing_bounces(
    dataset, variant, tmp_path, tiny
):
    assert make(tiny(tmp_path, "bounces=0", "only=[test-000000]")) == 0
    pairs = list(zip(read_clips(dataset, "test"), read_clips(tmp_path, "test"), strict=True))
    for clip, direct in pairs:
        seen = clip.frames["foreground"][..., 0] > 0
        for name in ("pbr", "irradiance", "unshadowed", "shadowed", "rgb"):
            np.testing.assert_array_equal(clip.frames[name], direct.frames[name])
        np.testing.assert_array_equal(direct.frames["lit"], direct.frames["shadowed"])
        np.testing.assert_array_equal(direct.frames["lit_reflections"], direct.frames["lit_supersampled"])
        lit, true = (clip.frames[name][seen].mean() for name in ("lit", "rgb"))
        assert lit == pytest.approx(true, rel=0.2), "with the noise of four rays"
        assert (clip.frames["lit"] != direct.frames["lit"]).any()
        # the finer forms show the same scene: other pixels, other reflections
        for name in ("lit_supersampled", "lit_reflections"):
            assert clip.frames[name][seen].mean() == pytest.approx(lit, rel=0.15)
            assert (clip.frames[name] != clip.frames["lit"]).any()
    assert any((c.frames["lit_reflections"] != c.frames["lit_supersampled"]).any() for c, _ in pairs)


def test_light_on_the_surfels_is_estimated_as_everywhere_else_unless_told_otherwise(tmp_path, tiny):
    settings = tiny(tmp_path, "test.guidance_spp=64")
    assert settings.estimation("test") == FINAL
    chosen = {"estimator": "plain", "two_sided": False, "brdf": "lambert", "bounces": 1}
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
                *("views=6", "view_width=32", "view_height=32", "surfels=1500", "refine_steps=0"),
                *("mesh_edge=0.2", "environment_height=16", "objects=[2,2]", "cluster=none"),
                *("test.scenes=1", "test.frames=2", "test.width=16", "test.height=12"),
                *("test.path_spp=2", "test.guidance_spp=2", "test.reference_spp=2"),
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


@pytest.mark.long
def test_a_dataset_grows_without_making_the_old_scenes_again(tmp_path, monkeypatch, files_of, tiny):
    small = ["train.scenes=1", "train_b.scenes=0", "validation.scenes=0", "test.scenes=0"]
    assert make(tiny(tmp_path, *small)) == 0
    names = []
    real = make_scene
    monkeypatch.setattr(
        datagen.sources.synthetic,
        "make_scene",
        lambda item, *rest: (names.append(item.name), real(item, *rest))[1],
    )
    assert make(tiny(tmp_path, *small, "train.scenes=2")) == 0
    assert names == ["train-000001"]
    with pytest.raises(TronError, match="holds 2 scenes"):
        make(tiny(tmp_path, *small))
    # A split that has no scenes yet may still become anything: so older datasets get another split.
    names.clear()
    made = ["train.scenes=2", "train_b.scenes=1", "train_b.lights=[overcast]"]
    before = files_of(tmp_path)
    assert make(tiny(tmp_path, *small, *made)) == 0
    assert names == ["train_b-000000"]
    after = files_of(tmp_path)
    assert {path: after[path] for path in before if path.startswith(("scenes/", "train"))} == {
        path: data for path, data in before.items() if path.startswith(("scenes/", "train"))
    }


def test_what_a_split_without_scenes_says_does_not_matter(tmp_path, tiny):
    unused = ["validation.scenes=0", "validation.lights=[]", "validation.frames=99", "validation.width=1"]
    settings = tiny(tmp_path, *unused, "test.scenes=0", "test.lights=[hdri]", "test.guidance_spp=3")
    assert [item.split for item in plan(settings)] == ["train", "train", "train_b"]
    assert settings.recipe() == tiny(tmp_path, "validation.scenes=0", "test.scenes=0").recipe()
    with pytest.raises(TronError, match="lights"):
        tiny(tmp_path, "train.lights=[]")
    with pytest.raises(TronError, match="path_frames"):
        tiny(tmp_path, "test.frames=9")
    with pytest.raises(TronError, match=r"path_frames"):
        tiny(tmp_path, "mode=captures", "test.scenes=0", "test.frames=9")
    with pytest.raises(TronError, match=r"train"):
        tiny(tmp_path, "mode=captures", "train=5")


def test_another_recipe_is_refused_before_anything_is_written(dataset, files_of, tiny):
    before = files_of(dataset)
    with pytest.raises(TronError, match=r"path_spp=4, not 3"):
        make(tiny(dataset, "test.path_spp=3"))
    assert files_of(dataset) == before


def test_unknown_scenes_and_empty_datasets_are_refused(tmp_path, tiny):
    with pytest.raises(TronError, match="no such scene"):
        make(tiny(tmp_path, "only=[train-000009]"))
    with pytest.raises(TronError, match="no scenes"):
        plan(tiny(tmp_path, *(f"{split}.scenes=0" for split in ("train", "train_b", "validation", "test"))))


@pytest.mark.parametrize("cluster", [None, {"_target_": "dask_jobqueue.SLURMCluster", "cores": 8}])
def test_the_command_of_the_card_makes_the_same_settings(dataset, cluster, tiny):
    settings = tiny(dataset, "allow_unlicensed=['a b','c']", "only=[train-000001]")
    settings = settings.model_copy(update={"cluster": cluster})
    words = shlex.split(command_line(settings, str(dataset), settings.only))
    assert check(compose_recipe("conf.datagen", Settings, words[1:]), Settings) == settings


def test_previews_are_the_clips_first_frames_side_by_side(dataset):
    sheet = read_image(dataset / "previews" / "train-00000.png")
    columns = [name for name in clip_members(reference=False) if name != "foreground"]
    assert sheet.shape == (2 * (24 + 2), len(columns) * (32 + 2), 3)
    assert sheet.std() > 0.05


def test_config_says_how_it_was_made_and_not_where(dataset):
    config = yaml.safe_load((dataset / "config.yaml").read_text())
    assert config["scenes"] == {"train": 2, "train_b": 1, "validation": 0, "test": 1}
    assert str(dataset) not in (dataset / "config.yaml").read_text()
    assert str(dataset) not in (dataset / "README.md").read_text()


@pytest.mark.long
def test_two_workers_make_the_bytes_of_one_process(dataset, tmp_path, files_of, tiny):
    assert make(tiny(tmp_path, "cluster=local", "workers=2", "recycle_after=2")) == 0
    assert files_of(tmp_path) == files_of(dataset)
    assert len(list((tmp_path / "logs").glob("worker-*.log"))) == 2


@pytest.mark.long
def test_kill_9_of_a_cluster_and_again_gives_the_same_bytes(tiny, dataset, files_of, tmp_path):
    output = tmp_path / "out"
    words = shlex.split(command_line(tiny(output, "cluster=local", "workers=2"), str(output)))
    command = [str(Path(sys.executable).parent / words[0]), *words[1:]]
    for seconds in (6.0, 14.0):
        process = subprocess.Popen(command, env=os.environ | {"PYTHONPATH": str(Path.cwd())})
        time.sleep(seconds)
        process.send_signal(signal.SIGKILL)
        process.wait()
        time.sleep(2.0)  # orphaned workers notice and go
    assert make(tiny(output)) == 0
    assert files_of(output) == files_of(dataset)
