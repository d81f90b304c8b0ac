"""Packed splats: what PlayCanvas' splat-transform made of two real scans, round trips, and damaged files."""

import gzip
import json
import shutil
import subprocess
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import plyfile
import pytest
from scipy.spatial import KDTree

from tron.errors import TronError
from tron.gaussians import splat_files
from tron.gaussians.formats.packed import packed
from tron.gaussians.formats.registry import PACKED
from tron.gaussians.formats.spz import BITS, HALF_TURN, refined
from tron.gaussians.harmonics import eval_sh, spread_directions
from tron.gaussians.scene import GaussianScene
from tron.gaussians.splat_files import write_splats


@pytest.mark.parametrize(
    ("packed", "plain", "exact"),
    [
        ("biker.spz", "biker.ply", False),
        ("biker.compressed.ply", "biker.ply", True),
        ("guitar.compressed.ply", "guitar.ply", True),
    ],
)
def test_real_scans_are_what_their_maker_unpacks(shared_data, packed, plain, exact):
    found, wanted = (GaussianScene.load(shared_data / "splats" / name) for name in (packed, plain))
    assert len(found) == len(wanted)
    np.testing.assert_array_equal(found.up, wanted.up)
    np.testing.assert_allclose(found.means, wanted.means, atol=2e-4)  # .spz: fixed point of 12 bits
    np.testing.assert_allclose(found.sh, wanted.sh, atol=1e-5 if exact else 0.02)
    scales = np.abs(found.log_scales - wanted.log_scales)  # in .spz steps of 1/16, where splats are flat
    assert (scales.max() if exact else np.quantile(scales, 0.99)) < (1e-5 if exact else 0.04)
    facing = np.abs((found.normals() * wanted.normals()).sum(1))
    assert np.median(facing) > 0.9999


def arranged(random_scene) -> GaussianScene:
    """Splats of which every other is opaque, as of a plain file: its kernel, no materials."""
    scene = random_scene(500, kernel_degree=2, up=np.array([0.0, -1, 0]))
    scene.opacity_logits[::2] = 4
    return scene


@pytest.mark.parametrize("suffix", PACKED)
def test_round_trips_keep_what_formats_hold(random_scene, tmp_path, suffix):
    scene = arranged(random_scene)
    path = tmp_path / f"a{suffix}"
    write_splats(path, scene)
    plain = tmp_path / "a.ply"
    write_splats(plain, scene)
    assert path.stat().st_size < plain.stat().st_size
    found = GaussianScene.load(path)
    assert len(found) == len(scene)
    # Some writers sort the splats: the nearest is meant.
    nearest = ((found.means[:, None] - scene.means) ** 2).sum(-1).argmin(1)
    assert len(set(nearest)) == len(scene)
    wanted = {name: getattr(scene, name)[nearest] for name in ("means", "sh", "log_scales")}
    np.testing.assert_allclose(found.means, wanted["means"], atol=2e-3)
    sizes = np.sort(found.log_scales, axis=1), np.sort(wanted["log_scales"], axis=1)
    np.testing.assert_allclose(sizes[0], sizes[1], atol=0.1)
    thick = np.isfinite(scene.log_thickness[nearest])
    wanted["log_thickness"] = scene.log_thickness[nearest]
    np.testing.assert_allclose(found.log_thickness[thick], wanted["log_thickness"][thick], atol=0.1)
    assert (found.log_thickness < found.log_scales.min(1) - 5)[~thick].all()
    assert np.median(np.abs((found.normals() * scene.normals()[nearest]).sum(1))) > 0.99
    for direction in spread_directions(6):
        seen = np.broadcast_to(direction, found.means.shape)
        degree = 0 if suffix == ".splat" else 3
        of_degree = wanted["sh"] * (np.arange(16) < (degree + 1) ** 2)[:, None]
        error = np.abs(eval_sh(found.sh, seen) - eval_sh(of_degree, seen))
        assert error.mean() < (0.04 if suffix == ".spz" else 0.02)  # colours of 0.1 in the mean


@pytest.mark.parametrize("size", [1e-3, 1.0, 3e3, 1e5])
def test_spz_keeps_places_and_harmonics_of_any_scene(random_scene, tmp_path, size):
    """gaussforge itself rounds harmonics to sixteenths and eighths, and wraps places beyond 2,048."""
    plain = arranged(random_scene)
    scene = replace(plain, means=plain.means * np.float32(size))
    for each in (scene.log_scales, scene.log_thickness):
        each += min(0, np.log(np.float32(size)))
    write_splats(tmp_path / "a.spz", scene)
    found, wanted = GaussianScene.load(tmp_path / "a.spz").rotated(HALF_TURN), scene.rotated(HALF_TURN)
    farthest = float(np.abs(wanted.means).max())
    steps = max(farthest * 2.0**-22, min(2.0**-12, max(farthest * 2.0**-12, 2.0**-20)))
    assert np.abs(found.means - wanted.means).max() < 0.51 * steps
    assert np.abs(found.sh - wanted.sh)[:, 1:].max() < 0.5 / 2 ** (BITS - 1) + 1 / 256 + 1e-6
    write_splats(tmp_path / "a.ply", wanted)
    coarse = packed((tmp_path / "a.ply").read_bytes(), "spz")
    fine, before = (gzip.decompress(each) for each in ((tmp_path / "a.spz").read_bytes(), coarse))
    others = slice(16 + 9 * len(scene), len(fine) - 45 * len(scene))
    assert fine[others] == before[others]
    assert (fine[:13], fine[14:16]) == (before[:13], before[14:16])  # all but the fractional bits
    steps = [np.frombuffer(each[others.stop :], np.uint8).astype(int) for each in (fine, before)]
    assert np.abs(steps[0] - steps[1]).max() <= 8 + 2  # the same splats in the same order


