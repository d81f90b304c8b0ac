"""The benchmark of the data engine: figures from known findings, and every part at toy sizes."""

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import psutil
import pytest

from eval import stages as stages_module
from eval.cli import cli
from eval.datagen import kills, runs
from eval.datagen.kills import Kill, Kills
from eval.datagen.model_pixels import ModelPixels
from eval.datagen.settings import VarietySettings
from eval.datagen.soak import Soak
from eval.datagen.specifications import Specifications
from eval.datagen.throughput import Throughput, _size
from eval.datagen.variety import (
    ALONE,
    FOREGROUND,
    HOME,
    LIT,
    MIXED,
    MODELS,
    NEW,
    OLD,
    Score,
    Variety,
    measure_variety,
)
from eval.datagen.workers import Workers
from eval.results import Results, Row
from eval.stages import StageFailed
from tron.cameras import Camera
from tron.errors import TronError
from tron.gaussians import GaussianScene
from tron.images import write_image
from tron.shards.schema import Clip

COMMON = [
    *(f"{split}.scenes=0" for split in ("train_b", "validation", "test")),
    *("train.lights=[overcast]", "train.frames=1", "train.path_spp=4", "train.guidance_spp=2"),
    *("views=4", "view_width=24", "view_height=24", "surfels=500", "mesh_edge=0.2"),
    *("environment_height=32", "objects=[1,1]"),
]
TINY = [*COMMON, "train.width=16", "train.height=16", "refine_steps=0"]
TOY = {
    "rounds": "1",
    "soak_scenes": "25",
    "kills": "2",
    "kill_scenes": "4",
    "specified_scenes": "2",
    "workers": [*TINY, "train.scenes=2"],
    "tiny": TINY,
    "throughput": [*COMMON, "refine_steps=2", "train.scenes=3"],
}


def words(toy: dict[str, str | list[str]]) -> list[str]:
    """Settings of the benchmark as overrides."""
    lists = {key: value if isinstance(value, str) else json.dumps(value) for key, value in toy.items()}
    return [f"benchmark.{key}={value.replace(', ', ',')}" for key, value in lists.items()]


def values(rows) -> dict[str, Row]:
    return {row.metric: row for row in rows}


@pytest.mark.long
def test_every_part_but_variety_at_toy_sizes(tmp_path: Path):
    parts = "benchmark.parts=[workers,soak,kills,merge,specifications,throughput]"
    sizes = 'benchmark.sizes={16: ["train.frames=2"],24: ["train.frames=1"]}'
    with pytest.raises(SystemExit) as end:
        cli(["benchmark=datagen", f"output_dir={tmp_path}", parts, sizes, *words(TOY)])
    assert end.value.code == 0
    results = Results.load(tmp_path / "results.json")
    for metric in ("workers.identical", "specifications.identical"):
        assert results.value(metric) == 1.0
    assert results.value("merge.identical") == 1
    row = results.find("kills.identical")
    assert row is not None
    assert (row.value, row.n) == (2, 2)
    for metric in ("frames_per_hour.16", "frames_per_hour.24", "seconds_per_frame.path_trace.24"):
        assert (results.value(metric) or 0) > 0
    for metric in ("workers.speedup_2", "soak.rss_growth_mb", "soak.rss_peak_mb"):
        assert results.find(metric) is not None
    page = (tmp_path / "report.html").read_text()
    for part in ("workers", "soak", "kills", "merge", "specifications", "throughput", "stages"):
        assert f'<section id="{part}">' in page
    left = {path.name for folder in tmp_path.iterdir() if folder.is_dir() for path in folder.iterdir()}
    assert not [name for name in left if not name.endswith(".log")], "datasets are removed"


def test_gains_are_paired_over_scenes_and_losses_have_the_other_sign():
    found = Variety(["three", "two"], scenes={OLD: 24, NEW: 24})
    for judge, scene, old, new in (
        (ALONE, "a/0", (30.0, 32.0), (31.0, 33.0)),
        (MIXED, "m/0", (20.0,), (23.0,)),
        (MIXED, "m/1", (25.0,), (27.0,)),
        (HOME, "h/0", (40.0,), (39.75,)),
    ):
        for method, figures in ((OLD, old), (NEW, new), (LIT, old)):
            own = FOREGROUND if judge == HOME else MODELS
            found.scores += [
                Score(judge, own, scene, method, "" if method == LIT else "three", 0, psnr)
                for psnr in figures
            ]
            if method != LIT:  # what belongs to another renderer or other pixels changes none of these
                found.scores.append(Score(judge, own, scene, method, "two", 0, 10.0 + (method == NEW)))
                if judge != HOME:
                    psnr = 50.0 - 3 * (method == NEW)
                    found.scores.append(Score(judge, FOREGROUND, scene, method, "three", 0, psnr))
    rows = values(found.rows(0))
    ood = rows["variety.ood_gain_db"]
    assert (ood.value, ood.n, ood.scenes) == (2.0, 3, 3)
    assert ood.low is not None
    assert ood.high is not None
    assert ood.low <= 2.0 <= ood.high <= 3.0
    assert rows["variety.ood_gain_db.mixed"].value == 2.5
    assert rows["variety.loss_db"].value == 0.25
    assert rows["variety.psnr.old.alone.models"].value == 31.0
    assert rows["variety.ood_gain_db.foreground"].value == -3.0
    assert rows["variety.two.ood_gain_db"].value == 1.0
    assert rows["variety.two.loss_db"].value == -1.0
    assert set(values(Variety(["three"]).rows(0))) == set()


