"""TRON-Synth: exactly its scenes, nothing of them trained on, and a word on what is a stand-in."""

import json
import shlex
import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import trimesh

import datagen.run.dataset
from datagen.cli import cli
from datagen.files.checklist import filled, read_checklist
from datagen.files.sources import (
    SOURCES_NAME,
    find_sources,
    of_split,
    overlaps,
    read_source_list,
    ready_sources,
    shared_scenes,
    source_list,
)
from datagen.run.dataset import make
from datagen.run.plan import plan
from datagen.run.scheduling import make_each
from datagen.run.validate import validate
from datagen.settings.command import Settings
from datagen.settings.command_line import command_line
from datagen.settings.split import SplitSettings
from datagen.world.scene import draw_scene
from tron.cli.recipes import check, compose_recipe
from tron.errors import TronError
from tron.io.images import write_image
from tron.seeds import generator

ONLY_TEST = ["train.scenes=0", "train_b.scenes=0", "validation.scenes=0"]


def composed(*overrides: str) -> Settings:
    return check(compose_recipe("conf.datagen", Settings, ["output_dir=out", *overrides]), Settings)


def models_folder(folder: Path, names: str, seed: int) -> Path:
    """Boxes of different sizes as OBJ files, licensed."""
    folder.mkdir(parents=True)
    rng = generator(seed, "files")
    for name in names:
        trimesh.creation.box(rng.uniform(0.5, 1.0, 3)).export(folder / f"{name}.obj", digits=9)
    license_all(folder)
    return folder


def maps_folder(folder: Path, names: list[str], seed: int) -> Path:
    """Skies, licensed: every other one of high contrast."""
    folder.mkdir(parents=True)
    rng = generator(seed, "files")
    for i, name in enumerate(names):
        sky = rng.uniform(0.2, 0.6, (8, 16, 3)).astype(np.float32)
        sky[2, 3] += 500.0 * (i % 2)
        write_image(folder / f"{name}.hdr", sky)
    license_all(folder)
    return folder


def license_all(folder: Path) -> None:
    entries = [{"path": path.name, "licence": "CC0-1.0"} for path in sorted(folder.iterdir())]
    (folder / "catalogue.json").write_text(json.dumps(entries))


@pytest.mark.parametrize("recipe", ["tron_synth", "tron_synth_small"])
def test_it_has_15_scenes_of_one_object_and_25_of_several_under_5_lights(recipe: str):
    settings = composed(f"experiment={recipe}")
    scenes = plan(settings)
    assert settings.used_splits() == ["test"]
    assert Counter(settings.test.style_of(each.index) for each in scenes) == {"object": 15, "table": 25}
    assert [settings.test.style_of(i) for i in (0, 14, 15, 39)] == ["object", "object", "table", "table"]
    assert Counter(settings.test.lights) == {"high": 3, "medium": 2}
    assert settings.test.reference_buffers
    assert settings.path_frames == 93


def test_its_views_and_frames_are_the_papers_and_the_small_ones_are_smaller():
    full, small = composed("experiment=tron_synth"), composed("experiment=tron_synth_small")
    assert (full.test.frames, full.capture.views) == (93, 290)
    assert {full.test.width, full.test.height, full.capture.width, full.capture.height} == {800}
    assert len(plan(small)) * len(small.test.lights) * small.test.frames == 40 * 5 * small.test.frames
    assert (small.test.frames, small.test.width, small.test.height) == (5, 96, 96)


def test_its_cameras_are_a_spiral_to_reconstruct_from_and_an_oscillation_to_test_on():
    for style in ("object", "table"):
        spec = draw_scene(0, "test", 3, style=style, lights=["overcast"], frames=93, path_frames=93)
        assert [path.path for path in spec.cameras.capture] == ["spiral"]
        assert spec.cameras.film.path == "oscillating"
        assert (len(spec.views(290, 8, 8)), len(spec.clip(0, 93, 8, 8))) == (290, 93)


def test_one_object_stands_in_a_scene_of_one_and_several_in_a_scene_of_several():
    one, several = (
        draw_scene(0, "test", 0, style=style, lights=["overcast"]).objects for style in ("object", "table")
    )
    assert len(one) == 1 < len(several)


