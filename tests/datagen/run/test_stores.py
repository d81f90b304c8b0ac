"""A dataset in an object store: a real S3 server of this machine, through the code that users run."""

import socket
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import torch

from datagen.run.dataset import make
from datagen.run.merge import merge
from datagen.run.validate import validate
from datagen.settings.command import Settings
from eval.relighting.benchmark import Relighting
from train.curriculum import Stage
from train.examples.data import TrainingData
from train.settings import DataSettings, ValidationSettings
from tron.cameras import Camera
from tron.cli.recipes import check, compose_recipe
from tron.errors import TronError
from tron.seeds import generator
from tron.shards.dataset_folder import DatasetFolder
from tron.shards.manifest import Manifest
from tron.shards.reader import read_clips, verify
from tron.shards.schema import MEMBERS, ClipMeta, clip_members
from tron.shards.writer import ShardWriter

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.long]


def stored(tiny_scenes, output: Path, url: str, *more: str) -> Settings:
    recipe = [*tiny_scenes, "cluster=none", f"output_dir={output}", f"store='{url}'", *more]
    return check(compose_recipe("conf.datagen", Settings, recipe), Settings)


@pytest.fixture
def bucket(s3_server) -> str:
    return s3_server.bucket()


def test_shards_leave_for_the_store_and_are_read_there(
    tiny_scenes, tiny_dataset, bucket, s3_server, files_of, tmp_path
):
    local, output, url = tiny_dataset, tmp_path / "out", f"{bucket}/set"
    assert make(stored(tiny_scenes, output, url)) == 0
    assert not list(output.glob("*.tar"))
    here = files_of(local)
    assert files_of(output) == {
        name: data for name, data in here.items() if not name.endswith((".tar", ".idx"))
    }
    for name, data in files_of(output).items():
        assert bucket.encode() not in data, name
        assert b"tron-test-secret" not in data, name
    there = DatasetFolder(url)
    for name, data in here.items():
        if not name.startswith("scenes/"):
            assert there.read(name) == data, name
    assert verify(url) == []
    assert validate(output, store=url) == 0
    assert Manifest.load(url) == Manifest.load(local)
    for a, b in zip(read_clips(url, "train"), read_clips(local, "train"), strict=True):
        assert a.meta == b.meta
        assert all((a.frames[name] == b.frames[name]).all() for name in b.frames)
    before = s3_server.times(url)
    assert make(stored(tiny_scenes, output, url)) == 0
    after = s3_server.times(url)
    assert all(after[name] == before[name] for name in before if name.endswith(".tar")), "sent once"


def test_what_the_store_lost_is_made_again_and_damage_is_told(tiny_scenes, bucket, s3_server, tmp_path):
    output, url = tmp_path / "out", f"{bucket}/set"
    assert make(stored(tiny_scenes, output, url)) == 0
    entry = Manifest.load(url).shards[0]
    whole = DatasetFolder(url).read(entry.name)
    s3_server.write(f"{url}/{entry.name}", whole[:600] + bytes([whole[600] ^ 1]) + whole[601:])
    assert any("sha256 differs" in problem for problem in verify(url))
    assert validate(output, store=url) > 0
    s3_server.write(f"{url}/{entry.name}", whole[:1024])
    assert any("1024 bytes, should be" in problem for problem in verify(url))
    assert make(stored(tiny_scenes, output, url)) == 0
    assert verify(url) == []


def test_a_store_that_cannot_be_written_is_told_before_the_first_scene(tiny_scenes, s3_server, tmp_path):
    output = tmp_path / "out"
    for url, message in (("s3://tron-no-such-bucket/set", "cannot write"), ("nosuch://a/b", "cannot open")):
        with pytest.raises(TronError, match=message):
            make(stored(tiny_scenes, output, url))
        assert not output.exists()
    with pytest.raises(TronError, match="store"):
        stored(tiny_scenes, output, "bucket/set")


