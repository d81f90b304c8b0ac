"""Laws of warping error, flicker and far views; spoiled clips in order; VBench as a process."""

import sys
from pathlib import Path

import numpy as np
import pytest

from eval.video.order import FROZEN, GOOD, LOWER, made_clip, order_rows, ordered, spoiled
from eval.video.steadiness import Steadiness, Surfaces
from eval.video.vbench import WEIGHTS, VBench, write_clip
from tron.errors import TronError
from tron.flow import Match, surface_motion
from tron.seeds import generator

SIZE = 40


def standing(count: int) -> Surfaces:
    """A camera that does not move before a wall."""
    match = Match(np.zeros((SIZE, SIZE, 2)), np.ones((SIZE, SIZE), bool))
    return Surfaces.of(lambda *_: match, np.ones((count, SIZE, SIZE), bool))


def test_white_noise_has_the_steadiness_of_its_variance():
    sigma = 0.05
    noise = sigma * generator(3, "noise").standard_normal((9, SIZE, SIZE, 3))
    found = Steadiness.of(noise, standing(9))
    assert found.warping.mean == pytest.approx(2 * sigma**2, rel=0.05)
    assert found.flicker.mean == pytest.approx(1.5 * sigma**2, rel=0.05)
    assert found.far.mean == pytest.approx(2 * sigma**2, rel=0.05)


def test_a_light_that_grows_evenly_does_not_flicker():
    frames = np.broadcast_to(0.1 + 0.05 * np.arange(9)[:, None, None, None], (9, SIZE, SIZE, 3))
    found = Steadiness.of(frames, standing(9))
    assert found.flicker.mean == pytest.approx(0, abs=1e-12)
    assert found.warping.mean == pytest.approx(0.05**2)
    assert found.far.mean == pytest.approx(0.2**2)  # four frames away


