"""The scene of the examples, small: a floor, a ball and a ring, with true object ids."""

from collections.abc import Callable
from pathlib import Path

import pytest

from examples.stage import make_scene
from tron.gaussians.scene import GaussianScene

SPACING = 0.08


@pytest.fixture(scope="session")
def scene() -> GaussianScene:
    return make_scene(SPACING)


@pytest.fixture
def content(tmp_path: Path) -> Callable[[GaussianScene], bytes]:
    """The bytes of a scene's file."""

    def content(scene: GaussianScene) -> bytes:
        path = tmp_path / "written.ply"
        scene.save(path)
        return path.read_bytes()

    return content
