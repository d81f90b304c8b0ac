"""What is known by sight: folders and archives around a scan, SOG folders, files that never came, photos."""

from __future__ import annotations

import io
import json
import shutil
import tarfile
import zipfile
from pathlib import Path

import cv2
import numpy as np
import plyfile
import pytest
from PIL import Image

from tron.apps.relight.cli import cli as relight
from tron.apps.splat_file import splat_file
from tron.captures import load_capture
from tron.captures.photos.photo_files import decode_photo, inspect_photo
from tron.errors import TronError
from tron.gaussians.formats.registry import check_header
from tron.gaussians.scene import GaussianScene
from tron.gaussians.splat_files import write_splats
from tron.models.load import load_model

FORMATS = (".ply", ".ply.gz", ".spz", ".sog", ".splat", ".ksplat", ".glb", ".gltf", ".usdz", ".usda", ".ckpt")
NEVER_CAME = {
    "Git LFS": b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345678\n",
    "a web page": b"\n<!DOCTYPE html>\n<html><head><title>Download</title></head></html>",
}


def splats(path: Path) -> Path:
    count = 12
    names = [*"xyz", *(f"f_dc_{k}" for k in range(3)), "opacity", *(f"scale_{k}" for k in range(3))]
    rows = np.zeros(count, [(name, "<f4") for name in [*names, *(f"rot_{k}" for k in range(4))]])
    rows["x"], rows["rot_0"] = np.arange(count), 1
    path.parent.mkdir(parents=True, exist_ok=True)
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")]).write(str(path))
    return path


