"""Previews hold a clip's light to the precision that they state, and its frames from first to last."""

import base64
import json
from pathlib import Path

import numpy as np
import pytest

from datagen.clip_preview import CODES, LARGEST_SIDE, LOG2_RANGE, log_pixels, shown_frames, shrink
from tron.color import to_display
from tron.images import decode_png, read_image
from tron.seeds import generator
from tron.shards.reader import read_clips


def radiance(pixels: np.ndarray) -> np.ndarray:
    """What the page computes from (2H, W, 3) bytes, written again from the docstring of log_pixels."""
    height = len(pixels) // 2
    code = 16.0 * pixels[:height] + pixels[height:]
    low, high = LOG2_RANGE
    return np.where(code == 0, 0.0, 2.0 ** (low + (high - low) * (code - 1) / (CODES - 1)))


def test_twelve_bits_hold_radiance_to_a_quarter_percent():
    rng = generator(0, "radiance")
    image = 2.0 ** rng.uniform(-16, 16, (64, 64, 3))
    found = radiance(log_pixels(image).astype(float))
    assert np.abs(found / image - 1).max() <= 0.0028
    # no 8-bit picture shows it, at any exposure
    for gain in (0.01, 1.0, 100.0):
        apart = np.abs(to_display(found, gain) - to_display(image, gain)).max()
        assert apart * 255 < 0.25


def test_black_stays_black_and_a_sun_stays_below_infinity():
    image = np.array([[[0.0, 1e-6, 2.0**-16], [65504.0, 1.0, 1e9]]])
    found = radiance(log_pixels(image).astype(float))
    np.testing.assert_allclose(found, [[[0, 0, 2.0**-16], [65504, 1, 65536]]], rtol=0.0028)
    assert found[0, 0, :2].max() == 0


@pytest.mark.parametrize("count", [1, 2, 5, 8, 93])
def test_a_preview_shows_the_first_frame_the_last_and_some_between(count: int):
    shown = shown_frames(count)
    assert (shown[0], shown[-1]) == (0, count - 1)
    assert len(shown) == min(count, 8)
    assert np.ptp(np.diff(shown)) <= 1 if count > 2 else True


def test_large_frames_are_averaged():
    image = generator(1, "large").random((2 * LARGEST_SIDE, 4 * LARGEST_SIDE + 3, 3))
    small = shrink(image)
    assert max(small.shape) <= LARGEST_SIDE
    np.testing.assert_allclose(small[3, 7], image[15:20, 35:40].mean(axis=(0, 1)), rtol=1e-5)
    np.testing.assert_array_equal(shrink(image[:9, :9, :1]), np.repeat(image[:9, :9, :1], 3, 2).astype("f4"))


def test_the_script_and_the_thumbnail_hold_the_shards_frames(small_dataset: Path):
    clip = next(read_clips(small_dataset, "test"))
    text = (small_dataset / "previews" / f"{clip.meta.key}.js").read_text()
    assert text.startswith("showClip(")
    assert text.endswith(");\n")
    tiles = json.loads(text[len("showClip(") : -3])["tiles"]
    assert [tile["frame"] for tile in tiles if tile["member"] == "rgb"] == [0, 1, 2]
    for tile in (tile for tile in tiles if tile["light"]):
        pixels = decode_png(base64.b64decode(tile["png"].split(",")[1])) * 255
        stored = clip.frames[tile["member"]][tile["frame"]]
        seen = stored > 1e-4  # half floats are coarser than the code below
        np.testing.assert_allclose(radiance(np.round(pixels))[seen], stored[seen], rtol=0.004)
    assert sum(tile["light"] for tile in tiles) == 3 + 9
    thumbnail = read_image(small_dataset / "previews" / f"{clip.meta.key}.jpg")
    assert np.abs(thumbnail - clip.displayed("rgb")[0]).mean() < 0.03