def test_styles_by_count_must_count_every_scene_and_name_styles_that_exist():
    for words, said in (
        (["test.scenes=4", "test.style={object:1,table:2}"], r"test.style.*counts 1 \+ 2 .*scenes=4"),
        (["test.scenes=4", "test.style={objects:4}"], "no style 'objects'"),
        (["test.scenes=0", "test.style={object:0}", "mode=captures"], "test.style"),
    ):
        with pytest.raises(TronError, match=said):
            composed(*words)


def test_counts_of_styles_survive_the_command_of_the_card():
    settings = composed("experiment=tron_synth_small")
    words = shlex.split(command_line(settings, "out"))[1:]
    assert check(compose_recipe("conf.datagen", Settings, words), Settings) == settings


def test_lists_of_styles_are_still_taken_in_turns():
    split = SplitSettings(scenes=5, style=["mixed", "object"])
    assert [split.style_of(i) for i in range(5)] == ["mixed", "object", "mixed", "object", "mixed"]


@pytest.fixture
def trained(tmp_path: Path, variant: str) -> Path:
    """A dataset that trains on models and maps of its own; of its scenes only the account is there."""
    models_folder(tmp_path / "models", "abcde", seed=0)
    maps_folder(tmp_path / "maps", list("vwxyz"), seed=0)
    words = ["train.scenes=1", "train_b.scenes=0", "validation.scenes=0", "test.scenes=1", "seed=3"]
    words += [f"assets={tmp_path / 'models'}", f"environments={tmp_path / 'maps'}"]
    settings = composed(*words)
    folder = tmp_path / "trained"
    folder.mkdir()
    listed = source_list(settings, find_sources(settings))
    (folder / SOURCES_NAME).write_text(listed.model_dump_json(indent=1))
    return folder


def test_models_and_maps_serve_training_or_test(trained: Path):
    listed = read_source_list(trained)
    splits = {source.id: source.splits for source in listed.sources}
    assert {name for name, used in splits.items() if used == ("test",)} == {"d", "y"}
    assert all(used == ("train",) for name, used in splits.items() if name not in "dy")
    assert all(len(file.sha256) == 64 for source in listed.sources for file in source.files)


def test_all_serve_every_split_where_they_are_shared(tmp_path: Path, variant: str):
    models_folder(tmp_path / "models", "abcde", seed=0)
    settings = composed(f"assets={tmp_path / 'models'}", "share_models=true")
    sources = find_sources(settings)
    assert of_split(settings, sources, "train").assets == of_split(settings, sources, "test").assets
    assert {source.splits for source in source_list(settings, sources).sources} == {
        ("train", "train_b", "validation", "test")
    }


def test_too_few_models_are_shared_and_the_log_says_so(tmp_path: Path, variant: str, caplog):
    models_folder(tmp_path / "models", "abc", seed=0)
    caplog.set_level("INFO")
    settings = composed(f"assets={tmp_path / 'models'}")
    sources = ready_sources(settings)
    assert "3 models are too few to hold some out" in caplog.text
    assert of_split(settings, sources, "train").assets == of_split(settings, sources, "test").assets