def points(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = np.zeros(5, [(name, "<f4") for name in "xyz"])
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")]).write(str(path))
    return path


@pytest.mark.parametrize("kind", NEVER_CAME)
@pytest.mark.parametrize("suffix", FORMATS)
def test_a_file_that_never_came_is_called_that(tmp_path: Path, kind: str, suffix: str) -> None:
    path = tmp_path / f"scan{suffix}"
    path.write_bytes(NEVER_CAME[kind])
    with pytest.raises(TronError, match=kind):
        check_header(path)


@pytest.mark.parametrize("kind", NEVER_CAME)
@pytest.mark.parametrize("suffix", [".jpg", ".avif", ".tif", ".exr", ".heic"])
def test_a_photo_that_never_came_is_called_that(tmp_path: Path, kind: str, suffix: str) -> None:
    (tmp_path / f"a{suffix}").write_bytes(NEVER_CAME[kind])
    with pytest.raises(TronError, match=kind):
        inspect_photo(tmp_path / f"a{suffix}")


@pytest.mark.parametrize("kind", NEVER_CAME)
@pytest.mark.parametrize("suffix", [".glb", ".gltf", ".obj"])
def test_a_model_that_never_came_is_called_that(tmp_path: Path, kind: str, suffix: str) -> None:
    (tmp_path / f"a{suffix}").write_bytes(NEVER_CAME[kind])
    with pytest.raises(TronError, match=kind):
        load_model(tmp_path / f"a{suffix}")


@pytest.mark.parametrize(
    ("name", "words"),
    [("a.lcc", "XGRIDS.*splat-transform"), ("a.rad", "Spark.*spz"), ("a.psht", "Postshot.*PLY"),
     ("a.ksplat", "splat-transform")],
)  # fmt: skip
def test_splats_of_programs_that_are_not_read_have_a_way_out(tmp_path: Path, name: str, words: str) -> None:
    (tmp_path / name).write_bytes(b"\x07\x01\x02\x03" * 20)
    with pytest.raises(TronError, match=words):
        check_header(tmp_path / name)


def sog(folder: Path, scene: GaussianScene) -> Path:
    folder.mkdir(parents=True)
    write_splats(folder / "a.sog", scene)
    with zipfile.ZipFile(folder / "a.sog") as file:
        file.extractall(folder)
    (folder / "a.sog").unlink()
    return folder / "meta.json"


def scene_of(count: int, at: float, tmp_path: Path) -> GaussianScene:
    scene = GaussianScene.load(splats(tmp_path / "plain.ply"))
    scene.means = scene.means + np.float32(at)
    return scene


def test_the_finest_level_of_streamed_sog_is_read(tmp_path: Path) -> None:
    for name, at in (("0_0", 0.0), ("0_1", 100.0), ("1_0", 200.0), ("sky", 300.0)):
        sog(tmp_path / "scan" / name, scene_of(12, at, tmp_path))
    leaf = {"lods": {"1": {"file": 2, "offset": 0, "count": 5}, "0": {"file": 0, "offset": 2, "count": 4}}}
    other = {"lods": {"0": {"file": 1, "offset": 0, "count": 3}}}
    tree = {
        "lodLevels": 2, "filenames": [f"{name}/meta.json" for name in ("0_0", "0_1", "1_0")],
        "tree": {"children": [leaf, other]}, "environment": "sky/meta.json",
    }  # fmt: skip
    path = tmp_path / "scan" / "lod-meta.json"
    path.write_text(json.dumps(tree))
    assert splat_file(tmp_path / "scan") == path
    parts = (GaussianScene.load(path).means[:, 1] / 100).round() * 100
    assert dict(zip(*np.unique(parts, return_counts=True))) == {0: 4, 100: 3, 300: 12}
    # Of the first file rows 2 to 5 as they stand in it.
    own = GaussianScene.load(tmp_path / "scan/0_0/meta.json").means
    first = GaussianScene.load(path).means
    np.testing.assert_array_equal(first[first[:, 1] < 50], own[2:6])


@pytest.mark.parametrize(
    ("tree", "words"),
    [
        ({"filenames": ["../../secret/meta.json"], "tree": {}}, "outside of its folder"),
        ({"filenames": ["/etc/passwd"], "tree": {}}, "outside of its folder"),
        ({"filenames": ["gone/meta.json"], "tree": {}}, "missing"),
        ({"filenames": 3, "tree": {}}, "damaged"),
        ({"means": {"files": ["x.webp"]}, "quats": {}, "sh0": {}, "scales": {}}, "missing"),
        ({"frames": []}, "not SOG's"),
        ([1, 2], "not SOG's"),
    ],
)
def test_damaged_and_hostile_json_is_one_line(tmp_path: Path, tree: object, words: str) -> None:
    (tmp_path / "lod-meta.json").write_text(json.dumps(tree))
    with pytest.raises(TronError, match=words):
        check_header(tmp_path / "lod-meta.json")


def test_a_tree_that_names_more_than_there_is_is_one_line(tmp_path: Path) -> None:
    sog(tmp_path / "0_0", scene_of(12, 0, tmp_path))
    for tree in (
        {"lods": {"0": {"file": 0, "offset": 10, "count": 5}}},
        {"lods": {"0": {"file": 0, "offset": -3, "count": 5}}},
        {"lods": {"x": {"file": 0, "offset": 0, "count": 5}}},
    ):
        path = tmp_path / "lod-meta.json"
        path.write_text(json.dumps({"filenames": ["0_0/meta.json"], "tree": tree}))
        with pytest.raises(TronError):
            GaussianScene.load(path)


def test_a_folder_with_one_scan_is_that_scan(tmp_path: Path, caplog) -> None:
    scan = splats(tmp_path / "a" / "scan.ply")
    points(tmp_path / "a" / "points3D.ply")
    splats(tmp_path / "a" / "scan.proxy.ply")
    (tmp_path / "a" / "notes.txt").touch()
    caplog.set_level("INFO")
    assert splat_file(tmp_path / "a") == scan
    assert "its one file of splats is taken" in caplog.text
    assert splat_file(scan) == scan
    splats(tmp_path / "b" / "inner" / "scan.ply")
    assert splat_file(tmp_path / "b") == tmp_path / "b" / "inner" / "scan.ply"
    splats(tmp_path / "a" / "other.ply")
    with pytest.raises(TronError, match="holds 2 files of splats"):
        splat_file(tmp_path / "a")


def archive(path: Path, files: dict[str, bytes]) -> Path:
    if path.suffix == ".zip":
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
            for name, content in files.items():
                file.writestr(name, content)
    else:
        with tarfile.open(path, "w:gz") as file:
            for name, content in files.items():
                info = tarfile.TarInfo(name)
                info.size = len(content)
                file.addfile(info, io.BytesIO(content))
    return path


@pytest.mark.parametrize("suffix", [".zip", ".tar.gz"])
@pytest.mark.parametrize("inner", ["scan.ply", "made/scan.ply", "../../scan.ply", "/abs/scan.ply"])
def test_an_archive_with_one_scan_is_that_scan(tmp_path: Path, suffix: str, inner: str) -> None:
    """What leads out of the archive's folder lands in it all the same."""
    scan = splats(tmp_path / "far" / "plain.ply").read_bytes()
    holder = tmp_path / "given"
    holder.mkdir()
    path = archive(holder / f"a{suffix}", {inner: scan, "__MACOSX/scan.ply": b"x", "readme.txt": b"hello"})
    found = splat_file(path)
    assert found == holder / f"a{suffix}.unpacked" / "scan.ply"
    assert found.read_bytes() == scan
    kept = found.stat().st_mtime_ns
    assert splat_file(path).stat().st_mtime_ns == kept
    assert sorted(each.name for each in tmp_path.iterdir()) == ["far", "given"]


def test_archives_that_cannot_be_taken_are_one_line(tmp_path: Path, monkeypatch) -> None:
    two = archive(tmp_path / "two.zip", {"a.ply": b"ply", "b.spz": b"x"})
    with pytest.raises(TronError, match="holds 2 files"):
        splat_file(two)
    with pytest.raises(TronError, match="SOG in many files"):
        splat_file(archive(tmp_path / "sog.zip", {"a/meta.json": b"{}"}))
    none = archive(tmp_path / "none.zip", {"a.txt": b"ply"})
    assert splat_file(none) == none
    cut = tmp_path / "cut.tar.gz"
    cut.write_bytes(archive(tmp_path / "whole.tar.gz", {"a.ply": bytes(range(256)) * 99}).read_bytes()[:200])
    with pytest.raises(TronError, match="cannot be unpacked"):
        splat_file(cut)
    monkeypatch.setattr("tron.apps.splat_file._ALWAYS_ALLOWED", 1000)
    with pytest.raises(TronError, match="claims"):
        splat_file(archive(tmp_path / "bomb.zip", {"a.ply": bytes(1_000_000)}))
    assert not list(tmp_path.glob("*.unpacked"))


def test_the_command_takes_a_folder(tmp_path: Path, capsys) -> None:
    """It goes on to the next mistake, which is the light's."""
    splats(tmp_path / "a" / "scan.ply")
    with pytest.raises(SystemExit) as stop:
        relight(
            [f"scene={tmp_path / 'a'}", f"environment={tmp_path / 'no.hdr'}", f"output_dir={tmp_path / 'o'}"]
        )
    assert stop.value.code == 2
    assert "no.hdr" in capsys.readouterr().err


@pytest.mark.parametrize("suffix", [".DNG", ".cr3", ".NEF", ".arw"])
def test_raw_photos_alone_are_named(tmp_path: Path, suffix: str) -> None:
    for k in range(3):
        (tmp_path / f"{k}{suffix}").write_bytes(b"II*\0" + bytes(500))
    with pytest.raises(TronError, match=rf"raw photos \({suffix}\) are not read.*develop them"):
        load_capture(tmp_path)


def test_avif_is_read_in_its_colours(tmp_path: Path) -> None:
    rows = np.linspace(0, 255, 64).astype(np.uint8)
    given = np.stack(np.broadcast_arrays(rows[:, None], rows[None], np.uint8(99)), axis=-1)
    Image.fromarray(given).save(tmp_path / "a.avif", quality=95)
    header = inspect_photo(tmp_path / "a.avif")
    found = decode_photo(tmp_path / "a.avif", header)
    assert np.abs(found.astype(int) - given).mean() < 2
    wide = (tmp_path / "a.avif").read_bytes().replace(b"colrnclx\x00\x01", b"colrnclx\x00\x0c")  # Display P3
    (tmp_path / "b.avif").write_bytes(wide)
    header = inspect_photo(tmp_path / "b.avif")
    assert header.notes
    red = decode_photo(tmp_path / "b.avif", header)[-8, 8].astype(int)
    assert red[0] >= found[-8, 8, 0]
    assert red[1] < found[-8, 8, 1]  # sRGB needs less green for the same red
    (tmp_path / "c.avif").write_bytes(wide[: len(wide) // 2])
    with pytest.raises(TronError):
        inspect_photo(tmp_path / "c.avif")


@pytest.mark.parametrize("shape", [(8, 8), (8, 8, 3)])
def test_a_tiff_of_floats_is_named(tmp_path: Path, shape: tuple[int, ...]) -> None:
    cv2.imwrite(str(tmp_path / "a.tif"), np.zeros(shape, np.float32))
    with pytest.raises(TronError, match="floating-point"):
        inspect_photo(tmp_path / "a.tif")
    cv2.imwrite(str(tmp_path / "b.tif"), np.zeros(shape, np.uint16))
    assert inspect_photo(tmp_path / "b.tif").size(upright=True) == (8, 8)


def test_the_folders_of_the_field(shared_data: Path, tmp_path: Path) -> None:
    field = shared_data / "field"
    if not (field / "sog-unbundled").is_dir():
        pytest.skip(f"{field} is absent")
    streamed = GaussianScene.load(splat_file(field / "sog-unbundled"))
    assert len(streamed) == 1873
    plain = GaussianScene.load(splat_file(field / "sog-unbundled" / "6_0"))
    np.testing.assert_array_equal(np.sort(streamed.means, 0), np.sort(plain.means, 0))
    with pytest.raises(TronError, match="Git LFS"):
        check_header(field / "lfs-packed" / "lfs.splat")
    shutil.copytree(field / "raw-photos", tmp_path / "raw")
    with pytest.raises(TronError, match="raw photos"):
        load_capture(tmp_path / "raw")
    for path in (field / "photo-kinds").glob("*.avif"):
        same = Image.open(field / "georeferenced-capture" / "images" / f"{path.stem}.jpg")
        found = decode_photo(path, inspect_photo(path)).astype(int)
        assert np.abs(found - np.asarray(same)).mean() < 2
