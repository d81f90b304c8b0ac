"""A small dataset of three splits, made once for all tests that read one."""

from pathlib import Path

import pytest

from datagen.run import make
from datagen.settings import Settings
from tron.cli.recipes import check, compose_recipe

SMALL = [
    *("train.scenes=2", "train_b.scenes=1", "validation.scenes=0", "test.scenes=1", "seed=5"),
    *("views=6", "view_width=32", "view_height=32", "surfels=1500", "refine_steps=0", "mesh_edge=0.2"),
    *("environment_height=16", "path_frames=8", "cluster=none"),
    *("train.lights=[sun,overcast]", "train_b.lights=[studio]", "test.lights=[sun,studio]"),
    *(
        f"{split}.{value}"
        for split in ("train", "train_b", "test")
        for value in ("frames=3", "width=32", "height=24", "path_spp=4", "guidance_spp=4", "reference_spp=4")
    ),
]


def small(output: Path, *overrides: str) -> Settings:
    """Settings of the small dataset."""
    return check(
        compose_recipe("conf.datagen", Settings, [*SMALL, f"output_dir={output}", *overrides]), Settings
    )


@pytest.fixture(scope="session")
def small_settings():
    return small


@pytest.fixture(scope="session")
def small_dataset(variant: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four scenes, seven clips of three frames, 32 x 24; nobody writes into it."""
    output = tmp_path_factory.mktemp("small") / "dataset"
    assert make(small(output)) == 0
    return output
