"""Frames brought to a stage's size: constants stay, light is kept, aspect and alignment of buffers too."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from train.examples.framing import Sample, area_resized, centred, covering_size, sized
from tron import seeds
from tron.color import linear_to_srgb
from tron.errors import TronError
from tron.estimation import MOST_RAYS, OCTAVES
from tron.shards import GUIDANCE, Clip, read_clips
from tron.shards.schema import TARGET

sides = st.integers(8, 60)


def random(*path: str | int) -> np.random.Generator:
    return seeds.generator(0, "framing", *path)


def sample_of(video: torch.Tensor, display: frozenset[str] = frozenset()) -> Sample:
    return Sample({name: video.clone() for name in (*GUIDANCE, TARGET)}, display)


@settings(max_examples=60, deadline=None)
@given(sides, sides, sides, sides)
def test_a_constant_stays_and_the_light_of_a_frame_is_kept(width, height, to_width, to_height):
    size = min(width, to_width), min(height, to_height)
    constant = torch.full((3, 1, height, width), 7.25)
    torch.testing.assert_close(area_resized(constant, size), torch.full((3, 1, size[1], size[0]), 7.25))
    video = torch.from_numpy(random(width, height).random((3, 2, height, width), np.float32))
    out = area_resized(video, size)
    assert out.shape == (3, 2, size[1], size[0])
    torch.testing.assert_close(out.mean((-1, -2)), video.mean((-1, -2)))
    assert out.min() >= 0


@pytest.mark.parametrize("factor", [2, 3, 5])
def test_whole_factors_are_means_of_blocks(factor):
    video = torch.rand(3, 1, 6 * factor, 4 * factor)
    blocks = torch.nn.functional.avg_pool2d(video, factor)
    torch.testing.assert_close(area_resized(video, (4, 6)), blocks)


def test_a_pixel_counts_by_the_share_of_it_that_is_covered():
    row = torch.tensor([1.0, 2.0, 4.0]).expand(3, 1, 1, 3)
    out = area_resized(row, (2, 1))[0, 0, 0]
    torch.testing.assert_close(out, torch.tensor([(1 + 2 / 2) / 1.5, (2 / 2 + 4) / 1.5]))


@given(st.tuples(sides, sides), st.tuples(sides, sides))
def test_the_covering_size_covers_and_keeps_the_aspect(frame, wanted):
    size = min(frame[0], wanted[0]), min(frame[1], wanted[1])
    width, height = covering_size(frame, size)
    assert width >= size[0]
    assert height >= size[1]
    assert width == size[0] or height == size[1]
    scales = width / frame[0], height / frame[1]
    assert abs(width - frame[0] * scales[1]) <= 1 or abs(height - frame[1] * scales[0]) <= 1
    assert max(scales) <= 1


def test_frames_smaller_than_the_size_are_refused_in_a_line():
    for size in ((33, 10), (10, 25)):
        with pytest.raises(TronError, match="frames of 32 x 24 are smaller") as caught:
            sized(sample_of(torch.rand(3, 1, 24, 32)), size, random())
        assert "\n" not in str(caught.value)


def test_frames_of_the_size_are_left_as_they_are_bit_by_bit():
    video = torch.rand(3, 2, 24, 32)
    for size in (None, (32, 24)):
        out = sized(sample_of(video), size, random())
        assert all(torch.equal(out.buffers[name], video) for name in out.buffers)


def test_windows_are_random_repeat_and_are_the_same_in_all_buffers():
    video = torch.arange(3 * 24 * 96, dtype=torch.float32).view(3, 1, 24, 96)
    corners = set()
    for number in range(20):
        out = sized(sample_of(video), (16, 12), random(number)).buffers
        again = sized(sample_of(video), (16, 12), random(number)).buffers
        for name, buffer in out.items():
            assert torch.equal(buffer, again[name])
            assert torch.equal(buffer, out[TARGET])
            assert buffer.shape == (3, 1, 12, 16)
        corners.add(float(out[TARGET][0, 0, 0, 0]))
    assert len(corners) > 4  # 48 x 12 cover it: windows begin at 0, 4, ... 32


def test_means_are_of_light_and_not_of_display_values():
    light = torch.rand(3, 1, 16, 16)
    expected = linear_to_srgb(area_resized(light, (8, 8)))
    photo = sample_of(linear_to_srgb(light), frozenset({TARGET}))
    out = sized(photo, (8, 8), random())
    torch.testing.assert_close(out.buffers[TARGET], expected, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(out.buffers["pbr"], area_resized(linear_to_srgb(light), (8, 8)))


def test_sampling_tells_of_the_pixels_that_frames_are_made_to():
    """Three times as wide: nine times the rays, the footprint of three."""
    low, high = OCTAVES
    told = torch.tensor([1 / 3, 1 / MOST_RAYS, (-2 - low) / (high - low)])[:, None, None, None]
    told = told.expand(3, 1, 24, 24)
    sample = Sample({name: told.clone() for name in (*GUIDANCE, TARGET, "sampling")})
    out = sized(sample, (8, 8), random()).buffers["sampling"]
    wanted = torch.tensor([1 / 3, np.log2(18) / MOST_RAYS, (np.log2(3) - 2 - low) / (high - low)])
    torch.testing.assert_close(out, wanted.float()[:, None, None, None].expand_as(out))


def test_validation_takes_the_centre(make_dataset, tmp_path):
    folder = make_dataset(tmp_path, {"validation": 1}, size=24, width=64)
    clip = next(read_clips(folder, "validation"))
    out = centred(clip, (16, 12))  # 32 x 12 cover it
    assert (out.meta.width, out.meta.height) == (16, 12)
    half = Clip(
        clip.meta, {name: images[:, :, 16:48] for name, images in clip.frames.items()}
    )  # twice its centre
    for name, images in out.frames.items():
        blocks = half.frames[name].reshape(6, 12, 2, 16, 2, -1).mean((2, 4))
        if name == "sampling":
            blocks = np.minimum(blocks + np.array([0, 2 / MOST_RAYS, 1 / (OCTAVES[1] - OCTAVES[0])]), 1)
        np.testing.assert_allclose(images, blocks, rtol=1e-5)
    assert centred(clip, None) is clip
