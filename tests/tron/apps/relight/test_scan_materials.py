"""Materials of a plain scan: found once, kept beside it, and used for what they are of."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tron.gaussians.kept import KeptFiles
from tron.gaussians.scene import GaussianScene
from tron.relighting.proxy import Proxy, fingerprint
from tron.scans import Scan
from tron.scans import materials as scan_materials
from tron.scans.materials import with_materials

CARRY = "tron.reconstruction.materials.carried.carry_materials"


def beside(folder: Path) -> KeptFiles:
    return KeptFiles(folder / "scan.ply", folder / "out")


@pytest.fixture
def plain(ball_on_floor) -> GaussianScene:
    scene = ball_on_floor(0.2)
    return replace(scene, base_color=np.full((len(scene), 3), 0.5), materials_guessed=True, oriented=False)


@pytest.fixture
def asked(variant, monkeypatch) -> list[int]:
    """How often materials were looked for; green ones are found."""
    found = []

    def carry(capture, settings, seed, track):
        found.append(len(capture.views))
        scan = capture.scan
        green = np.tile(np.array([0.1, 0.6, 0.1], np.float32), (len(scan), 1))
        scene = replace(scan, base_color=green, roughness=np.full(len(scan), 0.25), materials_guessed=False)
        return SimpleNamespace(scene=scene, proxy=Proxy(replace(scene, oriented=True), 0.1))

    monkeypatch.setattr(CARRY, carry)
    monkeypatch.setattr(scan_materials, "VIEWS", 4)
    monkeypatch.setattr(scan_materials, "SIDE", 16)
    return found


def test_materials_are_found_once_and_kept_until_the_scan_changes(asked, plain, tmp_path, caplog):
    caplog.set_level("INFO")
    first, again = (with_materials(plain, beside(tmp_path), None, 0) for _ in range(2))
    assert asked == [4]
    for scene in (first, again):
        np.testing.assert_array_equal(scene.base_color[:, 1], np.float32(0.6))
        np.testing.assert_array_equal(scene.roughness, np.float32(0.25))
        np.testing.assert_array_equal(scene.means, plain.means)
        np.testing.assert_array_equal(scene.quats, plain.quats)
        assert not scene.materials_guessed
    assert any("scan.materials.ply; materials=as_is leaves them out" in line for line in caplog.messages)
    assert len(GaussianScene.load(tmp_path / "scan.materials.ply")) == len(plain)
    with_materials(replace(plain, means=plain.means + np.float32(0.1)), beside(tmp_path), None, 0)
    assert asked == [4, 4]


def test_what_is_kept_stands_as_the_scan_does(asked, plain, tmp_path):
    """Cameras and edits of one are right for the other."""
    lying = plain.rotated(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]))
    turn = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    scene = with_materials(lying.rotated(turn), beside(tmp_path), None, 0, None, turn)
    kept = GaussianScene.load(tmp_path / "scan.materials.ply")
    np.testing.assert_allclose(kept.means, lying.means, atol=1e-5)
    np.testing.assert_allclose(kept.up, lying.up, atol=1e-6)
    np.testing.assert_array_equal(kept.base_color, scene.base_color)
    np.testing.assert_allclose(scene.up, [0, 0, 1], atol=1e-6)


def test_the_proxy_that_they_were_found_on_is_the_one_that_light_sees(asked, plain, tmp_path, caplog):
    from tron.relighting import Relighter

    scene = with_materials(plain, beside(tmp_path), None, 0)
    caplog.set_level("INFO")
    assert Relighter(scene, proxy="always", proxy_file=tmp_path / "scan.proxy.ply").proxy is not None
    assert any("light sees the proxy of" in line for line in caplog.messages)


def test_a_backdrop_stays_as_it_is(asked, plain, tmp_path):
    backdrop = np.arange(len(plain)) % 7 == 0
    scene = with_materials(plain, beside(tmp_path), None, 0, backdrop)
    np.testing.assert_array_equal(scene.base_color[backdrop], plain.base_color[backdrop])
    np.testing.assert_array_equal(scene.base_color[~backdrop, 1], np.float32(0.6))


def test_where_no_folder_takes_files_nothing_stops(asked, plain, tmp_path, caplog):
    caplog.set_level("INFO")
    (tmp_path / "file").write_text("no folder")
    kept = KeptFiles(tmp_path / "file" / "scan.ply", tmp_path / "file" / "out")
    assert not with_materials(plain, kept, None, 0).materials_guessed
    assert any("materials are not kept" in line for line in caplog.messages)


def test_a_folder_that_takes_no_files_has_them_in_the_output(asked, plain, tmp_path, caplog):
    """One line says so, and the next run finds them there."""
    from tron.relighting import Relighter

    caplog.set_level("INFO")
    (tmp_path / "file").write_text("no folder")
    path, out = tmp_path / "file" / "scan.ply", tmp_path / "out"
    for _ in range(2):
        kept = KeptFiles(path, out)
        scene = with_materials(plain, kept, None, 0)
        assert (
            Relighter(scene, proxy="always", proxy_file=kept.path("proxy", fingerprint(scene, None))).proxy
            is not None
        )
    assert asked == [4]
    assert sorted(file.name for file in out.iterdir()) == ["scan.materials.ply", "scan.proxy.ply"]
    assert sum("cannot be written" in line for line in caplog.messages) == 1
    assert (
        sum(f"light sees the proxy of {out / 'scan.proxy.ply'}" in line for line in caplog.messages) == 1 + 1
    )


def test_what_lies_beside_is_taken_before_what_lies_apart(asked, plain, tmp_path):
    apart = KeptFiles(tmp_path / "none" / "scan.ply", tmp_path)  # that folder is not there
    with_materials(plain, apart, None, 0)
    assert beside(tmp_path).path("proxy", "other") == tmp_path / "scan.proxy.ply"
    with_materials(plain, beside(tmp_path), None, 0)
    assert asked == [4]


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="no folder that refuses root's files too")
def test_tron_relight_keeps_them_in_its_output(asked, plain, tmp_path, light_path, relight, caplog):
    """The scan lies where nobody may make a file, root included."""
    plain.save(tmp_path / "scan.ply")
    with open(tmp_path / "scan.ply", "rb") as scan:
        path = f"/proc/self/fd/{scan.fileno()}"
        words = [f"scene={path}", f"environment={light_path}", "proxy=always", "bounces=0", "frames=1"]
        for _ in range(2):
            assert relight(*words, f"output_dir={tmp_path / 'out'}", "checkpoint=null") == 0
    assert len(asked) == 1
    kept = {file.suffixes[0] for file in (tmp_path / "out").glob("*.ply")}
    assert kept == {".materials", ".proxy"}


def test_where_none_can_be_told_the_scan_is_as_it_is(asked, plain, tmp_path, monkeypatch):
    monkeypatch.setattr(CARRY, lambda *_: None)
    assert with_materials(plain, beside(tmp_path), None, 0) is plain
    assert not list(tmp_path.iterdir())


def test_without_the_libraries_of_the_fit_the_scan_is_as_it_is(plain, tmp_path, monkeypatch, variant, caplog):
    monkeypatch.setattr("tron.cli.installation.missing_libraries", lambda extra: ["torch"])
    assert with_materials(plain, beside(tmp_path), None, 0) is plain
    assert "needs torch: pip install 'tron-relight[reconstruct]'" in caplog.text


def test_materials_are_those_of_the_scan_in_its_file(asked, plain, tmp_path):
    plain.rotated(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])).save(tmp_path / "scan.ply")
    scan = Scan.open(tmp_path / "scan.ply")
    assert asked == []
    for found in (scan.in_file, Scan.open(tmp_path / "scan.ply").in_file):
        np.testing.assert_array_equal(found.base_color[:, 1], np.float32(0.6))
        np.testing.assert_array_equal(found.means, scan.loaded.means)
        assert not found.materials_guessed
    assert asked == [4]
    assert Scan.open(tmp_path / "scan.ply", materials="as_is").in_file.materials_guessed


@pytest.mark.parametrize("treatment", ["drop", "background"])
def test_what_surrounds_a_scan_keeps_its_own_in_the_file(asked, plain, tmp_path, monkeypatch, treatment):
    plain.save(tmp_path / "scan.ply")
    around = np.arange(len(plain)) % 7 == 0
    monkeypatch.setattr("tron.tracing.surroundings.find_surroundings", lambda scene: around)
    scan = Scan.open(tmp_path / "scan.ply", surroundings=treatment)
    np.testing.assert_array_equal(scan.in_file.base_color[~around, 1], np.float32(0.6))
    np.testing.assert_array_equal(scan.in_file.base_color[around], scan.loaded.base_color[around])
    assert len(scan.scene) == (len(plain) if treatment == "background" else (~around).sum())


def test_kept_ones_are_taken_and_none_are_looked_for(asked, plain, tmp_path, caplog):
    """As tron-view opens a scan: at once."""
    assert with_materials(plain, beside(tmp_path), None, 0, find=False) is plain
    assert not asked
    assert "by materials=auto, or a button of tron-view" in caplog.text
    found = with_materials(plain, beside(tmp_path), None, 0)
    kept = with_materials(plain, beside(tmp_path), None, 0, find=False)
    np.testing.assert_array_equal(kept.base_color, found.base_color)
    assert not kept.materials_guessed
    assert len(asked) == 1
