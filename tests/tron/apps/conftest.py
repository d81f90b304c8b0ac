"""A small scene with everything that relighting shows: a metal ball and its shadow on a floor."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tron.apps.relight.cli import cli
from tron.gaussians.harmonics import rgb_to_dc
from tron.gaussians.scene import GaussianScene, quats_from_normals
from tron.shading.environments.environment import EnvironmentMap

SIZE = 32
"""Pixels along a side of a frame that the command renders here."""
CENTRE, RADIUS = np.array([0.0, 0.0, 0.5]), 0.5


def make_ball_on_floor(spacing: float = 0.06, half: float = 1.5) -> GaussianScene:
    """Surfels of a sphere (Fibonacci spiral) on a floor at z = 0 (square grid), about `spacing` apart."""
    count = int(4 * np.pi * RADIUS**2 / spacing**2)
    z = 1 - (2 * np.arange(count) + 1) / count
    azimuth = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    level = np.sqrt(1 - z**2)
    ball = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), z], axis=1)
    side = np.arange(-half, half + spacing / 2, spacing)
    floor = np.stack([*np.meshgrid(side, side), np.zeros((len(side), len(side)))], axis=-1).reshape(-1, 3)
    normals = np.concatenate([ball, np.tile([0.0, 0.0, 1.0], (len(floor), 1))])
    on_ball = np.arange(len(normals)) < count
    color = np.where(on_ball[:, None], [0.8, 0.3, 0.2], [0.5, 0.5, 0.5])
    sh = np.zeros((len(normals), 16, 3))
    sh[:, 0] = rgb_to_dc(color)
    return GaussianScene(
        means=np.concatenate([CENTRE + RADIUS * ball, floor]),
        quats=quats_from_normals(normals),
        log_scales=np.full((len(normals), 2), np.log(0.4 * spacing)),
        opacity_logits=np.full(len(normals), 4.6),
        sh=sh,
        base_color=color,
        roughness=np.where(on_ball, 0.3, 0.8),
        metallic=np.where(on_ball, 0.6, 0.0),
        object_id=on_ball,
        kernel_degree=4,
        spacing=spacing,
    ).validate()


@pytest.fixture(scope="session")
def ball_on_floor() -> Callable[..., GaussianScene]:
    """Makes a fresh scene at each call."""
    return make_ball_on_floor


@pytest.fixture(scope="module")
def scene_path(ball_on_floor, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "surfels.ply"
    ball_on_floor().save(path)
    return path


def lamp() -> EnvironmentMap:
    """A dim sky with a bright patch low in the +x direction."""
    image = np.full((32, 64, 3), 0.3, np.float32)
    row, column = 9, 16  # u = atan2(x, y) / 2 pi = 1/4
    image[row - 1 : row + 2, column - 2 : column + 2] = 60.0
    return EnvironmentMap(image)


@pytest.fixture(scope="module")
def light_path(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("light") / "lamp.exr"
    lamp().save(path)
    return path


@pytest.fixture
def relight(variant) -> Callable[..., int]:
    """Runs the command in this process; gives its exit code."""

    def run(*overrides: str) -> int:
        with pytest.raises(SystemExit) as exit_info:
            cli([f"width={SIZE}", f"height={SIZE}", f"variant={variant}", *overrides])
        return int(exit_info.value.code or 0)

    return run


@pytest.fixture(scope="session")
def orbit_of_four(made_once, variant) -> Path:
    """What the command makes of the ball from +x, +y, -x, -y in its best quality; not to be changed."""

    def make(folder: Path) -> None:
        make_ball_on_floor().save(folder / "surfels.ply")
        lamp().save(folder / "lamp.exr")
        words = [
            *(f"scene={folder / 'surfels.ply'}", f"environment={folder / 'lamp.exr'}"),
            *(f"output_dir={folder / 'out'}", f"width={SIZE}", f"height={SIZE}", f"variant={variant}"),
            *("frames=4", "quality=final", "buffers=[irradiance,indirect,shadowed,lit,normal,position]"),
        ]
        with pytest.raises(SystemExit) as stop:
            cli(words)
        assert not stop.value.code

    return made_once(f"orbit_of_four-{variant}", make) / "out"
