"""A dataset folder small enough to train on in a second, and the settings to do so."""

import itertools
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tron import seeds
from tron.cameras import Camera
from tron.estimation import MATERIAL
from tron.shards.manifest import Manifest
from tron.shards.schema import GUIDANCE, TARGET, ClipMeta, ColorSpace, guidance_members
from tron.shards.writer import ShardWriter


def write_dataset(
    folder: Path,
    splits: dict[str, int],
    frames: int = 6,
    size: int = 24,
    shard: int = 2,
    width: int | None = None,
    spaces: dict[str, ColorSpace] | None = None,
    lights: int = 1,
    views: int = 0,
) -> Path:
    """Clips of smooth colours whose picture is the product of pbr and irradiance, frames x size x size.

    splits: number of scenes by name. width: of frames that are not square. spaces: of colours that are not
    linear. lights: clips of each scene; with views, so many of each light, from other cameras, with keys as
    those of captures.
    """
    width = width or size
    colors: dict[str, ColorSpace] = dict.fromkeys((*GUIDANCE, TARGET), "linear")
    entries = []
    for split, count in splits.items():
        with ShardWriter(folder, split, shard) as writer:
            for number, light, view in itertools.product(range(count), range(lights), range(max(views, 1))):
                random = seeds.generator(0, "dataset", split, number + count * (light + lights * view))
                meta = ClipMeta(
                    key=f"{split}{number:03d}-l{light}" + (f"-c{view:04d}" if views else ""),
                    scene=f"{split}{number:03d}",
                    light=f"l{light}",
                    light_family="studio",
                    split=split,
                    frames=frames,
                    width=width,
                    height=size,
                    cameras=[  # type: ignore[arg-type]
                        Camera.look_at(
                            (0, -4, view), (0, 0, 0), fov_deg=35, width=width, height=size
                        ).to_dict()
                    ]
                    * frames,
                    exposure=1.0,
                    color_space=colors | (spaces or {}),
                )
                writer.write(meta, [_frame(random, size, width) for _ in range(frames)])
        entries += writer.entries
    Manifest(config_sha256="0" * 64, shards=entries, material=MATERIAL).save(folder)
    return folder


def _frame(random: np.random.Generator, height: int, width: int) -> dict[str, np.ndarray]:
    down, right = (np.linspace(0, 1, side, dtype=np.float32) for side in (height, width))
    pbr = 0.1 + random.random(3) * down[:, None, None] + np.zeros((height, width, 3))
    irradiance = 0.2 + random.random(3) * right[None, :, None] + np.zeros((height, width, 3))
    one = np.ones((height, width, 1))
    images = dict.fromkeys(guidance_members(), pbr) | {"irradiance": irradiance, "unshadowed": irradiance}
    return images | {"rgb": pbr * irradiance, "mask": one, "foreground": one}


@pytest.fixture(scope="session")
def dataset(tmp_path_factory) -> Path:
    return write_dataset(
        tmp_path_factory.mktemp("dataset"), {"train": 5, "train_b": 3, "validation": 2, "test": 2}
    )


@pytest.fixture(scope="session")
def make_dataset() -> Callable[..., Path]:
    return write_dataset


@pytest.fixture(scope="session")
def make_settings() -> Callable[..., dict[str, Any]]:
    return small_settings


def small_settings(dataset: Path, output_dir: Path, **changes: Any) -> dict[str, Any]:
    """Settings, as a plain dict, of a run of a few seconds."""
    settings = {
        "dataset": dataset,
        "output_dir": output_dir,
        "renderer": {
            "_target_": "tron.neural.renderer.NeuralRenderer",
            "config": {
                "_target_": "tron.neural.configs.RendererConfig",
                "backbone": {"heads": 1, "head_dim": 12, "layers": 1, "adaln_lora_dim": 4},
            },
        },
        "stages": [
            {"name": "one", "split": "train", "steps": 6, "batch_size": 2, "crop": 16},
            {
                "name": "two",
                "split": "train_b",
                "frames": 5,
                "steps": 4,
                "batch_size": 2,
                "crop": 16,
                "rehearsal_split": "train",
                "rehearsal_ratio": 0.5,
            },
        ],
        "optimizer": {"warmup_steps": 2},
        "validation": {"every": 5, "clips": 2},
        "checkpoint_every": 2,
        "accelerator": "cpu",
    }
    return settings | changes


@pytest.fixture(scope="session")
def damage_frame() -> Callable[[Path, str], None]:
    return overwrite


def overwrite(folder: Path, name: str) -> None:
    """Overwrite a member of one of a folder's shards, such as `train000-l0.f02.pbr.exr`, by zeros."""
    for path in folder.glob("*.tar"):
        with tarfile.open(path) as shard:
            found = next((member for member in shard.getmembers() if member.name == name), None)
        if found is not None:
            with path.open("r+b") as file:
                file.seek(found.offset_data)
                file.write(bytes(found.size))
            return
    raise FileNotFoundError(name)
