"""The sheet shows scenes evenly: over splits and styles, over the scenes of each, over lights."""

from collections import Counter
from itertools import pairwise
from pathlib import Path

import pytest

from datagen.clip_rows import ClipRow
from datagen.contact_sheet import contact_sheet, sheet_clips
from tron.errors import TronError
from tron.images import decode_png, read_image


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
    everything = rows("train", "A", 500) + rows("train", "room", 3) + rows("test", "A", 40)
    found = sheet_clips(everything)
    assert len({row.scene for row in found}) == len(found) == 64
    kinds = Counter((row.split, row.style) for row in found)
    assert kinds == {("train", "A"): 31, ("train", "room"): 3, ("test", "A"): 30}
    numbers = [int(row.scene[-4:]) for row in found if (row.split, row.style) == ("train", "A")]
    apart = {b - a for a, b in pairwise(numbers)}
    assert apart <= {16, 17}, "from the first scenes to the last"
    lights = Counter(row.light_family for row in found)
    assert max(lights.values()) - min(lights.values()) <= 1


def test_a_small_dataset_shows_all_its_scenes():
    found = sheet_clips(rows("train", "A", 5, lights=1))
    assert [row.scene[-4:] for row in found] == ["0000", "0001", "0002", "0003", "0004"]
    without = [row.model_copy(update={"thumbnail": None}) for row in rows("train", "A", 5)]
    assert sheet_clips(without) == []
    assert contact_sheet(Path(), without) is None


def test_the_sheet_of_a_dataset_is_made_of_its_thumbnails(small_dataset: Path):
    sheet = read_image(small_dataset / "sheet.png")
    assert sheet.shape == (2 * 36 + 4, 2 * 36 + 4, 3)  # four scenes of 32 x 24 in squares of 32
    first = decode_png((small_dataset / "previews" / "train-000000-l0.jpg").read_bytes())
    assert (sheet[4 + 4 : 4 + 28, 4:36] == first).all()


def test_a_thumbnail_that_is_missing_or_damaged_is_named_with_what_makes_it_again(tmp_path: Path):
    for data in (None, b"no picture"):
        if data is not None:
            (tmp_path / "x.jpg").write_bytes(data)
        with pytest.raises(TronError, match=r"x\.jpg.*delete scenes/train-A0000/record\.json"):
            contact_sheet(tmp_path, rows("train", "A", 1, lights=1))