def test_a_server_that_goes_away_ends_the_run_which_then_goes_on(
    tiny_scenes, bucket, s3_server, tmp_path, monkeypatch
):
    output, url = tmp_path / "out", f"{bucket}/set"
    real = DatasetFolder.put

    def gone(self: DatasetFolder, path: Path, name: str) -> None:
        if name.endswith("train-00001.tar"):
            s3_server.stop()
        real(self, path, name)

    monkeypatch.setattr(DatasetFolder, "put", gone)
    with pytest.raises(TronError, match=r"cannot write: .*train-00001.tar"):
        make(stored(tiny_scenes, output, url))
    assert [path.name for path in output.glob("*.tar")] == ["train-00001.tar"], "it waits, whole"
    monkeypatch.setattr(DatasetFolder, "put", real)
    s3_server.start()
    s3_server.bucket(bucket)
    record = (output / "scenes/train-000001/record.json").stat().st_mtime_ns
    assert make(stored(tiny_scenes, output, url)) == 0
    assert verify(url) == []
    assert (output / "scenes/train-000001/record.json").stat().st_mtime_ns == record, "not made again"


def test_parts_go_to_one_store_and_merge_there(tiny_scenes, bucket, tmp_path):
    url, parts = f"{bucket}/set", [tmp_path / "1", tmp_path / "2"]
    for number, part in enumerate(parts, start=1):
        assert make(stored(tiny_scenes, part, url, f"shard={number}/2")) == 0
    assert "manifest.json" not in DatasetFolder(url).sizes()
    output = tmp_path / "out"
    assert merge(stored(tiny_scenes, output, url, "mode=merge", f"merge=[{parts[0]},{parts[1]}]")) == 0
    assert verify(url) == []
    assert not list(output.glob("*.tar"))
    assert Manifest.load(url) == Manifest.load(output)


def write_clips(folder: Path) -> None:
    """Four clips of five frames, 16 x 16, each a shard of its own."""
    with ShardWriter(folder, "train", samples_per_shard=1) as writer:
        for clip in range(4):
            name, rng = f"clip{clip:03d}", generator(3, "stores", clip)
            meta = ClipMeta(
                **dict.fromkeys(("key", "scene"), name),
                **{
                    "light": "l0",
                    "light_family": "studio",
                    "split": "train",
                    "frames": 5,
                    "width": 16,
                    "height": 16,
                },
                cameras=[
                    Camera.look_at((0, -4, n), (0, 0, 0), fov_deg=35, width=16, height=16).to_dict()
                    for n in range(5)
                ],
                exposure=1.0,
                color_space={},
            )
            members = clip_members(reference=False)
            shapes = {each: (16, 16, MEMBERS[each].channels) for each in members}
            writer.write(
                meta,
                [{each: rng.random(shape, np.float32) for each, shape in shapes.items()} for _ in range(5)],
            )
    Manifest(shards=writer.entries).save(folder)


def test_loader_processes_train_from_the_store(bucket, s3_server, tmp_path):
    local, url = tmp_path / "clips", f"{bucket}/clips"
    write_clips(local)
    for path in local.iterdir():
        s3_server.write(f"{url}/{path.name}", path.read_bytes())
    stage = Stage(name="one", split="train", steps=4, batch_size=1)
    found = []
    for place, workers in ((local, 0), (url, 2)):
        data = TrainingData(place, DataSettings(cache_gb=0, workers=workers), 7, ValidationSettings())
        data.open([stage])  # reads the first shard in this process: its connections are not the loaders'
        data.begin(stage, 0)
        found.append(list(islice(data.train_dataloader(), 4)))
    for here, there in zip(*found, strict=True):
        torch.testing.assert_close(there, here, rtol=0, atol=0)


def test_baselines_may_be_fitted_on_a_dataset_in_a_store(bucket):
    assert Relighting(dataset=None, fitted_on=f"{bucket}/set").fitted_on == f"{bucket}/set"


def test_a_closed_port_is_one_line(tiny_scenes, tmp_path, monkeypatch, s3_server):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    s3_server.point_to(f"http://127.0.0.1:{port}", monkeypatch)
    with pytest.raises(TronError) as caught:
        make(stored(tiny_scenes, tmp_path / "out", "s3://bucket/set"))
    assert "\n" not in str(caught.value)