def write_scene(folder: Path, surfels: GaussianScene, models: list[int]) -> None:
    """A scene's folder as the data engine leaves it, as far as masks read it: a floor, and two objects."""
    folder.mkdir(parents=True)
    surfels.save(folder / "surfels.ply")
    objects = [{"asset": "cat" if number in models else None} for number in (2, 3)]
    (folder / "spec.json").write_text(json.dumps({"surroundings": [{}], "objects": objects}))


def surfels_at(places: np.ndarray, object_id: np.ndarray) -> GaussianScene:
    count = len(places)
    return GaussianScene(
        means=places,
        quats=np.tile([1.0, 0, 0, 0], (count, 1)),
        log_scales=np.full((count, 2), -4.0),
        opacity_logits=np.full(count, 4.0),
        sh=np.zeros((count, 16, 3)),
        base_color=np.full((count, 3), 0.5),
        roughness=np.full(count, 0.5),
        metallic=np.zeros(count),
        object_id=object_id,
        spacing=0.1,
    )


def test_pixels_of_models_are_those_whose_surface_is_a_models(
    tmp_path: Path, drawn_clip: Callable[..., Clip]
):
    """A floor, a model on the left and another thing on the right, at depths that the clip is given."""
    clip = drawn_clip(frames=1, size=16)
    camera = Camera.from_dict(clip.meta.cameras[0])
    depth = np.full((16, 16), 5.0, np.float32)
    depth[4:9, 2:6], depth[4:9, 10:14], depth[0] = 3.0, 3.0, 0.0
    clip.frames["depth_ref"] = depth[None, ..., None]
    owner = np.ones((16, 16), int)
    owner[4:9, 2:6], owner[4:9, 10:14] = 2, 3
    surface = depth > 0
    places = camera.position + camera.rays() * depth[..., None]
    write_scene(tmp_path / "s", surfels_at(places[surface], owner[surface]), models=[2])
    assert np.array_equal(ModelPixels(tmp_path / "s").masks(clip), (owner == 2)[None])
    write_scene(tmp_path / "none", surfels_at(places[surface], owner[surface]), models=[])
    assert not ModelPixels(tmp_path / "none").masks(clip).any()
    (tmp_path / "s" / "spec.json").write_text("[]")
    with pytest.raises(TronError, match="no specification of a scene"):
        ModelPixels(tmp_path / "s")


def test_the_soak_holds_the_last_fifth_against_the_second():
    saw = [(done, {1: 1000.0 + (done % 20) + (400.0 if done < 20 else 0.0)}) for done in range(100)]
    assert values(Soak(saw, 100, 50.0).rows(0))["soak.rss_growth_mb"].value == 0.0
    leaks = [(done, {1: each[1] + done}) for done, each in saw]
    rows = values(Soak(leaks, 100, 50.0).rows(0))
    assert rows["soak.rss_growth_mb"].value == 60.0
    assert rows["soak.rss_peak_mb"].value == 1438.0
    assert rows["soak.seconds_per_scene"].value == 0.5
    with pytest.raises(TronError, match="over before memory is sampled"):
        list(Soak([(0, {1: 1.0}), (99, {1: 1.0})], 100, 1.0).rows(0))


