"""Previews hold a clip's light to the precision that they state, and its frames from first to last."""

import base64
import json
from collections import Counter
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import ImageColor

from datagen.dataset.clip_preview import (
    CODES,
    LARGEST_SIDE,
    LOG2_RANGE,
    displayable,
    log_pixels,
    scenes_sheet,
    sheet_clips,
    shown_frames,
    shrink,
)
from datagen.dataset.records import ClipRow
from tron.color import to_display
from tron.errors import TronError
from tron.io.images import decode_png, read_image
from tron.seeds import generator
from tron.shards.reader import read_clips
from tron.shards.schema import MEMBERS


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


REFLECTANCES = [name for name in MEMBERS if name.startswith("base_color") or name == "albedo"]


@pytest.mark.parametrize("member", REFLECTANCES)
def test_reflectance_is_shown_through_the_srgb_curve(member: str):
    # CSS colours are sRGB; their linear values by the curve of IEC 61966-2-1: 0.0047 is on its straight part.
    encoded = np.array([ImageColor.getrgb(name) for name in ("gray", "orange", "#0e0f10")], np.float32) / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(displayable(member, linear[None])[0], encoded, atol=1e-5)


def test_normals_are_shown_by_halves_and_none_is_black():
    shown = displayable("normal", np.array([[[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]], np.float32))
    np.testing.assert_allclose(shown, [[[0.5, 0.5, 1.0], [0.0, 0.0, 0.0]]])


def rows(split: str, style: str, scenes: int, lights: int = 4) -> list[ClipRow]:
    return [
        ClipRow(
            key=f"{split}-{style}{scene:04d}-l{light}",
            scene=f"{split}-{style}{scene:04d}",
            split=split,
            style=style,
            light_family=f"family{light}",
            contrast="low",
            contrast_share=0.1,
            exposure=1.0,
            frames=5,
            width=96,
            height=96,
            shard=f"{split}-{scene:05d}.tar",
            thumbnail="x.jpg",
        )
        for scene in range(scenes)
        for light in range(lights)
    ]


def test_every_split_and_style_has_its_share_of_the_sheet():
    everything = rows("train", "table", 500) + rows("train", "room", 3) + rows("test", "table", 40)
    found = sheet_clips(everything)
    assert len({row.scene for row in found}) == len(found) == 64
    kinds = Counter((row.split, row.style) for row in found)
    assert kinds == {("train", "table"): 31, ("train", "room"): 3, ("test", "table"): 30}
    numbers = [int(row.scene[-4:]) for row in found if (row.split, row.style) == ("train", "table")]
    apart = {b - a for a, b in pairwise(numbers)}
    assert apart <= {16, 17}, "from the first scenes to the last"
    lights = Counter(row.light_family for row in found)
    assert max(lights.values()) - min(lights.values()) <= 1


def test_a_small_dataset_shows_all_its_scenes():
    found = sheet_clips(rows("train", "table", 5, lights=1))
    assert [row.scene[-4:] for row in found] == ["0000", "0001", "0002", "0003", "0004"]
    without = [row.model_copy(update={"thumbnail": None}) for row in rows("train", "table", 5)]
    assert sheet_clips(without) == []
    assert scenes_sheet(Path(), without) is None


def test_the_sheet_of_a_dataset_is_made_of_its_thumbnails(small_dataset: Path):
    sheet = read_image(small_dataset / "sheet.png")
    assert sheet.shape == (2 * 36 + 4, 2 * 36 + 4, 3)  # four scenes of 32 x 24 in squares of 32
    first = decode_png((small_dataset / "previews" / "train-000000-l0.jpg").read_bytes())
    assert (sheet[4 + 4 : 4 + 28, 4:36] == first).all()


def test_a_thumbnail_that_is_missing_or_damaged_is_named_with_what_makes_it_again(tmp_path: Path):
    for data in (None, b"no picture"):
        if data is not None:
            (tmp_path / "x.jpg").write_bytes(data)
        with pytest.raises(TronError, match=r"x\.jpg.*delete scenes/train-table0000/record\.json"):
            scenes_sheet(tmp_path, rows("train", "table", 1, lights=1))
