"""tron-export from end to end: a scene packed and read back, and what is refused."""

import re
from pathlib import Path

import numpy as np
import pytest

from tron.apps.export import cli
from tron.gaussians.edit import KERNEL_WIDTHS
from tron.gaussians.scene import GaussianScene


def export(*words: str) -> int:
    with pytest.raises(SystemExit) as stop:
        cli(list(words))
    return int(stop.value.code or 0)


@pytest.mark.parametrize("suffix", [".ply", ".spz"])
def test_a_scene_leaves_and_comes_back(tmp_path: Path, ball_on_floor, suffix):
    scene = ball_on_floor()
    scene.save(tmp_path / "a.ply")
    assert export(f"scene={tmp_path}/a.ply", f"output={tmp_path}/b{suffix}") == 0
    found = GaussianScene.load(tmp_path / f"b{suffix}")
    np.testing.assert_allclose(found.means, scene.means, atol=2e-3)
    assert found.kernel_degree == 2
    wider = np.median(found.log_scales - scene.log_scales)
    assert wider == pytest.approx(np.log(KERNEL_WIDTHS), abs=0.05)


@pytest.mark.parametrize(
    ("name", "more", "words"),
    [("b.stl", [], ".spz"), ("b.spz", ["kind=points"], ".ply"), ("b.ply", ["kind=mesh"], ".glb, .usdz")],
)
def test_a_name_that_says_no_format_is_one_line(tmp_path: Path, ball_on_floor, capsys, name, more, words):
    ball_on_floor().save(tmp_path / "a.ply")
    assert export(f"scene={tmp_path}/a.ply", f"output={tmp_path}/{name}", *more) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("tron-export: ")]
    assert words in line
    assert not (tmp_path / name).exists()


def test_points_and_splats_of_a_kind(tmp_path: Path, ball_on_floor):
    scene = ball_on_floor()
    scene.save(tmp_path / "a.ply")
    assert export(f"scene={tmp_path}/a.ply", f"output={tmp_path}/b.glb", "kind=splats") == 0
    assert len(GaussianScene.load(tmp_path / "b.glb")) == len(scene)
    assert export(f"scene={tmp_path}/a.ply", f"output={tmp_path}/b.ply", "kind=points") == 0
    assert b"property uchar red" in (tmp_path / "b.ply").read_bytes()[:500]


def test_every_long_part_of_a_mesh_has_a_share(tmp_path: Path, ball_on_floor, caplog, variant, monkeypatch):
    """A part that is one piece would be a name alone, minutes long."""
    caplog.set_level("INFO")
    monkeypatch.setattr("tron.meshing.surface.VIEWS", 24)
    monkeypatch.setattr("tron.meshing.surface.SIDE", 128)
    ball_on_floor(0.15).save(tmp_path / "a.ply")
    words = ["texture=64", "triangles=2000", f"variant={variant}"]
    assert export(f"scene={tmp_path}/a.ply", f"output={tmp_path}/b.glb", *words) == 0
    parts = dict(re.findall(r"^(.+): 0 of (\d+)$", "\n".join(caplog.messages), re.MULTILINE))
    assert list(parts) == ["surface", "cutting the surface", "textures"]
    assert int(parts["surface"]) > 10
