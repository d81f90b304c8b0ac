"""The recipes named after the paper make what the paper made: its sizes, numbers of scenes and schedules."""

from collections import Counter

import pytest

from datagen.settings import Settings as DatagenSettings
from train.settings import Settings as TrainSettings
from tron.apps.relight_settings import QUALITY
from tron.cli.recipes import check, compose_recipe


@pytest.fixture(scope="module")
def datagen() -> DatagenSettings:
    overrides = ["experiment=paper", "output_dir=out"]
    return check(compose_recipe("conf.datagen", DatagenSettings, overrides), DatagenSettings)


@pytest.fixture(scope="module")
def train() -> TrainSettings:
    overrides = ["experiment=paper", "renderer=cosmos", "dataset=in", "output_dir=out"]
    overrides += ["renderer.transformer_path=a", "renderer.vae_path=b"]
    return check(compose_recipe("conf.train", TrainSettings, overrides), TrainSettings)


def test_the_synthetic_set_has_975_scenes_of_93_frames_under_20_lights(datagen: DatagenSettings) -> None:
    """Ten of the lights have a high contrast, ten a low one."""
    train = datagen.train
    assert (train.scenes, train.frames, train.width, train.height) == (975, 93, 512, 512)
    assert Counter(train.lights) == {"high": 10, "low": 10}


def test_the_benchmark_has_40_scenes_under_5_lights_seen_from_290_and_93_cameras(
    datagen: DatagenSettings,
) -> None:
    test = datagen.test
    assert (test.scenes, len(test.lights), test.frames) == (40, 5, 93)
    assert (datagen.views, datagen.view_width, datagen.view_height) == (290, 800, 800)
    assert (test.width, test.height) == (800, 800)
    assert datagen.path_frames == 93
    assert test.reference_buffers


def test_shadows_take_2_rays_for_a_preview_and_64_in_the_end(datagen: DatagenSettings) -> None:
    assert (QUALITY["preview"].rays, QUALITY["final"].rays) == (2, 64)
    assert {datagen.split(name).guidance_spp for name in datagen.used_splits()} == {64}


def test_the_curriculum_has_three_stages_of_32000_steps(train: TrainSettings) -> None:
    """Synthetic 512 x 512 with one frame, then real pictures whole, with one and with five."""
    assert [(stage.steps, stage.frames) for stage in train.stages] == [(32_000, 1), (32_000, 1), (32_000, 5)]
    assert [stage.crop for stage in train.stages] == [512, None, None]
    assert {stage.batch_size for stage in train.stages} == {1}
    assert (train.optimizer.learning_rate, train.optimizer.muon_learning_rate) == (2e-5, None)
    assert (train.loss.l2, train.loss.lpips) == (1.0, 1.0)


def test_the_renderer_averages_the_two_latents_at_timestep_250_of_1000(train: TrainSettings) -> None:
    config = train.renderer["config"]
    assert (config["codec"], config["fusion"]) == ("wan", "average")
    assert (config["sigma"], config["window"]) == (0.25, 5)
