"""What is wrong with a reconstruction's input costs one line and exit code 2, before long work starts."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tron.apps.reconstruct.cli import cli
from tron.cameras import Camera
from tron.captures import Capture, View
from tron.captures.folder import write_capture

SIZE = 24
SHORT = ("steps_scaler=1", "radiance.steps=2", "materials.steps=1", "initial.count=50")


def photos(count: int = 5) -> list[View]:
    """Grey photos from a ring."""
    views = []
    for i in range(count):
        turn = 2 * math.pi * i / max(count, 3)
        eye = (3 * math.cos(turn), 3 * math.sin(turn), 0.7)
        camera = Camera.look_at(eye, (0, 0, 0), fov_deg=40, width=SIZE, height=SIZE)
        views.append(View(str(i), camera, np.full((SIZE, SIZE, 3), 0.5), "display"))
    return views


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Captures that are fine, and some that are not; files that are not what they are named for."""
    folder = tmp_path_factory.mktemp("inputs")
    write_capture(folder / "good", Capture(tuple(photos())))
    write_capture(folder / "single", Capture(tuple(photos(1))))
    black = tuple(replace(view, mask=np.zeros((SIZE, SIZE))) for view in photos())
    write_capture(folder / "black", Capture(black))
    write_capture(folder / "one_place", Capture(tuple(turned_on_the_spot())))
    linear = tuple(replace(view, space="linear") for view in photos())
    write_capture(folder / "linear", Capture(linear))
    write_capture(folder / "lost_photo", Capture(tuple(photos())))
    (folder / "lost_photo" / "images" / "3.png").unlink()
    write_capture(folder / "torn_photo", Capture(tuple(photos())))
    torn = folder / "torn_photo" / "images" / "3.png"
    torn.write_bytes(torn.read_bytes()[:60])
    (folder / "empty").mkdir()
    (folder / "one_photo").mkdir()
    Image.new("RGB", (SIZE, SIZE)).save(folder / "one_photo" / "a.png")
    (folder / "file").write_text("neither a folder nor weights\n")
    (folder / "checkpoint").mkdir()
    return folder


def turned_on_the_spot() -> list[View]:
    eye = np.array([1.7, -2.3, 0.4])
    views = []
    for i, view in enumerate(photos()):
        turn = 2 * math.pi * i / 5
        ahead = eye + np.array([math.cos(turn), math.sin(turn), 0.1])
        camera = Camera.look_at(eye, ahead, fov_deg=40, width=SIZE, height=SIZE)
        views.append(replace(view, camera=camera))
    return views


@pytest.fixture
def run(inputs: Path, tmp_path: Path, capsys, monkeypatch, variant: str) -> Callable[..., str]:
    """Runs the command with output_dir=out; returns the one line that it must have printed."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str) -> str:
        named = [each.format(inputs=inputs) for each in arguments]
        if not any(each.startswith("output_dir=") for each in named):
            named.append("output_dir=out")
        capsys.readouterr()
        with pytest.raises(SystemExit) as stop:
            cli([*named, f"variant={variant}", *SHORT])
        out, err = capsys.readouterr()
        assert stop.value.code == 2, err
        assert out == ""
        assert len(err.splitlines()) == 1, err
        assert err.startswith("tron-reconstruct: ")
        assert len(err) < 600
        left = {path.name for path in tmp_path.rglob("*") if not path.is_dir()}
        assert left <= {".tron.lock", "config.yaml"}
        return err

    return run


BAD = {
    "missing folder": (["capture={inputs}/absent"], "capture not found"),
    "no photos": (["capture={inputs}/empty"], "neither poses nor photos"),
    "no photos of that format": (["capture={inputs}/empty", "format=photos"], "photo"),
    "one photo without a pose": (["capture={inputs}/one_photo"], "photo"),
    "a file": (["capture={inputs}/file"], "folder"),
    "single view": (["capture={inputs}/single"], "at least two|fewer than two|two"),
    "lost photo": (["capture={inputs}/lost_photo"], "3.png"),
    "torn photo": (["capture={inputs}/torn_photo"], "3.png"),
    "linear images": (["capture={inputs}/linear"], "linear"),
    "no truth": (["capture={inputs}/good", "prior=ground_truth"], "no true maps"),
    "rgbx without checkpoint": (["capture={inputs}/good", "prior=rgbx"], "prior.checkpoint"),
    "rgbx, absent": (["capture={inputs}/good", "prior=rgbx", "prior.checkpoint={inputs}/absent"], "absent"),
    "rgbx, empty": (
        ["capture={inputs}/good", "prior=rgbx", "prior.checkpoint={inputs}/checkpoint"],
        "checkpoint",
    ),
    "rgbx, a file": (["capture={inputs}/good", "prior=rgbx", "prior.checkpoint={inputs}/file"], "file"),
    "maps, absent": (
        ["capture={inputs}/good", "prior=precomputed", "prior.folder={inputs}/absent"],
        "absent",
    ),
    "maps, none": (["capture={inputs}/good", "prior=precomputed", "prior.folder={inputs}/empty"], "empty"),
    "a prior's number": (["capture={inputs}/good", "prior.roughness=7"], "prior.roughness"),
    "a prior's word": (["capture={inputs}/good", "prior.tone_curve=film"], "film"),
    "output is a file": (["capture={inputs}/good", "output_dir={inputs}/file"], "file"),
    "a size no light has": (
        ["capture={inputs}/good", "light.split_sum_resolution=100"],
        "light.split_sum_resolution",
    ),
    "lpips, absent": (["capture={inputs}/good", "lpips_weights={inputs}/absent.pth"], "absent.pth"),
    "lpips, foreign": (["capture={inputs}/good", "lpips_weights={inputs}/file"], "VGG-16"),
    "no depth": (["capture={inputs}/good", "initial.source=depth"], "no training view has a depth map"),
    "no points": (["capture={inputs}/good", "initial.source=points"], "no points"),
    "black masks": (["capture={inputs}/black"], "masks"),
    "one place": (["capture={inputs}/one_place"], "one place"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_mistake_is_one_line(run, name: str) -> None:
    arguments, words = BAD[name]
    line = run(*arguments)
    assert any(each in line for each in words.split("|")), line


@pytest.mark.parametrize(
    ("content", "words"), [(b"", "cannot read the checkpoint"), (b"junk" * 99, "cannot read the checkpoint")]
)
def test_a_checkpoint_that_is_none_is_one_line_and_stays(
    run, tmp_path: Path, content: bytes, words: str
) -> None:
    out = tmp_path.parent / f"{tmp_path.name}_kept"
    out.mkdir()
    (out / "checkpoint.safetensors").write_bytes(content)
    line = run("capture={inputs}/good", f"output_dir={out}")
    assert words in line
    assert "remove it" in line
    assert (out / "checkpoint.safetensors").read_bytes() == content
