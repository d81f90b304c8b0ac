"""What the README shows has to run."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tron.gaussians.initialize import GBufferView, surfels_from_gbuffers
from tron.io.images import read_image, write_image
from tron.shading import Guidance

README = Path(__file__).resolve().parents[2] / "README.md"
PYTHON = README.parent / "docs/guides/python.md"


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


@pytest.mark.long
@pytest.mark.usefixtures("variant")
def test_the_python_examples_do_what_they_say(tmp_path, monkeypatch):
    (six,) = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    assert len(six.strip().replace("\n\n", "\n").splitlines()) == 6
    first, second = re.findall(r"```python\n(.*?)```", PYTHON.read_text(), re.DOTALL)
    for name in ("scan", "scene"):
        surfels_from_gbuffers([plane_view()], count=500).save(tmp_path / f"{name}.ply")
    write_image(tmp_path / "studio.hdr", np.full((16, 32, 3), 0.7, np.float32))
    monkeypatch.chdir(tmp_path)
    for code in (six.replace("-45", "-45, width=24, height=24"), first.replace("512", "24")):
        names: dict[str, Any] = {}
        exec(compile(code, str(PYTHON), "exec"), names)
        lit = read_image(tmp_path / "lit.png")
        assert lit.shape == (24, 24, 3)
        assert lit[12, 12, 0] > 0.3
    pbr = read_image(tmp_path / "pbr.exr")
    # A grey floor under a constant light of 0.7: half of it comes back, and a little gloss.
    assert 0.3 < pbr[12, 12, 0] < 0.45

    assert "steps=500" in second
    smaller = second.replace("512", "24").replace("steps=500", "steps=30, scale_steps=2")
    exec(compile(smaller, str(PYTHON), "exec"), names)
    assert names["surfels"]["base_color"].grad.abs().max() > 0
    assert names["relighter"].scene is not names["scene"]
    # Above the horizon, where the floor sees it, the light comes back as it was.
    assert np.median(read_image(tmp_path / "fitted.exr")[:16]) == pytest.approx(0.7, rel=0.2)
    picture = np.array(names["picture"])
    assert picture.shape == (24, 24, 3 * (len(Guidance.BUFFERS) - 1) + 1)  # buffers, opacity
    assert 0.3 < picture[12, 12, 0] < 0.45


def test_every_extra_is_named_with_its_size():
    extras = tomllib.loads((README.parent / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for page in (README, README.parent / "docs/start/install.md"):
        rows = "".join(line for line in page.read_text().splitlines() if line.startswith("|"))
        assert [
            name for name in extras if name not in ("dev", "surfels", "tracer") and f"`{name}`" not in rows
        ] == []


def test_the_line_for_cuda_users_names_the_gpu_or_says_in_one_line_why_not():
    install = README.parent / "docs/start/install.md"
    (line,) = re.findall(r"^\.venv/bin/python -c \"(.*)\"$", install.read_text(), re.MULTILINE)
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
