"""A dataset's folder behaves the same on a disk and in a store of fsspec's."""

from pathlib import Path

import fsspec
import pytest
from pydantic import TypeAdapter

from tron.errors import TronError
from tron.shards.dataset_folder import PROBE_NAME, DatasetFolder, DatasetPlace


@pytest.fixture(params=["disk", "memory"])
def folder(request, tmp_path) -> DatasetFolder:
    if request.param == "disk":
        return DatasetFolder(tmp_path / "set")
    fsspec.filesystem("memory").store.clear()
    return DatasetFolder("memory://set")


def test_what_is_put_is_read_listed_and_hashed(folder, tmp_path):
    source = tmp_path / "source"
    source.write_bytes(b"0123456789")
    folder.require_writable()
    folder.put(source, "a.tar")
    folder.put(source, "previews/b.png")
    assert folder.sizes() == {"a.tar": 10}, "no probe and no folder"
    assert folder.sizes("previews") == {"b.png": 10}
    assert folder.sizes("nothing") == {}
    assert folder.size("a.tar") == 10
    assert folder.size(PROBE_NAME) is None
    assert folder.read("a.tar", 2, 3) == b"234"
    assert folder.sha256("a.tar") == "84d89877f0d4041efb6bf91a16f0248f2fd573e6af05c19f96bedb9f882f7882"
    with pytest.raises(TronError, match="cannot read"):
        folder.read("b.tar")


def test_an_unknown_protocol_is_one_line():
    with pytest.raises(TronError, match="cannot open"):
        DatasetFolder("nosuch://bucket/set")


def test_a_folder_that_cannot_be_written_is_told(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(TronError, match="cannot write"):
        DatasetFolder(tmp_path / "file" / "set").require_writable()


@pytest.mark.parametrize("given, kept", [("a/b", Path("a/b")), ("s3://a//b", "s3://a//b")])
def test_a_setting_keeps_a_url_as_it_is(given, kept):
    assert TypeAdapter(DatasetPlace).validate_python(given) == kept
