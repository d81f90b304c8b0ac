"""Windows over a clip: each frame drawn, by the window that the overlap says, in bounded memory."""

from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
import torch

from tron import seeds
from tron.errors import TronError
from tron.neural.clips import Overlap, windows
from tron.neural.configs import RendererConfig, UNetRendererConfig
from tron.neural.renderer import NeuralRenderer, render_clip, render_frames
from tron.shards.schema import GUIDANCE

OVERLAPS: tuple[Overlap, ...] = ("newest", "mean", "anchor")
SMALL = {"kind": "unet", "widths": (6, 8), "blocks": (1, 1), "blocks_up": (1,)}


def clip(frames: int, seed: int = 0) -> dict[str, np.ndarray]:
    random = seeds.generator(seed, "clip")
    return {name: random.random((frames, 8, 9, 3), dtype=np.float32) for name in GUIDANCE}


def shaken(temporal: bool, window: int = 5) -> NeuralRenderer:
    """A renderer none of whose weights is where it began."""
    config = {"window": window, "backbone": SMALL | {"temporal": temporal}}
    renderer = NeuralRenderer(UNetRendererConfig.model_validate(config))
    torch.manual_seed(3)
    for parameter in renderer.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    return renderer.eval()


@pytest.mark.parametrize(
    ("frames", "size", "factor"),
    [(1, 1, 4), (7, 1, 4), (5, 5, 4), (12, 5, 4), (3, 5, 4), (6, 9, 4), (9, 9, 4), (3, 5, 1), (8, 4, 1)],
)
@pytest.mark.parametrize("overlap", OVERLAPS)
def test_windows_keep_every_frame_and_only_their_own(frames, size, factor, overlap):
    passes = windows(frames, size, factor, overlap)
    kept = Counter(index for each in passes for index in each.kept)
    assert set(kept) == set(range(frames))
    assert all(set(each.kept) <= set(each.frames) and each.kept for each in passes)
    assert all((len(each.frames) - 1) % factor == 0 and len(each.frames) <= size for each in passes)
    held = Counter(index for each in passes for index in each.frames)
    assert kept == (held if overlap == "mean" else Counter(range(frames)))


def test_newest_takes_the_last_frame_and_anchor_the_middle_one():
    newest = windows(12, 5, overlap="newest")
    assert [*newest[0].kept] == [0, 1, 2, 3, 4]
    assert all([*each.kept] == [each.frames[-1]] for each in newest[1:])
    anchor = windows(12, 5, overlap="anchor")
    assert [*anchor[0].kept] == [0, 1, 2]
    assert [*anchor[-1].kept] == [9, 10, 11]
    assert all([*each.kept] == [each.frames[2]] for each in anchor[1:-1])


def test_another_overlap_is_refused_with_the_names_there_are():
    with pytest.raises(TronError, match="newest, mean, anchor"):
        windows(5, 5, overlap="oldest")  # type: ignore[arg-type]


def test_a_network_that_ignores_time_draws_the_same_under_every_overlap():
    still, given = shaken(temporal=False), clip(9)
    single = render_clip(still, given, window=1)
    for overlap in OVERLAPS:
        np.testing.assert_allclose(render_clip(still, given, overlap=overlap), single, atol=1e-6)
    moving = shaken(temporal=True)
    drawn = [render_clip(moving, given, overlap=overlap) for overlap in OVERLAPS]
    assert all(np.abs(a - b).max() > 1e-3 for a, b in pairwise(drawn))


@pytest.mark.parametrize("frames", [3, 9])
def test_the_mean_is_that_of_all_windows_that_hold_a_frame(frames):
    renderer, given = shaken(temporal=True), clip(frames)
    size = min(frames, 5)
    whole = np.zeros((frames, 8, 9, 3))
    counts = np.zeros((frames, 1, 1, 1))
    for start in range(frames - size + 1):
        part = {name: buffer[start : start + size] for name, buffer in given.items()}
        whole[start : start + size] += render_clip(renderer, part)
        counts[start : start + size] += 1
    np.testing.assert_allclose(render_clip(renderer, given, overlap="mean"), whole / counts, atol=1e-6)


def test_an_anchored_frame_is_the_middle_of_its_own_window():
    renderer, given = shaken(temporal=True), clip(9)
    drawn = render_clip(renderer, given, overlap="anchor")
    for index in range(2, 7):
        part = {name: buffer[index - 2 : index + 3] for name, buffer in given.items()}
        np.testing.assert_allclose(drawn[index], render_clip(renderer, part)[2], atol=1e-6)


@pytest.mark.parametrize("overlap", OVERLAPS)
def test_frames_are_read_once_in_order_and_come_as_soon_as_they_can(overlap):
    """Bounded memory: a frame is out before the one that is 2 K ahead of it is read."""
    renderer, given, read = shaken(temporal=True), clip(14), []

    def reading(index: int) -> dict[str, np.ndarray]:
        read.append(index)
        return {name: buffer[index] for name, buffer in given.items()}

    drawn = []
    for index, frame in enumerate(render_frames(renderer, reading, 14, overlap=overlap)):
        assert read[-1] < index + 2 * 5
        drawn.append(frame)
    assert read == list(range(14))
    np.testing.assert_array_equal(np.stack(drawn), render_clip(renderer, given, overlap=overlap))


def test_windows_that_the_codec_cannot_take_are_refused_before_a_frame_is_read():
    given = clip(3)
    with pytest.raises(TronError, match=r"1 \+ 4n"):
        render_clip(NeuralRenderer(RendererConfig.model_validate({"backbone": SMALL})), given, window=3)
    assert render_clip(shaken(temporal=True), given, window=3).shape == (3, 8, 9, 3)
