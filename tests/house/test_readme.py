"""What the README shows has to run."""

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tron.gaussians.initialize import GBufferView, surfels_from_gbuffers
from tron.images import read_image, write_image
from tron.shading import Guidance

README = Path(__file__).resolve().parents[2] / "README.md"
PYTHON = README.parent / "docs/python.md"


def plane_view() -> GBufferView:
    """A camera four units above a grey floor of 4 x 4."""
    from tron.cameras import Camera

    camera = Camera.look_at((0, 0, 4), (0, 0, 0), up=(0, 1, 0), fov_deg=50, width=48, height=48)
    rays = camera.rays()
    position = camera.position + rays * (-4 / rays[..., 2:])
    full = np.ones(rays.shape[:2])
    return GBufferView(
        camera=camera,
        position=position,
        normal=np.broadcast_to((0.0, 0.0, 1.0), rays.shape).copy(),
        base_color=np.full(rays.shape, 0.5),
        roughness=0.5 * full,
        metallic=0 * full,
        rgb=None,
        valid=full > 0,
        object_id=full.astype(np.int32),
    )


@pytest.mark.usefixtures("variant")
def test_the_python_examples_do_what_they_say(tmp_path, monkeypatch):
    first, second = re.findall(r"```python\n(.*?)```", PYTHON.read_text(), re.DOTALL)
    assert first in README.read_text()
    assert "width=512, height=512" in first
    surfels_from_gbuffers([plane_view()], count=500).save(tmp_path / "scene.ply")
    write_image(tmp_path / "studio.hdr", np.full((16, 32, 3), 0.7, np.float32))
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(compile(first.replace("512", "24"), str(PYTHON), "exec"), names)
    pbr = read_image(tmp_path / "pbr.exr")
    assert pbr.shape == (24, 24, 3)
    # A grey floor under a constant light of 0.7: half of it comes back, and a little gloss.
    assert 0.3 < pbr[12, 12, 0] < 0.45
    lit = read_image(tmp_path / "lit.png")
    assert lit.shape == (24, 24, 3)
    assert lit[12, 12, 0] > 0.3

    assert "steps=500" in second
    smaller = second.replace("512", "24").replace("steps=500", "steps=30, scale_steps=2")
    exec(compile(smaller, str(PYTHON), "exec"), names)
    assert names["surfels"]["base_color"].grad.abs().max() > 0
    assert names["tracer"].scene is not names["scene"]
    # Above the horizon, where the floor sees it, the light comes back as it was.
    assert np.median(read_image(tmp_path / "fitted.exr")[:16]) == pytest.approx(0.7, rel=0.2)
    picture = np.array(names["picture"])
    assert picture.shape == (24, 24, 3 * (len(Guidance.BUFFERS) - 1) + 1)  # buffers, opacity
    assert 0.3 < picture[12, 12, 0] < 0.45


def test_the_line_for_cuda_users_names_the_gpu_or_says_in_one_line_why_not():
    (line,) = re.findall(r"^\.venv/bin/python -c \"(.*)\"$", README.read_text(), re.MULTILINE)
    done = subprocess.run([sys.executable, "-c", line], capture_output=True, text=True, timeout=120)
    if done.returncode == 0:
        assert done.stdout.strip()
    else:
        assert "TronError: " in done.stderr.strip().splitlines()[-1]


def test_commands_that_the_readme_names_exist():
    import tomllib

    scripts = tomllib.loads((README.parent / "pyproject.toml").read_text())["project"]["scripts"]
    named = set(re.findall(r"tron-[a-z]+", README.read_text()))
    assert named == set(scripts)


def test_files_that_the_readme_links_exist():
    links = [link for link in re.findall(r"\]\(([^)]+)\)", README.read_text()) if "://" not in link]
    assert links
    assert [link for link in links if not (README.parent / link).is_file()] == []


def test_the_file_tree_is_that_of_today():
    done = subprocess.run(
        [sys.executable, README.parent / ".ci/file_tree.py"], capture_output=True, text=True, check=True
    )
    assert done.stdout in README.read_text(), "the README's file tree is old: make format"
