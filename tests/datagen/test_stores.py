"""A dataset in an object store: a real S3 server of this machine, through the code that users run."""

import socket
from pathlib import Path

import pytest

from datagen.merge import merge
from datagen.run import make
from datagen.settings import Settings
from datagen.validate import validate
from tron.cli.recipes import check, compose_recipe
from tron.dataset_folder import DatasetFolder
from tron.errors import TronError
from tron.shards.manifest import Manifest
from tron.shards.reader import read_clips
from tron.shards.verify import verify

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.long]


def stored(tiny_scenes, output: Path, url: str, *more: str) -> Settings:
    recipe = [*tiny_scenes, "cluster=none", f"output_dir={output}", f"store='{url}'", *more]
    return check(compose_recipe("conf.datagen", Settings, recipe), Settings)


@pytest.fixture
def bucket(s3_server) -> str:
    return s3_server.bucket()


def test_shards_leave_for_the_store_and_are_read_there(tiny_scenes, bucket, s3_server, files_of, tmp_path):
    local, output, url = tmp_path / "local", tmp_path / "out", f"{bucket}/set"
    recipe = [*tiny_scenes, "cluster=none", f"output_dir={local}"]
    assert make(check(compose_recipe("conf.datagen", Settings, recipe), Settings)) == 0
    assert make(stored(tiny_scenes, output, url)) == 0
    assert not list(output.glob("*.tar"))
    here = files_of(local)
    assert files_of(output) == {
        name: data for name, data in here.items() if not name.endswith((".tar", ".idx"))
    }
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


def test_credentials_and_the_store_are_in_no_file_of_the_dataset(tiny_scenes, bucket, files_of, tmp_path):
    output, url = tmp_path / "out", f"{bucket}/set"
    assert make(stored(tiny_scenes, output, url)) == 0
    for name, data in files_of(output).items():
        assert bucket.encode() not in data, name
        assert b"tron-test-secret" not in data, name


def test_a_closed_port_is_one_line(tiny_scenes, tmp_path, monkeypatch, s3_server):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    s3_server.point_to(f"http://127.0.0.1:{port}", monkeypatch)
    with pytest.raises(TronError) as caught:
        make(stored(tiny_scenes, tmp_path / "out", "s3://bucket/set"))
    assert "\n" not in str(caught.value)
