"""Pictures of a validation: the same held-out frames each time, beside what the network makes of them."""

from pathlib import Path

import numpy as np
import pytest
import torch

from train.cli import main
from train.examples.held_out import network_input
from train.settings import Settings
from train.strips import HEADER
from tron.io.images import read_image
from tron.neural.renderer import to_display_array
from tron.neural.weights import load_renderer
from tron.shards import ClipStore
from tron.shards.schema import GUIDANCE, TARGET

SIZE = 24
STAGES = [
    {"name": "one", "split": "train", "steps": 4, "batch_size": 2, "crop": 16},
    {"name": "two", "split": "train_b", "frames": 5, "steps": 2, "batch_size": 2, "crop": 16},
]


@pytest.fixture(scope="module")
def run(make_settings, dataset, tmp_path_factory) -> Path:
    output = tmp_path_factory.mktemp("strips")
    changes = {"stages": STAGES, "validation": {"every": 2}, "optimizer": {"ema_decay": 0.5}}
    main(Settings.model_validate(make_settings(dataset, output, **changes)))
    return output


def cells(path: Path) -> np.ndarray:
    """Display values (row, column, SIZE, SIZE, 3)."""
    picture = read_image(path)[HEADER:]
    return picture.reshape(-1, SIZE, len(GUIDANCE) + 2, SIZE, 3).swapaxes(1, 2)


def test_each_validation_has_its_strip(run):
    names = sorted(path.name for path in (run / "validation").iterdir())
    assert names == ["one-00000002.png", "one-00000004.png", "two-00000002.png"]


def test_guidance_and_truth_are_those_of_held_out_frames_and_never_change(run, dataset):
    store = ClipStore(dataset, "validation")
    for path in (run / "validation").glob("*.png"):
        rows = cells(path)
        frame = 2 if path.name.startswith("two") else 0  # the middle one of the first window
        assert len(rows) == len(store)
        for number, row in enumerate(rows):
            clip = store.read_frames(number, [frame], (*GUIDANCE, TARGET))
            shown = [clip.displayed(name)[0] for name in (*GUIDANCE, TARGET)]
            np.testing.assert_allclose(np.delete(row, -2, 0), shown, atol=0.51 / 255)


def test_the_network_is_the_averaged_one_that_the_stage_ends_with(run, dataset):
    renderer = load_renderer(run / "renderer.safetensors")
    clip = ClipStore(dataset, "validation").read_frames(0, range(5), GUIDANCE)
    with torch.no_grad():
        made = renderer({name: network_input(clip, name)[None] for name in GUIDANCE})
    row = cells(run / "validation" / "two-00000002.png")[0]
    np.testing.assert_allclose(row[-2], to_display_array(made)[2], atol=0.6 / 255)


def test_large_frames_are_shown_smaller_and_none_where_none_are_wanted(make_settings, make_dataset, tmp_path):
    large = make_dataset(tmp_path / "large", {"train": 1, "validation": 1}, frames=1, size=16, width=800)
    for pictures, there in ((1, True), (0, False)):
        output = tmp_path / str(pictures)
        validation = {"every": 2, "pictures": pictures}
        settings = make_settings(large, output, stages=[STAGES[0] | {"steps": 2}], validation=validation)
        main(Settings.model_validate(settings))
        assert (output / "validation").exists() == there
    picture = read_image(tmp_path / "1" / "validation" / "one-00000002.png")
    assert picture.shape == (HEADER + 8, 384 * 5, 3)