def test_a_renamed_copy_of_a_training_model_is_refused_by_name_before_any_render(
    trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def never(*_: object) -> None:
        raise AssertionError("nothing may be made")

    monkeypatch.setattr(datagen.run.dataset, "make_each", never)
    mine = models_folder(tmp_path / "mine", "pq", seed=9)
    words = ["experiment=tron_synth_small", f"assets={mine}", f"disjoint_from=[{trained}]", "cluster=none"]
    ready_sources(composed(*words))
    shutil.copy(tmp_path / "models" / "b.obj", mine / "innocent.obj")
    license_all(mine)
    said = r"model 'innocent' is trained on in trained: innocent.obj.* is b.obj of model 'b' there"
    settings = composed(*words, f"output_dir={tmp_path / 'out'}")
    with pytest.raises(TronError, match=said):
        make(settings)
    assert not (tmp_path / "out" / "config.yaml").exists()


def test_a_model_that_training_held_out_may_be_tested_on(trained: Path, tmp_path: Path):
    mine = models_folder(tmp_path / "mine", "pq", seed=9)
    shutil.copy(tmp_path / "models" / "d.obj", mine / "held_out.obj")
    license_all(mine)
    ready_sources(composed("experiment=tron_synth", f"assets={mine}", f"disjoint_from=[{trained}]"))


def test_a_training_map_is_refused_whatever_it_is_called(trained: Path, tmp_path: Path):
    mine = maps_folder(tmp_path / "mine", ["moon_lab_4k"], seed=9)
    words = ["experiment=tron_synth", f"environments={mine}", f"disjoint_from=[{trained}]"]
    ready_sources(composed(*words))
    shutil.copy(tmp_path / "maps" / "w.hdr", mine / "moon_lab_4k.hdr")
    with pytest.raises(TronError, match=r"map 'moon_lab_4k' is trained on in trained: .* 'w' there"):
        ready_sources(composed(*words))


def test_a_texture_under_another_name_on_another_model_is_refused(tmp_path: Path, variant: str):
    picture = generator(0, "pictures").uniform(size=(8, 8, 3)).astype(np.float32)
    for side, name in (("theirs", "brick"), ("mine", "clay")):
        (tmp_path / side).mkdir()
        write_image(tmp_path / side / f"{name}_albedo.png", picture)
        (tmp_path / side / "catalogue.json").write_text(json.dumps([{"path": name, "licence": "CC0-1.0"}]))
    there = composed(f"textures={tmp_path / 'theirs'}", "seed=1")
    here = composed("experiment=tron_synth", f"textures={tmp_path / 'mine'}")
    own, other = (source_list(each, find_sources(each)) for each in (here, there))
    (line,) = overlaps(own, other, tmp_path / "theirs")
    assert line.startswith("texture set 'clay' is trained on in theirs: clay_albedo.png is brick_albedo.png")


def test_scenes_of_one_split_and_seed_are_the_same_scenes(trained: Path):
    other = read_source_list(trained)
    same = composed("train.scenes=1", "seed=3")
    assert list(overlaps(source_list(same, find_sources(same)), other, trained)) == [
        "scenes of train are those of trained: both are drawn from seed 3"
    ]
    for words in (["seed=4"], ["seed=3", *ONLY_TEST]):
        settings = composed(*words)
        assert not list(overlaps(source_list(settings, find_sources(settings)), other, trained))


def test_scenes_are_compared_by_what_they_are_not_by_what_they_are_called(tmp_path: Path):
    def put(folder: str, split: str, index: int, seed: int) -> None:
        spec = draw_scene(seed, "train", 0, style="object", lights=["overcast"])
        spec = spec.model_copy(update={"name": f"{split}-{index:06d}", "split": split, "index": index})
        path = tmp_path / folder / "scenes" / spec.name / "spec.json"
        path.parent.mkdir(parents=True)
        path.write_text(spec.to_json())

    put("trained", "train", 0, 5)
    put("trained", "test", 0, 6)
    put("mine", "test", 4, 5)
    put("mine", "test", 5, 6)
    put("mine", "test", 6, 7)
    assert list(shared_scenes(tmp_path / "mine", [tmp_path / "trained"])) == [
        "scenes/test-000004: is trained on in trained, as train-000000"
    ]


def test_a_dataset_lists_its_sources_and_is_a_problem_against_itself(small_dataset: Path, caplog):
    listed = read_source_list(small_dataset)
    assert (listed.sources, listed.splits) == ((), ("train", "train_b", "test"))
    assert validate(small_dataset) == 0
    assert validate(small_dataset, [small_dataset]) == 2 + 3
    assert f"scenes of train are those of {small_dataset.name}: both are drawn from seed 5" in caplog.text


def test_a_folder_without_a_list_is_refused(tmp_path: Path, variant: str):
    with pytest.raises(TronError, match=r"has no sources.json.*run its tron-datagen command again"):
        ready_sources(composed("experiment=tron_synth", f"disjoint_from=[{tmp_path}]"))


def test_the_checklist_has_the_papers_33_maps_and_29_models():
    checklist = read_checklist("tron_synth")
    assert (len(checklist.maps), checklist.models.count) == (33, 29)
    assert len({each.name for each in checklist.maps}) == 33
    assert Counter(each.source.split("/")[2].removeprefix("www.") for each in checklist.maps) == {
        "polyhaven.com": 19,
        "hdri-hub.com": 10,
        "ambientcg.com": 4,
    }


def test_a_map_of_any_size_fills_its_slot_and_others_are_left_out(tmp_path: Path, variant: str):
    maps = maps_folder(tmp_path / "maps", ["moon_lab_1k", "Goegap_Road_4k", "mine"], seed=0)
    settings = composed("experiment=tron_synth", f"environments={maps}")
    sources = ready_sources(settings)
    assert {asset.id for asset in sources.maps} == {"moon_lab_1k", "Goegap_Road_4k"}
    assert {light.path for light in sources.environments} == {"moon_lab_1k.hdr", "Goegap_Road_4k.hdr"}
    found = filled(read_checklist("tron_synth"), sources.maps, sources.assets)
    assert found.map_share == pytest.approx(2 / 33)
    report = found.report(maps, None)
    assert "maps present: 2 of 33" in report
    where = f"(https://polyhaven.com/a/studio_small_01, licence CC0); put it in {maps}/studio_small_01_4k.hdr"
    assert f"missing: studio_small_01_4k {where}" in report
    assert "moon_lab" not in report
    assert (
        "missing: 29 models (https://polyhaven.com/models, licence CC0); put each in assets=FOLDER/" in report
    )
    assert "60 of 62 named assets of TRON-Synth are procedural stand-ins" in report


def test_the_share_of_lights_from_maps_is_that_of_the_slots_that_are_filled(tmp_path: Path, variant: str):
    maps = maps_folder(tmp_path / "maps", ["a", "b"], seed=0)
    specs = find_sources(composed(f"environments={maps}")).environments
    wanted = {"style": "object", "lights": ["any"] * 40, "families": ["hdri"], "environments": specs}
    drawn = {share: draw_scene(0, "test", 0, map_share=share, **wanted).lights for share in (0.0, 0.5, 1.0)}
    counts = {share: sum(light.family == "hdri" for light in lights) for share, lights in drawn.items()}
    assert (counts[0.0], counts[1.0]) == (0, 40)
    assert 8 <= counts[0.5] <= 32
    kept = [one for one, all_ in zip(drawn[0.5], drawn[1.0]) if one.family == "hdri" and one != all_]
    assert not kept, "a light that stays a map stays the same map"


@pytest.mark.parametrize(
    "text", ["", "title: 1", "maps: []", "{", "title: x\nmaps: [{name: a}]", "title: x\nothers: 1"]
)
def test_a_damaged_checklist_is_one_line_and_exit_code_2(text: str, tmp_path: Path, capsys):
    (tmp_path / "mine.yaml").write_text(text)
    with pytest.raises(SystemExit) as stopped:
        cli([f"checklist={tmp_path / 'mine.yaml'}", f"output_dir={tmp_path / 'out'}", "cluster=none"])
    assert stopped.value.code == 2
    assert "checklist cannot be read" in capsys.readouterr().err
    assert not (tmp_path / "out" / "manifest.json").exists()


def test_stand_ins_are_told_when_work_begins_and_not_before(tmp_path: Path, variant: str, caplog):
    settings = composed("experiment=tron_synth_small", "cluster=none", f"output_dir={tmp_path}")
    sources = ready_sources(settings)
    assert "stand-ins" not in caplog.text
    make_each(_nothing, [], settings, sources, lambda _: 1, "clips")
    assert "stand-ins" not in caplog.text
    make_each(_nothing, plan(settings)[:2], settings, sources, lambda _: 1, "clips")
    assert caplog.text.count("62 of 62 named assets of TRON-Synth are procedural stand-ins") == 1


def _nothing(*_: object) -> None:
    """What is made is not the question."""
