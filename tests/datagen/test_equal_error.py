"""Times at equal error: the law between measured numbers of paths, and a whole comparison at toy size."""

import json
from pathlib import Path

import numpy as np
import pytest

from datagen.cli import cli
from datagen.equal_error import WAYS, equal
from tron.io.images import read_image

CONVERGING = {spp: (0.4 / spp**0.5, 0.1 + 0.01 * spp) for spp in (1, 4, 16, 64)}


@pytest.mark.parametrize("spp", [1, 4, 16, 64])
def test_a_measured_error_has_its_own_paths_and_seconds(spp: int):
    error, seconds = CONVERGING[spp]
    assert equal(CONVERGING, error) == pytest.approx((spp, seconds))


@pytest.mark.parametrize("spp", [2.0, 9.0, 30.0])
def test_between_two_numbers_the_error_falls_as_their_root(spp: float):
    paths, seconds = equal(CONVERGING, 0.4 / spp**0.5)
    assert paths == pytest.approx(spp)
    below, above = (max if at < spp else min for at in (0, np.inf))
    low = below(n for n in CONVERGING if n < spp)
    high = above(n for n in CONVERGING if n > spp)
    assert CONVERGING[low][1] < seconds < CONVERGING[high][1]


def test_beyond_the_last_number_the_error_goes_on_falling():
    paths, seconds = equal(CONVERGING, 0.4 / 256**0.5)
    assert paths == pytest.approx(256)
    assert seconds > CONVERGING[64][1]


def test_no_path_tracer_sends_less_than_its_least_paths():
    assert equal(CONVERGING, 5.0) == (1.0, CONVERGING[1][1])
    assert equal({4: (0.2, 0.5)}, 0.001) == (4.0, 0.5)


@pytest.mark.long
@pytest.mark.usefixtures("variant")
def test_guidance_is_judged_by_the_scenes_of_a_dataset(tmp_path: Path, capsys: pytest.CaptureFixture):
    settings = [
        f"output_dir={tmp_path}", "train.scenes=0", "train_b.scenes=0", "validation.scenes=0",
        "test.scenes=1", "test.lights=[sun]", "test.frames=1", "test.width=32", "test.height=32",
        "test.path_spp=4", "test.guidance_spp=2", "test.reference_buffers=false", "path_frames=4",
        "surfels=4000", "views=12",
        "view_width=64", "view_height=64", "refine_steps=0", "mesh_edge=0.2", "environment_height=32",
        "equal_error.reference_spp=256", "equal_error.rounds=1",
    ]  # fmt: skip

    def run(*more: str) -> int:
        with pytest.raises(SystemExit) as end:
            cli([*settings, *more])
        return int(end.value.code or 0)

    assert run("mode=equal_error") == 2
    assert "test-000000 is not there" in capsys.readouterr().err
    assert run() == 0
    assert run("mode=equal_error") == 0
    (case,) = json.loads((tmp_path / "equal_error.json").read_text())["cases"]
    assert list(case["ways"]) == list(WAYS)
    errors = [at["error"] for at in case["path_tracer"]]
    assert errors[0] > 2 * errors[-1], "more paths, less error"
    for way in case["ways"].values():
        assert 0.005 < way["error"] < 0.2
        assert way["ratio"] == pytest.approx(way["seconds"] / way["path_seconds"])
    best = min(way["error"] for way in case["ways"].values())
    assert errors[-1] <= best
    (picture,) = (tmp_path / "equal_error").glob("*.png")
    ours, _, truth = np.split(read_image(picture), 3, axis=1)
    assert np.abs(ours - truth).mean() < 0.1
    assert run("mode=validate") == 0
