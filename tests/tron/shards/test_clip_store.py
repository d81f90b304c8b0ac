"""Clips by number and frame: what read_clips gives, by an index that is never believed blindly."""

import io
import pickle
import shutil
import tarfile
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import fsspec
import numpy as np
import pytest
from webdataset.compat import WebDataset

from tron import seeds
from tron.cameras import Camera
from tron.errors import TronError
from tron.shards import MEMBERS, Clip, ClipMeta, ClipStore, Manifest, ShardWriter, clip_members, read_clips
from tron.shards import clip_store as clip_store_module
from tron.shards.clip_store import LARGEST_READ, ByteRanges, _neighbours
from tron.shards.index import index_name, index_of, parse_index, scan_index

FRAMES = 3
SHARD = "train-00000.tar"
INDEX = "train-00000.idx"


def write(folder: Path, clips: int = 3, per_shard: int = 2, reference: bool = False) -> Manifest:
    with ShardWriter(folder, "train", per_shard) as writer:
        for number in range(clips):
            meta = ClipMeta(
                key=f"a{number}",
                scene="a",
                light="l",
                light_family="sun",
                split="train",
                frames=FRAMES,
                width=8,
                height=6,
                cameras=[Camera.look_at((0, -4, 1), (0, 0, 0), fov_deg=35, width=8, height=6).to_dict()]  # type: ignore[arg-type]
                * FRAMES,
                exposure=1.0,
                color_space={},
            )
            random = seeds.generator(0, "clip", number)
            shapes = {name: (6, 8, MEMBERS[name].channels) for name in clip_members(reference)}
            writer.write(
                meta, [{name: random.random(shape) for name, shape in shapes.items()} for _ in range(FRAMES)]
            )
    manifest = Manifest(shards=writer.entries)
    manifest.save(folder)
    return manifest


@pytest.fixture
def folder(tmp_path) -> Path:
    write(tmp_path / "data")
    return tmp_path / "data"


def require_same(a: Clip, b: Clip) -> None:
    assert a.meta == b.meta
    assert a.frames.keys() == b.frames.keys()
    for name in a.frames:
        np.testing.assert_array_equal(a.frames[name], b.frames[name])


def require_read_as_a_stream(folder: Path, **options) -> None:
    whole = list(read_clips(folder, "train"))
    store = ClipStore(folder, "train", **options)
    assert [store.key(number) for number in range(len(store))] == [clip.meta.key for clip in whole]
    for number in reversed(range(len(store))):
        require_same(store.read_frames(number), whole[number])


@pytest.mark.parametrize("reference", [False, True])
def test_clips_by_number_are_those_read_in_order(tmp_path, reference):
    write(tmp_path, reference=reference)
    require_read_as_a_stream(tmp_path)


def test_chosen_frames_and_members_are_those_of_the_whole_clip(folder):
    whole = list(read_clips(folder, "train"))
    store = ClipStore(folder, "train", ["mask", "rgb"])
    for number, frames in ((0, [2]), (2, [1, 0]), (1, range(3))):
        clip = store.read_frames(number, frames)
        assert list(clip.frames) == ["mask", "rgb"]
        for name, images in clip.frames.items():
            np.testing.assert_array_equal(images, whole[number].frames[name][list(frames)])
    assert list(store.read_frames(0, [0], ["lit"]).frames) == ["lit"]


def test_only_the_bytes_of_those_frames_are_read(folder, monkeypatch):
    read: list[int] = []
    original = ByteRanges._read

    def counted(self, name, start, size):
        read.append(size)
        return original(self, name, start, size)

    store = ClipStore(folder, "train", ["rgb"])
    store.meta(1)
    monkeypatch.setattr(ByteRanges, "_read", counted)
    store.read_frames(1, [1])
    with tarfile.open(folder / SHARD) as tar:
        assert read == [512 + tar.getmember("a1.f01.rgb.exr").size]


def test_the_index_is_that_of_wds2idx(folder):
    """By the rules of DALI's tool: at each offset lie the file's bytes, extensions begin at the first dot."""
    data = (folder / SHARD).read_bytes()
    head, *lines = (folder / INDEX).read_text().splitlines()
    assert head == "v1.2 2"
    named = []
    for line in lines:
        fields = line.split(" ")
        for extension, offset, size, name in zip(*(fields[part::4] for part in range(4))):
            assert name.split(".", 1)[1] == extension
            named.append((name, data[int(offset) : int(offset) + int(size)]))
    with tarfile.open(folder / SHARD) as tar:
        assert named == [(info.name, tar.extractfile(info).read()) for info in tar]  # type: ignore[union-attr]


