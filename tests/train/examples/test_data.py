"""Batches: functions of seed, stage and step, shared by ranks; memory and disk give the same."""

import itertools
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra.core.override_parser.overrides_parser import OverridesParser
from pydantic import ValidationError
from torch.utils.data import DataLoader

from train.curriculum import Stage
from train.examples.augmentation import augmented, display_encoded
from train.examples.data import Batches, TrainingData
from train.examples.framing import Sample
from train.examples.held_out import network_input
from train.examples.sources import CachedSplit, Draw, IndexedSplit, Passes
from train.processes import Processes
from train.settings import DataSettings, Settings, ValidationSettings
from tron import seeds
from tron.color import luminance, to_display
from tron.errors import TronError
from tron.shards import GUIDANCE, ClipStore, read_clips
from tron.shards.clip_store import ByteRanges
from tron.shards.manifest import Manifest
from tron.shards.schema import TARGET

BUFFERS = (*GUIDANCE, "rgb")
STAGE = Stage(name="one", split="train", steps=10, batch_size=3, crop=16)
MIXED = Stage(
    name="two",
    split="train_b",
    frames=5,
    steps=10,
    batch_size=2,
    crop=16,
    rehearsal_split="train",
    rehearsal_ratio=0.25,
    still_ratio=0.3,
)


def batches(dataset: Path, stage: Stage = STAGE, cache: bool = True, **options) -> Batches:
    source, seed = CachedSplit if cache else IndexedSplit, options.pop("seed", 0)
    sources = {name: source(ClipStore(dataset, name), name, BUFFERS, seed) for name in stage.splits()}
    return Batches(stage, sources, BUFFERS, DataSettings(), seed, **options)


def take(stream, count: int) -> list[torch.Tensor]:
    return [torch.stack([b[name] for name in BUFFERS]) for b in itertools.islice(iter(stream), count)]


def same(a: list[torch.Tensor], b: list[torch.Tensor]) -> bool:
    return len(a) == len(b) and all(torch.equal(x, y) for x, y in zip(a, b))


@pytest.mark.parametrize("stage", [STAGE, MIXED])
@pytest.mark.parametrize("cache", [True, False])
def test_batches_repeat_and_a_resumed_run_sees_the_same_ones(dataset, stage, cache):
    whole = take(batches(dataset, stage, cache), 10)
    for step, batch in enumerate(whole):
        assert batch.shape == (len(BUFFERS), stage.batch_size, 3, stage.frames_of(step), 16, 16)
    assert same(whole, take(batches(dataset, stage, cache), 10))
    for first in (1, 3, 4, 7):
        assert same(whole[first:], take(batches(dataset, stage, cache, first_step=first), 10 - first))
    assert not same(whole, take(batches(dataset, stage, cache, seed=1), 10))
    assert not torch.equal(whole[1], whole[2])


@pytest.mark.parametrize("stage", [STAGE, MIXED])
@pytest.mark.parametrize("workers", [0, 1, 3])
def test_a_split_in_memory_and_one_read_by_any_number_of_processes_give_the_same(dataset, stage, workers):
    stream = batches(dataset, stage, cache=False, first_step=2)
    loaded = take(DataLoader(stream, batch_size=None, num_workers=workers), 7)
    assert same(take(batches(dataset, stage, first_step=2), 7), loaded)


def test_a_sample_of_one_frame_reads_one_frame(dataset, monkeypatch):
    read: list[int] = []
    ranges = ByteRanges.read

    def counted(self, name, spans):
        spans = list(spans)
        read.append(len(spans))
        return ranges(self, name, spans)

    monkeypatch.setattr(ByteRanges, "read", counted)
    source = IndexedSplit(ClipStore(dataset, "train"), "train", BUFFERS, 0)
    for number in range(10):
        source.sample(Draw(number, seeds.generator(0, "x", number), 1))
    assert sorted(read) == [1] * 5 + [len(BUFFERS)] * 10  # each clip's metadata once, then a frame a sample


