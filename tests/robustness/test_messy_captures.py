"""Captures as people make them, through the command: what cannot be used is one line, the rest goes on."""

from __future__ import annotations

import json
import logging
import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tron.apps.reconstruct.cli import cli
from tron.cameras import Camera
from tron.gaussians import GaussianScene
from tron.io.video import VideoWriter
from tron.seeds import generator

SIZE, VIEWS = 24, 6
SHORT = (
    *(
        "steps_scaler=1",
        "radiance.steps=4",
        "materials.steps=1",
        "initial.count=60",
        "initial.stereo.planes=8",
    ),
    *("prior.light.steps=2", "prior.light.points=100", "prior.sun=1", "report.frames=0", "report.views=1"),
    *("threads=1", "output_dir=out"),
)


def camera(index: int) -> Camera:
    turn = 2 * math.pi * index / VIEWS
    eye = (3 * math.cos(turn), 3 * math.sin(turn), 0.7)
    return Camera.look_at(eye, (0, 0, 0), fov_deg=40, width=SIZE, height=SIZE)


def ball(camera: Camera, flat: bool) -> np.ndarray:
    """(H, W, 3) uint8: a painted ball of radius 0.7 before a dark room, or grey everywhere."""
    rays = camera.rays().astype(np.float64)
    along = -(rays @ camera.position)
    inside = 0.49 - (camera.position @ camera.position - along**2)
    points = camera.position + (along - np.sqrt(np.maximum(inside, 0)))[..., None] * rays
    paint = np.where((inside > 0)[..., None], 0.5 + 0.3 * np.sin(8 * points), 0.1)
    return np.round(255 * (np.full_like(paint, 0.5) if flat else paint)).astype(np.uint8)


def photograph(folder: Path, *, flat: bool = False) -> Path:
    """Six photos with poses as nerfstudio keeps them."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for index in range(VIEWS):
        Image.fromarray(ball(camera(index), flat)).save(folder / "images" / f"{index}.png")
        pose = camera(index).camera_to_world @ np.diag([1, -1, -1, 1])  # OpenGL's
        frames.append({"file_path": f"images/{index}.png", "transform_matrix": pose.tolist()})
    content = {"fl_x": camera(0).fx, "w": SIZE, "h": SIZE, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def mask(folder: Path, indices: range, side: int = SIZE) -> Path:
    """Masks of these photos beside them."""
    (folder / "masks").mkdir(exist_ok=True)
    for index in indices:
        Image.fromarray(np.full((side, side), 255, np.uint8)).save(folder / "masks" / f"{index}.png")
    return folder


@pytest.fixture
def run(tmp_path: Path, capsys, caplog, monkeypatch, variant: str) -> Callable[..., str]:
    """Runs the command with output_dir=out, checks its exit code; gives its warnings and its error line."""
    monkeypatch.chdir(tmp_path)

    def run(capture: Path, *arguments: str, code: int = 0) -> str:
        capsys.readouterr()
        caplog.clear()
        with pytest.raises(SystemExit) as stop:
            cli([f"capture={capture}", f"variant={variant}", *SHORT, *arguments])
        err = capsys.readouterr().err
        assert stop.value.code == code, err
        warnings = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
        return "\n".join([*warnings, err] if code == 0 else [err.removesuffix("\n")])

    return run


def refused(run: Callable[..., str], out: Path, capture: Path, *arguments: str) -> str:
    """The one line of a refusal that leaves no result behind."""
    line = run(capture, *arguments, code=2)
    assert len(line.splitlines()) == 1, line
    assert line.startswith("tron-reconstruct: ")
    left = {path.name for path in out.rglob("*") if not path.is_dir()}
    assert left <= {".tron.lock", "config.yaml"}
    return line


def metrics(out: Path) -> dict:
    return json.loads((out / "metrics.json").read_text())


def test_a_video_in_which_nothing_moves_is_refused(run, tmp_path: Path) -> None:
    noise = generator(0, "still video").integers(0, 255, (64, 96, 3), np.uint8)
    with VideoWriter(tmp_path / "still.mp4", 24, (96, 64)) as video:
        for _ in range(12):
            video.write(noise)
    line = refused(run, tmp_path / "out", tmp_path / "still.mp4", "frames=4")
    assert "nothing moves in the video" in line
    assert "still.mp4" in line


def test_masks_of_another_size_cost_their_photos(run, tmp_path: Path) -> None:
    every = mask(photograph(tmp_path / "every"), range(VIEWS), SIZE // 2)
    line = refused(run, tmp_path / "out", every, "masks=subject")
    assert "mask has 12 x 12 pixels, the photo 24 x 24" in line
    one = mask(photograph(tmp_path / "one"), range(2, 3), SIZE // 2)
    assert "1 of 6 photos skipped: 2 (mask has" in run(one)
    assert metrics(tmp_path / "out")["capture"]["skipped"].keys() == {"2"}
    assert "mask has 12 x 12 pixels" in (tmp_path / "out" / "report.html").read_text()


def test_photos_without_texture_are_reconstructed_from_random_points_and_it_is_said(
    run, tmp_path: Path
) -> None:
    told = run(photograph(tmp_path / "flat", flat=True))
    assert len(re.findall("stereo found a depth in", told)) == 1
    assert "beginning from random points" in told
    first = metrics(tmp_path / "out")["first_surfels"]
    assert first["source"] == "random"
    assert first["stereo_confident"] < 0.05
    page = (tmp_path / "out" / "report.html").read_text()
    assert f"from random; {first['stereo_confident']:.0%} of the pixels have a depth" in page
    assert len(GaussianScene.load(tmp_path / "out" / "scene.ply")) > 10


def test_surfels_that_tell_nothing_of_the_light_are_kept_without_one(run, tmp_path: Path) -> None:
    """Hours of stage 1 are not lost because at most eight surfels were found."""
    told = run(photograph(tmp_path / "few"), "initial.source=random", "initial.count=8")
    assert len(re.findall("too few to find the light|no surfel is shown well enough", told)) == 1
    assert "irradiance" not in told
    report = metrics(tmp_path / "out")
    assert report["light"] is None
    assert report["materials_learnt"] == []
    assert not (tmp_path / "out" / "environment.exr").exists()
    assert len(GaussianScene.load(tmp_path / "out" / "scene.ply")) <= 8
    assert "none was found" in (tmp_path / "out" / "report.html").read_text()
