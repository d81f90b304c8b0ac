"""The part `reader` of the datagen benchmark: all ways read the same, and one frame costs less than all."""

import numpy as np

from eval.datagen.reader import BUFFERS, SPLIT, WAYS, measure_reader, read_streamed, read_whole, write_clips
from eval.datagen.settings import ReaderSettings
from tron.shards.clip_store import ClipStore
from tron.shards.verify import verify

TOY = ReaderSettings(clips=2, frames=24, width=32, samples=4, rounds=2)


def test_all_ways_read_the_same_frame(tmp_path):
    write_clips(tmp_path, TOY, 0)
    assert verify(tmp_path) == []
    expected = ClipStore(tmp_path, SPLIT, BUFFERS).read_frames(1, [7])
    for read in (read_streamed, read_whole):
        clip = read(tmp_path, 1, 7)
        assert clip.frames.keys() == expected.frames.keys()
        for name, images in clip.frames.items():
            np.testing.assert_array_equal(images, expected.frames[name])
    assert expected.frames["rgb"].std() > 0.1


def test_one_frame_by_index_is_faster_than_a_whole_clip_and_nothing_is_left(tmp_path):
    found = measure_reader(TOY, 0, tmp_path)
    rows = {row.metric: row.value for row in found.rows(0)}
    assert rows.keys() == {
        "reader.samples_per_second.k1",
        "reader.samples_per_second.k5",
        "reader.speedup.k1",
        "reader.speedup.k1.streamed",
    }
    assert rows["reader.speedup.k1"] > 2  # of 24: a frame against all frames
    assert found.seconds.keys() == WAYS.keys()
    assert all(len(seconds) == TOY.rounds for seconds in found.seconds.values())
    assert list(tmp_path.iterdir()) == []
    assert "24 frames, 32²" in str(found.sections(tmp_path))
