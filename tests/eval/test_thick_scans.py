"""Figures of thick scans: specks, leaks and light that is known pixel by pixel."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from eval.reconstruction.thick import relit_figures, thick_rows
from tron.cameras import Camera
from tron.captures import Capture, View
from tron.captures.folder import write_capture
from tron.io.images import encode_exr
from tron.shading.environments.environment import EnvironmentMap

SIDE = 8


@pytest.fixture
def truth(tmp_path: Path) -> tuple[View, Path]:
    """A view of a wall under an even light: the left half gets all of it, the right half a tenth."""
    camera = Camera.look_at((0, -3, 0), (0, 0, 0), up=(0, 0, 1), fov_deg=40, width=SIDE, height=SIDE)
    normal = np.broadcast_to(np.array([0, -1, 0], np.float32), (SIDE, SIDE, 3))
    share = np.where(np.arange(SIDE) < SIDE // 2, 1.0, 0.1)
    arrived = np.broadcast_to(share[None, :, None], (SIDE, SIDE, 3)).astype(np.float32)
    view = View("wall", camera, 0.5 * arrived, "linear", mask=np.ones((SIDE, SIDE)), irradiance=arrived)
    light = EnvironmentMap.constant(1.0, 64)
    path = tmp_path / "wall_1_even"
    write_capture(path, Capture((view,)), beside={"environment.exr": encode_exr(light.image, half=False)})
    return View("wall", camera, 0.5 * arrived, "linear", normal=normal), path


def relighter(irradiance: np.ndarray) -> Any:
    """Shows an irradiance (H, W, 3) whatever the light, of a surface of albedo 0.5."""
    frame = {"lit": 0.5 * irradiance, "irradiance": irradiance, "unshadowed": np.ones_like(irradiance)}
    return SimpleNamespace(under=lambda light: SimpleNamespace(render=lambda camera, seed: frame))


def test_the_truth_has_no_specks_and_no_leaks(truth):
    known, path = truth
    arrived = np.array(0.5 * known.read()) * 4
    figures = relit_figures(relighter(arrived.astype(np.float32)), [known], [path])
    assert figures["specks"] == figures["leaks"] == figures["half"] == 0
    assert figures["irradiance_psnr"] > 50
    assert figures["relight_psnr"] > 50


def test_specks_and_leaks_are_shares_of_what_is_lit_and_of_what_is_dark(truth):
    known, path = truth
    shown = np.where(np.arange(SIDE) < SIDE // 2, 1.0, 0.1)[None, :, None] * np.ones((SIDE, SIDE, 3))
    shown[:2, : SIDE // 2] = 0.4  # a quarter of the lit half
    shown[: SIDE // 2, SIDE // 2 :] = 0.8  # half of the dark one
    figures = relit_figures(relighter(shown.astype(np.float32)), [known], [path])
    assert figures["specks"] == pytest.approx(0.25)
    assert figures["leaks"] == pytest.approx(0.5)
    assert figures["half"] == pytest.approx(0.125)
    assert figures["irradiance_psnr"] < 20


def test_rows_name_the_way():
    ways = {
        "raw": {"relight_psnr": 20.0, "base_color_psnr": 18.0, "specks": 0.1},
        "carried": {"relight_psnr": 22.0, "base_color_psnr": 19.0, "specks": 0.0},
    }
    found = {row.metric: (row.value, row.unit) for row in thick_rows(ways)}
    assert found == {
        "splats.thick.raw_psnr": (20.0, "dB"),
        "splats.thick.raw_base_color_psnr": (18.0, "dB"),
        "splats.thick.raw_specks": (0.1, "fraction"),
        "splats.thick.relight_psnr": (22.0, "dB"),
        "splats.thick.base_color_psnr": (19.0, "dB"),
        "splats.thick.specks": (0.0, "fraction"),
        "splats.thick.gain": (2.0, "dB"),
        "splats.thick.base_color_gain": (1.0, "dB"),
    }