def test_a_worker_that_grows_is_seen_though_its_replacement_starts_anew():
    """Two workers of 50 scenes a life; each scene leaves 3 MB behind in one of them."""
    leaks = [
        (done, {1: 900.0, 10 + done // 100: 500.0 + 3 * (done % 100) / 2, 50 + done // 100: 500.0})
        for done in range(300)
    ]
    rows = values(Soak(leaks, 300, 50.0).rows(0))
    assert rows["soak.worker_growth_mb_per_scene"].value == pytest.approx(3.0)
    assert rows["soak.rss_growth_mb"].value < 100
    still = values(Soak([(done, {1: 900.0}) for done in range(300)], 300, 50.0).rows(0))
    assert still["soak.worker_growth_mb_per_scene"].value == pytest.approx(0.0, abs=1e-9)


def test_a_dataset_that_differs_takes_all_its_kills_with_it():
    kill = Kill(3.0, "command", 2)
    found = Kills([([kill] * 4, []), ([kill] * 3, ["train-00000.tar"]), ([kill] * 2, [])], 8, 1.5)
    row = values(found.rows(0))["kills.identical"]
    assert (row.value, row.n) == (6, 9)
    assert "train-00000.tar differs" in str(found.sections(Path()))


def test_two_trees_differ_where_a_file_is_missing_or_another(tmp_path: Path):
    for name in ("a", "b"):
        (tmp_path / name / "logs").mkdir(parents=True)
        (tmp_path / name / "logs" / "worker-0.log").write_text(name)
        (tmp_path / name / "same").write_text("same")
        (tmp_path / name / "other").write_text(name)
    (tmp_path / "b" / "more").touch()
    assert runs.differences(runs.tree(tmp_path / "a"), runs.tree(tmp_path / "b")) == ["more", "other"]


def test_specifications_are_counted_by_scene_and_way():
    found = Specifications({"two workers": [], "other": ["train-000001"]}, 4)
    assert values(found.rows(0))["specifications.identical"].value == 7 / 8


def test_speedup_is_a_ratio_of_medians():
    found = Workers({1: [10.0, 30.0, 12.0], 2: [6.0, 5.0, 8.0]}, [], 3)
    assert values(found.rows(0))["workers.speedup_2"].value == 2.0


def test_frames_an_hour_leave_out_the_scene_that_compiles():
    def time(scene: str, worker: str, **seconds: float) -> runs.SceneTime:
        return runs.SceneTime(scene, worker, seconds)

    times = [
        time("s0", "0", build=1.0, path_trace=30.0),
        time("s1", "1", build=1.0, path_trace=40.0),
        time("s2", "0", build=1.0, path_trace=3.0),
        time("s3", "1", build=1.0, path_trace=5.0),
    ]
    found = Throughput({64: _size(times, dict.fromkeys(("s0", "s1", "s2", "s3"), 2))})
    rows = values(found.rows(0))
    # 4 frames in 10 s of one worker
    assert rows["frames_per_hour.64"].value == pytest.approx(2 * 3600 * 4 / 10)
    assert rows["seconds_per_frame.path_trace.64"].value == 2.0
    (section,) = found.sections(Path())
    assert "frames" in section.title.lower()


@pytest.mark.long
def test_a_kill_reaches_what_the_command_started(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A stand-in starts a process that lives on by itself: killed with it, or found to outlive it."""
    script = tmp_path / "tron-datagen"
    script.write_text("#!/bin/sh\nsleep 20 &\nexec sleep 20\n")
    script.chmod(0o755)
    monkeypatch.setattr(runs, "script_path", lambda name: str(script))
    outlived = kills._kill([], tmp_path / "out", 1.0, "everything")
    assert outlived is not None
    assert outlived < 5
    monkeypatch.setattr(kills, "ORPHAN_SECONDS", 0.5)
    with pytest.raises(TronError, match="1 workers outlive their command"):
        kills._kill([], tmp_path / "out", 1.0, "command")
    script.write_text("#!/bin/sh\n")
    assert kills._kill([], tmp_path / "out", 10.0, "command") is None, "it was over before"
    script.write_text("#!/bin/sh\necho the disk is full\nexit 1\n")
    with pytest.raises(StageFailed, match="exit code 1: the disk is full"):
        kills._kill([], tmp_path / "out", 10.0, "command")


def test_memory_is_that_of_all_processes():
    found = runs.resident_mb(psutil.Process())
    assert sum(found.values()) * 1e6 >= 0.9 * psutil.Process().memory_info().rss
    assert psutil.Process().pid in found


@pytest.fixture
def stand_ins(tmp_path: Path, dataset: Path, weights: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Stand-ins for the long commands copy what those would make; returns the list of what ran."""
    log = tmp_path / "commands.txt"
    made = tmp_path / "made"
    shutil.copytree(dataset, made)
    for scene in ("s000010", "s000011"):
        write_scene(made / "scenes" / scene, surfels_at(np.zeros((1, 3)), np.array([2])), models=[2])
    head = f"""#!{sys.executable}
import pathlib, shutil, sys
given = dict(word.split("=", 1) for word in sys.argv[1:])
out = pathlib.Path(given["output_dir"])
with open({str(log)!r}, "a") as log:
    log.write(" ".join([pathlib.Path(sys.argv[0]).name, *sys.argv[1:]]) + "\\n")
"""
    bodies = {
        "tron-datagen": "if given.get('asset_names') == '[broken]':\n"
        "    sys.exit(print('tron-datagen: no triangles (broken.obj)') or 2)\n"
        f"shutil.copytree({str(made)!r}, out, dirs_exist_ok=True)\n",
        "tron-train": "out.mkdir(parents=True)\n"
        f"shutil.copy({str(weights / 'tiny.safetensors')!r}, out / 'renderer.safetensors')\n",
    }
    for name, body in bodies.items():
        (tmp_path / name).write_text(head + body)
        (tmp_path / name).chmod(0o755)
    monkeypatch.setattr(stages_module, "script_path", lambda name: str(tmp_path / name))
    return log


def variety(real_data: Path | None) -> VarietySettings:
    return VarietySettings(
        old=["experiment=demo"],
        new=["experiment=world"],
        train={"three": ["experiment=demo"], "two": ["experiment=demo", "renderer.config.guidance=[pbr]"]},
        real_data=real_data,
        alone=["objects=[1,1]"],
        mixed={"old": ["asset_share=0.5", "test.style=A"], "new": ["asset_share=0.5", "test.style=table"]},
        seeds=[3, 4],
        max_seconds=7,
        pictures=1,
    )


@pytest.mark.long
def test_variety_trains_on_both_and_judges_by_every_model_that_can_be_read(
    stand_ins: Path, tmp_path: Path, shared: Callable[[], Path]
):
    out = tmp_path / "out"
    found = measure_variety(variety(shared()), 0, out)
    commands = stand_ins.read_text().splitlines()
    assert sum(line.startswith("tron-train") for line in commands) == 8
    for name in (OLD, NEW):
        lines = [each for each in commands if f"dataset={out / name} " in each and "seed=4" in each]
        assert ["guidance=[pbr]" in line for line in lines] == [False, True]
        assert all("max_seconds=7" in line for line in lines)
    judges = [line for line in commands if "experiment=models" in line]
    assert all("allow_unlicensed=[broken,cube,dusk]" in line for line in judges)
    assert [line for line in judges if "asset_names=[cube]" in line and "objects=[1,1]" in line]
    assert sorted(line.partition("test.style=")[2].split()[0] for line in judges if "share=0.5" in line) == [
        "A",
        "table",
    ]
    assert list(found.left_out) == ["alone_broken"]
    assert "no triangles" in found.left_out["alone_broken"]
    rows = values(found.rows(0))
    # untrained weights return lit, whatever they were trained on
    assert rows["variety.ood_gain_db"].value == rows["variety.loss_db"].value == 0.0
    assert rows["variety.psnr.new.home.foreground"].value == pytest.approx(
        rows["variety.psnr.lit.home.foreground"].value, abs=1e-3
    )
    assert rows["variety.ood_gain_db"].scenes == 6, "two scenes of the model, and of each of two mixtures"
    (section,) = found.sections(tmp_path / "pictures")
    assert (tmp_path / "pictures" / "variety_alone_0.png").stat().st_size > 0
    assert "alone_broken: no triangles (broken.obj)" in str(section)
    measure_variety(variety(shared()), 0, out)
    again = stand_ins.read_text().splitlines()[len(commands) :]
    assert [line.rpartition("/")[2] for line in again] == ["alone_broken"], (
        "what is made is not touched again"
    )


def test_without_real_data_only_the_old_test_scenes_judge(stand_ins: Path, tmp_path: Path):
    found = measure_variety(variety(tmp_path / "absent"), 0, tmp_path / "out")
    rows = values(found.rows(0))
    assert "variety.ood_gain_db" not in rows
    assert "variety.loss_db" in rows
    assert not [line for line in stand_ins.read_text().splitlines() if "experiment=models" in line]


@pytest.fixture
def shared(tmp_path: Path) -> Callable[[], Path]:
    """Makes a folder of two models, one of which the data engine refuses, and a map."""

    def make() -> Path:
        for name in ("broken", "cube"):
            (tmp_path / "data" / "assets" / name).mkdir(parents=True, exist_ok=True)
            (tmp_path / "data" / "assets" / name / f"{name}.obj").touch()
        (tmp_path / "data" / "assets" / "cube" / "cube.obj").rename(
            tmp_path / "data" / "assets" / "cube" / "cube.OBJ"
        )
        (tmp_path / "data" / "hdri" / "evening").mkdir(parents=True, exist_ok=True)
        write_image(tmp_path / "data" / "hdri" / "evening" / "dusk.hdr", np.ones((4, 8, 3), np.float32))
        return tmp_path / "data"

    return make
