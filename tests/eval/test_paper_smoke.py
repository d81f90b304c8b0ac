"""The paper's own recipes run from data to figures, small, with weights in the published files' formats."""

import math

import pytest

from eval.datagen.paper_smoke import measure_paper_smoke, write_tiny_weights
from tron.metrics import LPIPS
from tron.neural.weights import load_cosmos
from tron.shards.reader import read_clips


def test_tiny_weights_are_read_by_the_loaders_of_the_published_files(tmp_path):
    write_tiny_weights(tmp_path)
    backbone = {"heads": 2, "head_dim": 12, "layers": 2, "text_embed_dim": 16, "adaln_lora_dim": 8}
    backbone |= {"patch": (1, 2, 2), "max_size": (8, 32, 32), "rope_scale": (1.0, 4.0, 4.0)}
    backbone |= {"padding_channel": True, "cross_attention": "frozen"}
    renderer = load_cosmos(tmp_path / "transformer", tmp_path / "vae", {"backbone": backbone})
    assert renderer.config.fusion == "average"
    LPIPS.load(tmp_path / "vgg16.pth")


@pytest.mark.long
def test_the_papers_recipes_run_from_data_to_figures(tmp_path):
    """Data from reconstructions, three stages with LPIPS, evaluation of the network that came of it."""
    found = measure_paper_smoke(tmp_path / "smoke")
    assert set(found.seconds) == {"datagen", "train", "eval"}
    assert found.clips == {"train": 4, "train_b": 1, "validation": 1, "test": 2}
    assert math.isfinite(found.psnr["neural.psnr"])
    made = {
        clip.meta.extra["surfels_from"]
        for split in found.clips
        for clip in read_clips(tmp_path / "smoke" / "dataset", split, ["pbr"])
    }
    assert made == {"reconstruction"}
    steps = (tmp_path / "smoke" / "train" / "metrics.csv").read_text()
    assert all(stage in steps for stage in ("synthetic", "adapt", "video"))