def test_what_is_not_inside_is_not_judged():
    frames = np.zeros((5, SIZE, SIZE, 3))
    frames[2, :, : SIZE // 2] = 1
    inside = np.zeros((5, SIZE, SIZE), bool)
    inside[:, :, SIZE // 2 :] = True
    match = Match(np.zeros((SIZE, SIZE, 2)), np.ones((SIZE, SIZE), bool))
    found = Steadiness.of(frames, Surfaces.of(lambda *_: match, inside))
    assert found.warping == (0.0, 4 * SIZE * SIZE // 2)


def test_clips_of_two_frames_have_a_warping_error_alone():
    found = Steadiness.of(generator(1, "two").uniform(size=(2, SIZE, SIZE, 3)), standing(2))
    assert found.warping.mean > 0
    assert found.flicker == found.far == (0.0, 0)


@pytest.mark.parametrize("seed", [0, 11, 12])
def test_spoiled_clips_rank_as_they_should(seed: int):
    rows = {row.metric: row.value for row in order_rows(seed)}
    assert rows["video.order_correct"] == 1
    assert rows["video.made_plain.frozen"] == 0, "what a measure without flow would call the steadiest"


def test_a_clip_passed_off_as_good_is_found_out():
    """Each line of the order fails for some exchange: the verdict can be 0."""
    cameras, depth, truth = made_clip()
    surfaces = Surfaces.of(surface_motion(cameras, depth.__getitem__), depth > 0)
    measured = {name: Steadiness.of(clip, surfaces) for name, clip in spoiled(truth, 0).items()}
    assert ordered(measured)
    for _, better, worse in LOWER:
        assert not ordered(measured | {better: measured[worse], worse: measured[better]})
    assert not ordered(dict.fromkeys(measured, measured[GOOD]))
    assert measured[FROZEN].far.mean > 50 * measured[GOOD].far.mean


def test_vbench_that_is_not_there_is_named_for_every_dimension(tmp_path: Path):
    absent = VBench(tmp_path / "python", tmp_path, 60).absent()
    assert set(absent) == set(WEIGHTS)
    assert all("does not start" in why for why in absent.values())


PACKAGE = '''
import json, os
class VBench:
    """As vbench 0.1.5 is called, and the files that it leaves."""
    def __init__(self, device, full_info_dir, output_path):
        self.output_path = output_path
    def evaluate(self, videos_path, name, prompt_list=[], dimension_list=None, local=False, read_frame=False,
                 mode="vbench_standard", **kwargs):
        assert local and mode == "custom_input" and os.environ["VBENCH_CACHE_DIR"]
        files = [each for each in os.listdir(videos_path) if each.endswith(".mp4")]
        scores = [{"video_path": os.path.join(videos_path, each), "video_results": 50 + k} for k, each in
                  enumerate(sorted(files))]
        if "broken" in files[0]:
            raise RuntimeError("no such video")
        if "short" in files[0]:
            scores = scores[1:]
        with open(os.path.join(self.output_path, name + "_eval_results.json"), "w") as file:
            json.dump({each: [0.5, scores] for each in dimension_list}, file)
'''


@pytest.fixture
def vbench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> VBench:
    """A package of VBench's shape, and two of its weights; the real ones cannot be had here."""
    (tmp_path / "package/vbench").mkdir(parents=True)
    (tmp_path / "package/vbench/__init__.py").write_text(PACKAGE)
    (tmp_path / "package/torch.py").write_text(
        "class cuda:\n    is_available = staticmethod(lambda: False)\ndevice = str\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "package"))
    for file in (*WEIGHTS["imaging_quality"], *WEIGHTS["motion_smoothness"]):
        (tmp_path / "weights" / file).parent.mkdir(parents=True)
        (tmp_path / "weights" / file).touch()
    return VBench(Path(sys.executable), tmp_path / "weights", 60)


def test_dimensions_without_weights_are_named_and_others_measured(vbench: VBench, tmp_path: Path):
    absent = vbench.absent()
    assert set(absent) == set(WEIGHTS) - {"imaging_quality", "motion_smoothness"}
    assert "ViT-B-32.pt is missing" in absent["background_consistency"]
    clips = tmp_path / "clips"
    clips.mkdir()
    for name in ("0001", "0002"):
        (clips / f"{name}.mp4").touch()
    found = vbench.measure(clips, ["imaging_quality", "motion_smoothness"])
    assert found["imaging_quality"] == {"0001": 0.50, "0002": 0.51}, "percent"
    assert found["motion_smoothness"]["0002"] == 51


@pytest.mark.parametrize(
    "name, said", [("broken", "no such video"), ("short", "no imaging_quality for clip")]
)
def test_a_vbench_that_fails_or_leaves_out_a_clip_is_one_line(
    vbench: VBench, tmp_path: Path, name: str, said: str
):
    clips = tmp_path / "clips"
    clips.mkdir()
    (clips / f"{name}.mp4").touch()
    with pytest.raises(TronError, match=said):
        vbench.measure(clips, ["imaging_quality"])


def test_results_that_are_none_are_one_line(vbench: VBench, tmp_path: Path):
    package = tmp_path / "package/vbench/__init__.py"
    (tmp_path / "a.mp4").touch()
    for wrong, said in (("'nan'", "no results that can be read"), ("[0.5, scores]", "no number")):
        package.write_text(PACKAGE.replace("[0.5, scores]", wrong).replace("50 + k", "float('nan')"))
        with pytest.raises(TronError, match=said):
            vbench.measure(tmp_path, ["imaging_quality"])


def test_clips_for_vbench_have_the_papers_size_and_length(tmp_path: Path):
    import av

    write_clip(tmp_path / "clip.mp4", [np.full((9, 16, 3), k % 2) for k in range(3)])
    with av.open(tmp_path / "clip.mp4") as film:
        frames = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    assert [frame.shape for frame in frames] == [(1080, 1920, 3)] * 3
    assert frames[0].mean() < 5 < 250 < frames[1].mean()