def test_a_written_index_is_what_the_headers_say(folder):
    with (folder / SHARD).open("rb") as file:
        scanned = scan_index(file, SHARD)
    parsed = parse_index((folder / INDEX).read_bytes(), (folder / SHARD).stat().st_size, INDEX)
    assert parsed is not None
    assert list(parsed) == list(scanned) == ["a0", "a1"]
    for key, clip in scanned.items():
        assert parsed[key].places == clip.places
        np.testing.assert_array_equal(parsed[key].offsets, clip.offsets)
        np.testing.assert_array_equal(parsed[key].sizes, clip.sizes)


def test_shards_open_with_webdatasets_own_reader(folder):
    opened = list(WebDataset(str(folder / SHARD), shardshuffle=False))
    assert [sample["__key__"] for sample in opened] == ["a0", "a1"]
    assert len(opened[0]["f00.rgb.exr"]) > 100


def _edited(edit: Callable[[str], str]) -> Callable[[Path], object]:
    return lambda folder: (folder / INDEX).write_text(edit((folder / INDEX).read_text()))


SPOILED: dict[str, Callable[[Path], object]] = {
    "missing": lambda folder: (folder / INDEX).unlink(),
    "empty": lambda folder: (folder / INDEX).write_bytes(b""),
    "garbage": lambda folder: (folder / INDEX).write_bytes(bytes(range(256))),
    "half": lambda folder: (folder / INDEX).write_bytes((folder / INDEX).read_bytes()[:700]),
    "another version": _edited(lambda text: text.replace("v1.2", "v1.1")),
    "beyond the tar": _edited(lambda text: text.replace(" 512 ", " 999999999999 ")),
    "negative": _edited(lambda text: text.replace(" 512 ", " -512 ")),
    "beyond int64": _edited(lambda text: text.replace(" 512 ", f" {10**30} ")),
    "another shard's": lambda folder: shutil.copy(folder / "train-00001.idx", folder / INDEX),
    "other names": _edited(lambda text: text.replace("a0.f00.pbr.exr", "../../etc/passwd")),
    "exchanged names": _edited(
        lambda text: text.replace("f00.pbr", "@").replace("f01.pbr", "f00.pbr").replace("@", "f01.pbr")
    ),
    "exchanged members": _edited(
        lambda text: text.replace("pbr", "@").replace("lit", "pbr").replace("@", "lit")
    ),
}


@pytest.mark.parametrize("kind", SPOILED)
def test_a_wrong_index_is_no_worse_than_none(folder, kind):
    SPOILED[kind](folder)
    require_read_as_a_stream(folder)


def test_the_headers_are_walked_only_where_there_is_no_index(folder, monkeypatch):
    walked = []

    def counted(file, where):
        walked.append(Path(where).name)
        return scan_index(file, where)

    monkeypatch.setattr(clip_store_module, "scan_index", counted)
    require_read_as_a_stream(folder)
    assert walked == []
    (folder / INDEX).unlink()
    require_read_as_a_stream(folder)
    assert walked == [SHARD]


def test_headers_of_a_damaged_shard_are_walked_once(folder, monkeypatch):
    walked = []

    def counted(file, where):
        walked.append(where)
        return scan_index(file, where)

    monkeypatch.setattr(clip_store_module, "scan_index", counted)
    (folder / INDEX).unlink()
    rewritten(folder, lambda members: members[:1] + members)
    with pytest.raises(TronError, match="twice"):
        ClipStore(folder, "train").meta(0)
    assert len(walked) == 1


def test_a_file_that_is_there_twice_ends_the_walk():
    met = []

    def endless():
        while True:
            met.append(None)
            yield "a.f00.pbr.exr", 512, 0

    with pytest.raises(TronError, match=r"member f00\.pbr\.exr twice"):
        index_of(endless(), "shard")
    assert len(met) == 2


def test_an_index_of_millions_of_entries_is_not_split():
    data = b"v1.2 1\n" + b" 0 0 . " * 1_000_000 + b" 0 0 meta.json"
    tracemalloc.start()
    try:
        assert parse_index(data, 10_240, "shard") is None
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


def test_a_split_whose_clips_have_no_names_is_refused(folder):
    manifest = Manifest.load(folder)
    for entry in manifest.shards:
        entry.keys = []
    manifest.save(folder)
    with pytest.raises(TronError, match="names no clip of the split 'train'"):
        ClipStore(folder, "train")


def rewritten(folder: Path, change: Callable[[list], list], **options) -> None:
    with tarfile.open(folder / SHARD) as tar:
        members = [(info, tar.extractfile(info).read()) for info in tar]  # type: ignore[union-attr]
    with tarfile.open(folder / SHARD, "w", **options) as tar:
        for info, data in change(members):
            tar.addfile(info, io.BytesIO(data))