@pytest.mark.parametrize("stage", [STAGE, MIXED])
@pytest.mark.parametrize(("cache", "workers"), [(True, 0), (False, 2)])
def test_ranks_together_see_the_batches_of_one_process(dataset, stage, cache, workers):
    def loaded(stream: Batches) -> list[torch.Tensor]:
        return take(DataLoader(stream, batch_size=None, num_workers=workers), 6)

    whole = loaded(batches(dataset, stage.model_copy(update={"batch_size": 6}), cache, first_step=1))
    parts = stage.model_copy(update={"batch_size": 2})
    ranks = [loaded(batches(dataset, parts, cache, first_step=1, rank=r, ranks=3)) for r in range(3)]
    assert same(whole, [torch.cat(step, 1) for step in zip(*ranks)])
    assert not same(ranks[0], ranks[1])


@pytest.mark.parametrize(("ranks", "workers", "first"), itertools.product((1, 2, 3), (0, 2), (0, 3)))
def test_ranks_loader_processes_and_resuming_change_no_batch(dataset, ranks, workers, first):
    """All together: of any number of ranks with any number of loaders, gone on with anywhere."""
    whole = take(batches(dataset, MIXED.model_copy(update={"batch_size": 6})), 5)[first:]
    stage = MIXED.model_copy(update={"batch_size": 6 // ranks})
    parts = []
    for rank in range(ranks):
        stream = batches(dataset, stage, cache=False, first_step=first, rank=rank, ranks=ranks)
        parts.append(take(DataLoader(stream, batch_size=None, num_workers=workers), 5 - first))
    assert same(whole, [torch.cat(step, 1) for step in zip(*parts)])


def test_ranks_share_each_pass_over_the_clips(dataset):
    stage = STAGE.model_copy(update={"batch_size": 1, "crop": None})
    ranks = [batches(dataset, stage, rank=rank, ranks=2)._plan(step) for step in range(5) for rank in (0, 1)]
    assert sorted(number for ((_, number, _),) in ranks) == list(range(10))


def test_every_clip_is_seen_once_a_pass_and_passes_differ():
    passes = Passes(0, "train", 50)
    first, second = ([passes.clip(n) for n in range(start, start + 50)] for start in (0, 50))
    assert sorted(first) == sorted(second) == list(range(50))
    assert first != second
    assert [Passes(0, "train", 50).clip(n) for n in (70, 3, 71)] == [second[20], first[3], second[21]]


@pytest.mark.parametrize("ratio", [0.0, 0.25, 0.5, 1.0])
def test_rehearsal_takes_its_share_of_any_run_of_samples(dataset, ratio):
    stage = MIXED.model_copy(update={"rehearsal_ratio": ratio})
    stream = batches(dataset, stage)
    plan = [entry for step in range(40) for entry in stream._plan(step)]
    rehearsed = [split == "train" for split, _, _ in plan]
    for start, length in ((0, 80), (3, 8), (17, 40)):
        assert abs(sum(rehearsed[start : start + length]) - ratio * length) <= 1
    for split in ("train", "train_b"):  # each split's own samples are counted without gaps
        assert [n for s, n, _ in plan if s == split] == list(range(sum(s == split for s, _, _ in plan)))


def sample_of(video: torch.Tensor, display: frozenset[str] = frozenset()) -> Sample:
    return Sample({name: video.clone() for name in BUFFERS}, display)


def test_crops_flips_and_colours_are_the_same_in_all_buffers():
    grid = torch.arange(3 * 2 * 20 * 24, dtype=torch.float32).view(3, 2, 20, 24)
    settings = DataSettings(permute_colors=1.0)
    seen = set()
    for number in range(20):
        out = augmented(sample_of(grid), seeds.generator(0, "augmented", number), 8, settings).buffers
        assert all(torch.equal(out[name], out["pbr"]) for name in BUFFERS)
        assert out["pbr"].shape == (3, 2, 8, 8)
        corner = int(out["pbr"][0, 0, 0].min())
        assert corner % 4 == 0
        assert (corner % (20 * 24) // 24) % 4 == 0
        seen.add(corner)
    assert len(seen) > 10


def test_without_options_a_sample_is_left_as_it_is():
    video = torch.rand(3, 1, 8, 8)
    out = augmented(sample_of(video), seeds.generator(0, "x"), None, DataSettings(flip=0.0))
    assert all(torch.equal(out.buffers[name], video) for name in BUFFERS)


def test_a_tint_scales_the_light_and_keeps_the_luminance_of_white():
    settings = DataSettings(flip=0.0, tint=0.3)
    white = torch.ones(3, 1, 4, 4)
    gains = [
        augmented(sample_of(white), seeds.generator(0, n), None, settings).buffers["rgb"] for n in range(50)
    ]
    for tinted in gains:
        np.testing.assert_allclose(luminance(tinted.numpy(), axis=0), 1.0, rtol=1e-5)
        assert torch.equal(tinted, tinted[:, :1, :1, :1].expand_as(tinted))
    assert 0.2 < torch.stack(gains).log().std() < 0.4
    picture = torch.rand(3, 1, 4, 4)
    out = augmented(sample_of(picture), seeds.generator(0, 7), None, settings).buffers
    torch.testing.assert_close(out["irradiance"], picture * gains[7])


def test_an_exposure_is_one_factor_for_all_buffers_of_the_given_deviation():
    picture = torch.rand(3, 2, 8, 8) + 0.1
    settings = DataSettings(flip=0.0, exposure=0.5)
    stops = []
    for number in range(200):
        out = augmented(sample_of(picture), seeds.generator(0, "exposed", number), None, settings).buffers
        factor = float(out["pbr"].sum() / picture.sum())
        for name in BUFFERS:
            torch.testing.assert_close(out[name], picture * factor)
        stops.append(np.log2(factor))
    assert abs(np.mean(stops)) < 0.15
    assert 0.4 < np.std(stops) < 0.6


@pytest.mark.parametrize(("height", "width", "turns"), [(8, 8, {0, 1, 2, 3}), (8, 12, {0, 2})])
def test_turns_are_alike_in_all_buffers_and_keep_the_size(height, width, turns):
    video = torch.rand(3, 2, height, width)
    settings, seen = DataSettings(flip=0.0, rotate=0.75), []
    for number in range(60):
        out = augmented(sample_of(video), seeds.generator(0, "turned", number), None, settings).buffers
        (turn,) = [n for n in turns if torch.equal(out["pbr"], torch.rot90(video, n, (-2, -1)))]
        assert all(torch.equal(out[name], out["pbr"]) for name in BUFFERS)
        seen.append(turn)
    assert set(seen) == turns
    assert 0.1 < seen.count(0) / 60 < 0.4


def test_reflectance_exchanges_its_colours_with_the_light_and_nothing_scales_it():
    """lit = albedo x light stays so under any augmentation; what is no colour is left alone."""
    random = seeds.generator(0, "reflectance")
    albedo, light = (torch.from_numpy(random.random((3, 1, 8, 8), np.float32)) for _ in range(2))
    sample = Sample({"albedo": albedo, "surface": albedo, "irradiance": light, "rgb": albedo * light})
    settings = DataSettings(permute_colors=1.0, tint=0.4, exposure=1.0, rotate=1.0)
    exchanged = set()
    for number in range(20):
        out = augmented(sample, seeds.generator(0, "reflectance", number), None, settings).buffers
        torch.testing.assert_close(out["rgb"], out["albedo"] * out["irradiance"])
        torch.testing.assert_close(out["albedo"].sum(0).sum(), albedo.sum(0).sum())
        torch.testing.assert_close(out["surface"].sum((1, 2, 3)), albedo.sum((1, 2, 3)))
        exchanged.add(tuple(out["albedo"].sum((1, 2, 3)).tolist()))
    assert len(exchanged) > 1


def test_reflectance_is_encoded_by_the_srgb_curve_and_what_is_no_colour_stays():
    sample = Sample({name: torch.full((3, 1, 2, 2), 0.18) for name in ("albedo", "surface", "lit")})
    shown = {name: float(display_encoded([sample], name)[0, 0, 0, 0, 0] + 1) / 2 for name in sample.buffers}
    assert shown["albedo"] == pytest.approx(1.055 * 0.18 ** (1 / 2.4) - 0.055)
    assert shown["surface"] == pytest.approx(0.18)
    assert shown["lit"] == pytest.approx(float(to_display(np.full((1, 3), 0.18), 1.0)[0, 0]), abs=1e-5)


def test_other_augmentations_keep_their_numbers_where_new_ones_are_off():
    """So that a run of an earlier version goes on as it began."""
    video = torch.rand(3, 1, 16, 16)
    old = DataSettings(permute_colors=1.0, tint=0.3)
    for number in range(5):
        one = augmented(sample_of(video), seeds.generator(0, number), 8, old).buffers["rgb"]
        new = old.model_copy(update={"exposure": 0.5})
        two = augmented(sample_of(video), seeds.generator(0, number), 8, new).buffers["rgb"]
        torch.testing.assert_close(two / one, (two / one).mean().expand_as(one))


def test_colours_of_photos_are_left_alone():
    video = torch.rand(3, 1, 8, 8)
    photo = sample_of(video, frozenset({"rgb"}))
    settings = DataSettings(flip=0.0, tint=0.5, permute_colors=1.0, exposure=0.5)
    out = augmented(photo, seeds.generator(0, 3), None, settings)
    assert all(torch.equal(out.buffers[name], video) for name in BUFFERS)


def test_exposure_and_agx_are_applied_to_linear_members_and_not_to_photos(dataset):
    clip = next(iter(read_clips(dataset, "test")))
    spaces = dict.fromkeys(GUIDANCE, "linear") | {"rgb": "display"}
    clip.meta = clip.meta.model_copy(update={"exposure": 0.3, "color_space": spaces})
    as_stored = clip.frames["rgb"]
    clip.frames = {name: clip.frames[name] for name in BUFFERS}
    for name, expected in (("pbr", to_display(clip.frames["pbr"], 0.3)), ("rgb", as_stored)):
        shown = (np.moveaxis(network_input(clip, name).numpy(), 0, -1) + 1) / 2
        np.testing.assert_allclose(shown, expected, atol=1e-6)
        other = next(iter(read_clips(dataset, "train", BUFFERS)))
        batch = display_encoded(
            [Sample.of(clip), Sample.of(other)], name
        )  # a photo and a path-traced clip in one batch
        np.testing.assert_allclose(batch[0].numpy(), network_input(clip, name).numpy(), atol=1e-5)
        np.testing.assert_allclose(batch[1].numpy(), network_input(other, name).numpy(), atol=1e-5)


def test_what_does_not_fit_the_budget_is_read_as_needed(dataset):
    for budget, kind in ((4.0, CachedSplit), (1e-6, IndexedSplit)):
        data = TrainingData(dataset, DataSettings(cache_gb=budget), 0, ValidationSettings())
        data.open([STAGE])
        assert isinstance(data.sources["train"], kind)
        data.begin(STAGE, 0)
        batch = next(iter(data.train_dataloader()))
        assert batch["rgb"].shape == (3, 3, 1, 16, 16)


def test_validation_shows_whole_frames_with_their_foreground(dataset):
    data = TrainingData(dataset, DataSettings(), 0, ValidationSettings(clips=1))
    data.begin(MIXED, 0)
    (window,) = list(data.val_dataloader())
    assert window["rgb"].shape == (1, 3, 5, 24, 24)  # six frames hold one window of five
    assert window["mask"].shape == (1, 1, 5, 24, 24)
    data.begin(STAGE, 0)
    (window,) = list(data.val_dataloader())
    assert window["rgb"].shape == (6, 3, 1, 24, 24)


def test_ranks_validate_on_each_clip_once(dataset):
    def held_out(rank: int, ranks: int) -> list[torch.Tensor]:
        data = TrainingData(
            dataset, DataSettings(), 0, ValidationSettings(split="train", clips=4), Processes(rank, ranks)
        )
        data.begin(STAGE, 0)
        return [window["rgb"] for window in data.val_dataloader()]

    whole = held_out(0, 1)
    assert len(whole) == 4
    parts = [held_out(rank, 3) for rank in range(3)]
    assert [len(part) for part in parts] == [2, 1, 1]
    assert same(whole, [parts[0][0], parts[1][0], parts[2][0], parts[0][1]])
    assert [len(held_out(rank, 6)) for rank in range(6)] == [1, 1, 1, 1, 0, 0]


def test_a_path_traced_second_split_stands_in_for_photographs_and_photographs_do_not(
    dataset, make_dataset, tmp_path
):
    captures = make_dataset(tmp_path / "captures", {"photos": 1}, spaces={TARGET: "display"})
    data = TrainingData(dataset, DataSettings(), 0, ValidationSettings())
    assert [data.stands_in(split) for split in ("train", "train_b", "test")] == [False, True, False]
    elsewhere = {"train_b": f"{captures}#photos"}
    data = TrainingData(dataset, DataSettings(), 0, ValidationSettings(), splits=elsewhere)
    assert [data.stands_in(split) for split in ("train", "train_b")] == [False, False]
    assert [data.photographs(split) for split in ("train", "train_b")] == [False, True]


def test_validation_is_on_its_own_split_and_the_test_split_is_never_opened(
    dataset, tmp_path, make_settings, caplog
):
    """Without its shards the test split may as well not be there."""
    folder = tmp_path / "copy"
    shutil.copytree(dataset, folder)
    for path in folder.glob("test-*.tar"):
        path.unlink()
    settings = Settings.model_validate(make_settings(folder, tmp_path / "out"))
    data = TrainingData(folder, settings.data, 0, settings.validation)
    data.open(settings.stages)
    assert len(list(data.calibration(settings.stages, 4))) > 0
    data.begin(settings.stages[0], 0)
    next(iter(data.train_dataloader()))
    assert len(list(data.val_dataloader())) == 2
    assert data._held_out is not None
    assert data._held_out.clips.split == "validation"
    for change in (
        {"validation": {"split": "test"}},
        {"stages": [{"name": "a", "split": "test", "steps": 1}]},
    ):
        with pytest.raises(ValidationError, match="kept for evaluation"):
            Settings.model_validate(make_settings(folder, tmp_path / "out", **change))


def test_a_dataset_without_a_validation_split_is_trained_on_without_validation(
    make_dataset, tmp_path, caplog
):
    folder = make_dataset(tmp_path / "old", {"train": 2, "train_b": 1, "test": 1})
    caplog.set_level("INFO")
    data = TrainingData(folder, DataSettings(), 0, ValidationSettings())
    assert caplog.text.count("No validation: this dataset has no split 'validation'") == 1
    data.begin(STAGE, 0)
    assert data.validation_split is None
    assert data.val_dataloader() == []
    with pytest.raises(TronError, match="no split 'mine'"):
        TrainingData(folder, DataSettings(), 0, ValidationSettings(split="mine"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": 9}, "clips of 9 frames"),
        ({"crop": 32}, "crops 32 pixels"),
        ({"split": "nothing"}, "no split 'nothing'"),
    ],
)
def test_stages_that_the_dataset_cannot_serve_fail_before_training(dataset, change, message):
    data = TrainingData(dataset, DataSettings(), 0, ValidationSettings())
    with pytest.raises(TronError, match=message):
        data.open([STAGE.model_copy(update=change)])


@pytest.mark.parametrize("workers", [0, 2])
def test_a_damaged_shard_is_one_line_from_any_process(dataset, tmp_path, workers):
    folder = tmp_path / "copy"
    shutil.copytree(dataset, folder)
    settings = DataSettings(cache_gb=0, workers=workers)
    data = TrainingData(folder, settings, 0, ValidationSettings())
    data.open([STAGE])
    data.begin(STAGE, 0)
    for path in folder.glob("train-*.tar"):
        path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(TronError, match="shard") as caught:
        take(data.train_dataloader(), 1)
    assert "\n" not in str(caught.value)
    assert "Traceback" not in str(caught.value)


def test_a_curriculum_without_its_captures_says_what_to_give(dataset, tmp_path):
    folder = tmp_path / "dataset"
    shutil.copytree(dataset, folder)
    manifest = Manifest.load(folder)
    kept = [entry for entry in manifest.shards if entry.split != "train_b"]
    manifest.model_copy(update={"shards": kept}).save(folder)
    data = TrainingData(folder, DataSettings(), 0, ValidationSettings())
    stages = [Stage(name="one", split="train", steps=1), Stage(name="two", split="train_b", steps=1)]
    with pytest.raises(TronError, match=r"stage two\) .*source=captured: 'splits=") as caught:
        data.open(stages)
    (typed,) = shlex.split(re.findall(r"'splits=.*?'", str(caught.value))[0])
    override = OverridesParser.create().parse_override(typed)
    assert override.value() == {"train_b": "FOLDER#train"}, "what a shell and Hydra make of the advice"
    data.open(stages[:1])