@pytest.mark.parametrize("suffix", [".spz", ".sog"])
def test_colours_that_do_not_change_with_the_view_have_no_harmonics_in_the_file(
    random_scene, tmp_path, suffix
):
    scene = arranged(random_scene)
    scene = replace(scene, sh=scene.sh * (np.arange(16) == 0)[:, None].astype(np.float32))
    write_splats(tmp_path / f"a{suffix}", scene)
    found = GaussianScene.load(tmp_path / f"a{suffix}")
    assert np.abs(found.sh[:, 1:]).max() < 1e-12  # turned from the file's frame
    nearest = KDTree(scene.means).query(found.means)[1]
    assert np.abs(found.sh[:, 0] - scene.sh[nearest, 0]).max() < 0.05
    assert (tmp_path / f"a{suffix}").stat().st_size < 24 * len(scene) + 30_000


def test_a_sog_of_more_splats_than_its_packer_takes_is_one_line(random_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(splat_files, "MOST_SOG", 499)
    with pytest.raises(TronError, match="500 splats with harmonics") as told:
        write_splats(tmp_path / "a.sog", arranged(random_scene))
    assert "splat-transform" in str(told.value)
    assert not list(tmp_path.iterdir())


def test_what_spz_cannot_hold_is_one_line(random_scene, tmp_path):
    scene = arranged(random_scene)
    with pytest.raises(TronError, match="no place as far out"):
        write_splats(tmp_path / "a.spz", replace(scene, means=scene.means * np.float32(1e8)))
    content = packed(_plain_file(scene, tmp_path), "spz")
    with pytest.raises(TronError, match="not known here"):
        refined(content, scene.means[:-1], scene.sh[:-1])
    assert not (tmp_path / "a.spz").exists()


def _plain_file(scene: GaussianScene, folder: Path) -> bytes:
    write_splats(folder / "plain.ply", scene)
    return (folder / "plain.ply").read_bytes()


@pytest.mark.skipif(
    shutil.which("splat-transform") is None, reason="npm install -g @playcanvas/splat-transform"
)
@pytest.mark.parametrize("suffix", PACKED)
def test_another_reader_sees_the_same(random_scene, tmp_path, suffix):
    scene = arranged(random_scene)
    write_splats(tmp_path / f"a{suffix}", scene)
    subprocess.run(
        ["splat-transform", "-w", tmp_path / f"a{suffix}", tmp_path / "b.ply"],
        check=True,
        capture_output=True,
    )
    rows = plyfile.PlyData.read(str(tmp_path / "b.ply"))["vertex"]
    found = np.stack([rows[axis] for axis in "xyz"], 1)
    away = np.sqrt(((found[:, None] - scene.means) ** 2).sum(-1))
    assert away.min(1).max() < 2e-3
    for n in range(0 if suffix == ".splat" else 45):  # channel by channel in files
        wanted = scene.sh[away.argmin(1), 1 + n % 15, n // 15]
        assert np.abs(rows[f"f_rest_{n}"] - wanted).mean() < (0.04 if suffix == ".spz" else 0.02)


def test_the_frame_of_spz_is_a_half_turn_away(random_scene, tmp_path):
    """The file itself holds y up; splats of degree 3 come back as they were, so harmonics turn with it."""
    scene = arranged(random_scene)
    write_splats(tmp_path / "a.spz", scene)
    from gaussforge import GaussForge

    raw = GaussForge().convert((tmp_path / "a.spz").read_bytes(), "spz", "ply")["data"]
    (tmp_path / "raw.ply").write_bytes(raw)
    rows = plyfile.PlyData.read(str(tmp_path / "raw.ply"))["vertex"]
    held = np.stack([rows[axis] for axis in "xyz"], 1)
    np.testing.assert_allclose(held, scene.means @ HALF_TURN, atol=2e-3)


@pytest.mark.parametrize("suffix", PACKED)
def test_damaged_files_cost_a_line(random_scene, tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    write_splats(path, arranged(random_scene))
    content = path.read_bytes()
    for damaged in (b"", content[:3], content[: len(content) // 2 + 1], b"no splats at all, but some text"):
        path.write_bytes(damaged)
        with pytest.raises(TronError) as refusal:
            GaussianScene.load(path)
        assert str(path) in str(refusal.value)
        assert "\n" not in str(refusal.value)


def absent(content: bytes) -> bytes:
    return content.replace(b"quats.webp", b"other.webp")


def billions(content: bytes) -> bytes:
    return json.dumps(json.loads(content) | {"count": 2_000_000_000}).encode()


@pytest.mark.parametrize(("change", "words"), [(absent, "signal"), (billions, "alloc")])
def test_a_reader_that_crashes_or_asks_for_all_memory_costs_a_line(random_scene, tmp_path, change, words):
    """gaussforge 0.6 ends with a signal where a picture is missing, and believes any number of splats."""
    whole, path = tmp_path / "whole.sog", tmp_path / "a.sog"
    write_splats(whole, arranged(random_scene))
    with zipfile.ZipFile(whole) as read, zipfile.ZipFile(path, "w") as written:
        for name in read.namelist():
            content = read.read(name)
            written.writestr(name, change(content) if name == "meta.json" else content)
    with pytest.raises(TronError, match=f"cannot be read as PlayCanvas's.*{words}"):
        GaussianScene.load(path)