def test_a_tar_of_another_writer_is_walked(folder):
    def dated(members: list) -> list:
        for info, _ in members:
            info.mtime = 1.5  # a header of its own in pax
        return members

    whole = list(read_clips(folder, "train"))
    rewritten(folder, dated, format=tarfile.PAX_FORMAT)
    store = ClipStore(folder, "train")
    for number, clip in enumerate(whole):
        require_same(store.read_frames(number), clip)


@pytest.mark.parametrize("kept", [True, False])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda members: [members[0], *members], "twice"),
        (lambda members: [*members[1:], members[0]], "do not follow"),
        (lambda members: [each for each in members if not each[0].name.startswith("a1")], "manifest names 2"),
        (lambda members: [each for each in members if each[0].name != "a0.meta.json"], "no meta.json"),
        (lambda members: [each for each in members if each[0].name != "a0.f01.pbr.exr"], "no member f01.pbr"),
    ],
)
def test_broken_shards_are_one_line(folder, change, message, kept):
    rewritten(folder, change)
    if not kept:
        (folder / INDEX).unlink()
    store = ClipStore(folder, "train")
    with pytest.raises(TronError, match=message) as caught:
        store.read_frames(0)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("cut", [0, 600, 5000, 20_000, -512])
def test_a_truncated_shard_is_one_line(folder, cut):
    data = (folder / SHARD).read_bytes()
    (folder / SHARD).write_bytes(data[:cut] if cut >= 0 else data[: len(data) // 2])
    with pytest.raises(TronError):
        ClipStore(folder, "train").read_frames(1)


def test_a_missing_shard_frame_or_clip_is_said(folder):
    store = ClipStore(folder, "train")
    for frame in (-1, FRAMES):
        with pytest.raises(TronError, match=f"clip a0 has no frame {frame}"):
            store.read_frames(0, [frame])
    with pytest.raises(IndexError):
        store.read_frames(3)
    with pytest.raises(TronError, match="no member is called 'beauty'"):
        store.read_frames(0, [0], ["beauty"])
    (folder / "train-00001.tar").unlink()
    with pytest.raises(TronError, match=r"shard is missing.*train-00001"):
        store.read_frames(2)


def test_metadata_of_another_clip_are_refused(folder):
    def exchanged(members: list) -> list:
        places = {info.name: place for place, (info, _) in enumerate(members)}
        a, b = members[places["a0.meta.json"]], members[places["a1.meta.json"]]
        members[places["a0.meta.json"]] = (a[0], b[1])
        return members

    rewritten(folder, exchanged)
    with pytest.raises(TronError, match="clip a0 has the metadata of a1"):
        ClipStore(folder, "train").meta(0)


def test_memory_is_bounded_and_what_was_forgotten_is_read_again(folder, monkeypatch):
    monkeypatch.setattr(clip_store_module, "MOST_METAS", 1)
    monkeypatch.setattr(clip_store_module, "MOST_INDEXED", 30)
    store = ClipStore(folder, "train")
    for number in (0, 2, 1, 0, 2):
        store.read_frames(number, [0], ["rgb"])
        assert (len(store._metas), len(store._indexes)) == (1, 1)


def test_a_store_goes_to_another_process_with_its_files_closed(folder):
    store = ClipStore(folder, "train")
    expected = store.read_frames(1)
    require_same(pickle.loads(pickle.dumps(store)).read_frames(1), expected)
    store.close()
    require_same(store.read_frames(1), expected)


@pytest.mark.parametrize("indexed", [True, False])
def test_an_object_store_gives_the_same_clips(folder, indexed):
    memory = fsspec.filesystem("memory")
    for path in folder.iterdir():
        if indexed or path.suffix != ".idx":
            memory.pipe(f"/clips{indexed}/{path.name}", path.read_bytes())
    store = ClipStore(f"memory://clips{indexed}", "train", manifest=Manifest.load(folder))
    for number, clip in enumerate(read_clips(folder, "train")):
        require_same(store.read_frames(number), clip)


def test_neighbouring_ranges_are_read_at_once():
    ranges = [(0, 10), (12, 20), (500, 510), (510, 510 + LARGEST_READ)]
    groups = list(_neighbours(ranges, 5))
    assert groups == [
        (0, 20, ranges[:2]),
        (500, 510, [(500, 510)]),
        (510, 510 + LARGEST_READ, [(510, 510 + LARGEST_READ)]),
    ]


def test_the_name_of_an_index():
    assert index_name(SHARD) == INDEX
