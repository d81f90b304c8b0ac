"""A dataset that cannot seek trains as one that can: over a pipe, over HTTP without ranges, and resumed."""

import itertools
import shutil
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from torch.utils.data import DataLoader

from train.cli import main
from train.curriculum import Stage
from train.examples.data import Batches
from train.examples.sources import CachedSplit, IndexedSplit, Passes
from train.examples.splits import Splits, manifest_hash
from train.settings import DataSettings, Settings
from tron.errors import TronError
from tron.shards import GUIDANCE, ClipStore, read_clips, streaming, webdataset
from tron.shards.schema import TARGET

BUFFERS = (*GUIDANCE, TARGET)
STAGE = Stage(name="one", split="train", steps=10, batch_size=2, crop=16)


@pytest.fixture(scope="module")
def folder(make_dataset, tmp_path_factory) -> Path:
    return make_dataset(
        tmp_path_factory.mktemp("streamed"), {"train": 11, "validation": 2}, frames=3, shard=6
    )


@pytest.fixture
def small_blocks(monkeypatch):
    monkeypatch.setattr(streaming, "HELD", 2)


@pytest.fixture(scope="module")
def server(folder):
    """A web server that sends whole files: Python's own knows no ranges. Yields its URL and what it sent."""
    sent: list[str] = []

    class Handler(SimpleHTTPRequestHandler):
        def log_message(self, format, *args):
            sent.append(self.path)

    served = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(folder)))
    threading.Thread(target=served.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{served.server_port}", sent
    served.shutdown()


def place_of(kind: str, folder: Path, url: str) -> str:
    return {
        "http": url,
        "http shards": f"{url}/train-{{00000..00001}}.tar",
        "pipe": f"pipe:cat '{folder}'/train-{{00000..00001}}.tar",
        "file": f"{folder}/train-{{00000..00001}}.tar",
    }[kind]


def same(one, other) -> bool:
    return one.keys() == other.keys() and all(np.array_equal(one[name], other[name]) for name in one)


@pytest.mark.parametrize("kind", ["http", "http shards", "pipe", "file"])
def test_a_stream_gives_the_clips_of_the_index(folder, server, small_blocks, kind):
    place = place_of(kind, folder, server[0])
    clips, store = Splits(place).clips("train"), ClipStore(folder, "train")
    assert isinstance(clips, streaming.StreamedClips)
    assert [clips.key(n) for n in range(len(clips))] == [store.key(n) for n in range(len(store))]
    for number in (0, 1, 7, 10, 3, 2, 9):  # forwards, backwards, from block to block
        one, other = clips.read_frames(number, [2, 0], BUFFERS), store.read_frames(number, [2, 0], BUFFERS)
        assert one.meta == other.meta
        assert same(one.frames, other.frames)
    assert same(clips.read_frames(10).frames, store.read_frames(10).frames)


@pytest.mark.parametrize("kind", ["http", "http shards", "pipe", "file"])
def test_webdatasets_pipeline_gives_the_clips_as_tensors(folder, server, kind):
    pipeline = webdataset(place_of(kind, folder, server[0]), buffers=["lit", "rgb"])
    for sample, clip in zip(pipeline, read_clips(folder, "train", ["lit", "rgb"]), strict=True):
        assert (sample["__key__"], sample["meta"]) == (clip.meta.key, clip.meta)
        assert same({name: sample[name].numpy() for name in ("lit", "rgb")}, clip.frames)
    keys = {clip.meta.key for clip in read_clips(folder, "train", ["rgb"])}
    loader = DataLoader(pipeline.shuffle(4).to_tuple("__key__", "rgb"), batch_size=None, num_workers=2)
    assert {key for key, _ in loader} == keys, "workers share the shards"
    assert next(iter(pipeline.to_tuple("rgb").batched(3)))[0].shape == (3, 3, 24, 24, 3)


def batches(place: str, source=IndexedSplit, **options) -> Batches:
    split = source(Splits(place).clips("train"), "train", BUFFERS, 0)
    return Batches(STAGE, {"train": split}, BUFFERS, DataSettings(), 0, **options)


def take(stream, count: int) -> list[torch.Tensor]:
    return [torch.stack([b[name] for name in BUFFERS]) for b in itertools.islice(iter(stream), count)]


@pytest.mark.parametrize("kind", ["http", "pipe"])
def test_a_resumed_run_over_a_stream_sees_the_same_samples(folder, server, small_blocks, kind):
    place = place_of(kind, folder, server[0])
    whole = take(batches(place), 12)  # two passes and a little
    for first in (3, 7):
        resumed = DataLoader(batches(place, first_step=first), batch_size=None, num_workers=2)
        assert all(map(torch.equal, whole[first:], take(resumed, 12 - first)))
    assert all(map(torch.equal, whole, take(batches(place, CachedSplit), 12)))
    ranks = [take(batches(place, rank=rank, ranks=2), 2) for rank in range(2)]
    assert all(map(torch.equal, ranks[0] + ranks[1], (whole[0], whole[2], whole[1], whole[3])))


def test_a_pass_over_a_stream_reads_each_shard_once(folder, server, small_blocks):
    url, sent = server
    split = IndexedSplit(Splits(url).clips("train"), "train", BUFFERS, 0)
    split.clips.read_frames(0, [0], BUFFERS)  # what is wanted is known
    split.clips.close()
    sent.clear()
    take(Batches(STAGE, {"train": split}, BUFFERS, DataSettings(), 0), 5)
    assert sorted(sent) == ["/train-00000.tar", "/train-00001.tar"]


def test_a_pass_shuffles_shards_and_the_clips_of_each_block():
    shards = [[range(0, 3), range(3, 5)], [range(5, 8)]]
    orders = [[Passes(seed, "train", 8, shards).clip(n) for n in range(8)] for seed in range(20)]
    assert all(sorted(order) == list(range(8)) for order in orders)
    assert {tuple(sorted(order[:3])) for order in orders} == {(0, 1, 2), (5, 6, 7)}
    assert len({tuple(order) for order in orders}) > 10
    for order in orders:
        places = np.argsort(order)
        assert places[:3].max() < places[3:5].min(), "a block behind another of its shard comes behind it"


@pytest.mark.parametrize(
    ("place", "said"),
    [
        ("pipe:cat '{folder}'/none-00000.tar", "its command ended with 1"),
        ("pipe:head -c 9000 '{folder}'/train-00000.tar", "shard (is damaged|ends)"),
        ("pipe:echo no # train-00000.tar", "shard is damaged"),
        ("pipe:cat '{folder}'/train", "has no name like"),
        ("{url}/train-00009.tar", "404"),
        ("http://127.0.0.1:9/train-00000.tar", "cannot read: .*refused"),
        ("pipe:cat '{folder}'/{{a,b}}/train-00000.tar", "named twice"),
    ],
)
def test_a_stream_that_cannot_be_read_is_one_line(folder, server, place, said):
    with pytest.raises(TronError, match=said):
        Splits(place.format(folder=folder, url=server[0]))


def test_damage_in_a_stream_costs_what_lies_behind_it(folder, tmp_path, small_blocks):
    shutil.copytree(folder, copy := tmp_path / "copy")
    shard = copy / "train-00000.tar"
    shard.write_bytes(shard.read_bytes()[: shard.stat().st_size // 2])
    clips = streaming.StreamedClips(
        f"pipe:cat '{copy}'/train-{{00000..00001}}.tar",
        "train",
        manifest=Splits(folder)._manifests[str(folder)],
    )
    assert clips.read_frames(0, [0], BUFFERS).meta.key == clips.key(0)
    with pytest.raises(TronError, match="shard"):
        clips.read_frames(5, [0], BUFFERS)
    assert clips.read_frames(6, [0], BUFFERS).meta.key == clips.key(6)
    split = IndexedSplit(clips, "train", BUFFERS, 0)
    assert len(take(Batches(STAGE, {"train": split}, BUFFERS, DataSettings(), 0), 5)) == 5, "others stand in"


def test_the_command_trains_over_http_and_goes_on(make_settings, folder, server, tmp_path):
    stages = [{"name": "one", "split": "train", "steps": 6, "batch_size": 2, "crop": 16}]

    def train(name: str, **changes) -> dict[str, torch.Tensor]:
        output = tmp_path / name
        data = {"cache_gb": 0}
        main(Settings.model_validate(make_settings(server[0], output, stages=stages, data=data, **changes)))
        return load_file(output / "renderer.safetensors")

    assert manifest_hash(server[0]) == manifest_hash(folder)
    whole = train("whole")
    with pytest.raises(KeyboardInterrupt):
        _interrupted(3, partial(train, "halved"))
    halved = train("halved")
    assert all(torch.equal(whole[key], halved[key]) for key in whole)


def _interrupted(step: int, run) -> None:
    """Run until batch number `step` is asked for."""
    original, count = Batches._batch, itertools.count()

    def batch(self, number):
        if next(count) == step:
            raise KeyboardInterrupt
        return original(self, number)

    Batches._batch = batch  # type: ignore[method-assign]
    try:
        run()
    finally:
        Batches._batch = original  # type: ignore[method-assign]
