"""`srun tron-train`: the processes that Slurm starts find one another and train together."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from tron import seeds
from tron.shards.manifest import Manifest
from tron.shards.schema import TARGET, ClipMeta, guidance_members, light_members
from tron.shards.writer import ShardWriter

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("dataset")
    with ShardWriter(folder, "train", 4) as writer:
        for number in range(4):
            key = f"train{number:03d}-l0"
            meta = ClipMeta(
                key=key,
                scene=key[:-3],
                light="l0",
                light_family="studio",
                split="train",
                frames=1,
                width=16,
                height=16,
                cameras=[{}],
                exposure=1.0,
                color_space=dict.fromkeys((*light_members(), TARGET), "linear"),
            )
            noise = seeds.generator(0, "dataset", number).random((16, 16, 3), np.float32)
            one = np.ones((16, 16, 1), np.float32)
            colours = dict.fromkeys((*guidance_members(), TARGET), noise)
            writer.write(meta, [{**colours, "mask": one, "foreground": one}])
    Manifest(config_sha256="0" * 64, shards=writer.entries).save(folder)
    return folder


def test_two_tasks_of_srun_train_together(slurm, dataset, tmp_path):
    words = [
        f"dataset={dataset}",
        f"output_dir={tmp_path / 'out'}",
        "renderer=pixel_mlp",
        "stages=[{name: one, split: train, steps: 3, batch_size: 1, crop: 16}]",
        "validation.split=null",
        "accelerator=cpu",
        "devices=2",
    ]
    script = Path(sys.executable).with_name("tron-train")
    done = subprocess.run(
        ["srun", "--nodes=1", "--ntasks-per-node=2", "--overcommit", str(script), *words],
        env=slurm,
        capture_output=True,
        text=True,
        timeout=400,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "renderer.safetensors").is_file()
    assert yaml.safe_load((tmp_path / "out" / "config.yaml").read_text())["processes"] == 2
    assert done.stderr.count("Stage 1 of 1") == 1
