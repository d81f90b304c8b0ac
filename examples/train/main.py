"""Train a neural renderer, the tiny transformer, for a minute, and look at scenes that it has not seen.

The picture shows what it starts from, lit, then its drawing, then the path tracer's.
"""

import numpy as np

from examples.stage import OUTPUTS, arguments
from train.cli import cli, main
from tron.io.images import write_image
from tron.metrics import capped_psnr
from tron.neural.renderer import render_clip
from tron.neural.weights import load_renderer
from tron.shards.reader import read_clips

chosen = arguments(__doc__, "renderer", dataset=OUTPUTS / "dataset")
steps, crop = (100, 16) if chosen.small else (600, 32)
stage = f"name: fit, split: train, steps: {steps}, batch_size: 8, crop: {crop}"
settings = cli.compose(
    *("renderer=tiny", f"stages=[{{{stage}}}]", "optimizer.muon_learning_rate=1e-2", "loss.lpips=0"),
    # Light transport treats red, green and blue alike, so exchanging them makes new, true scenes.
    *("data.permute_colors=0.7", "accelerator=cpu"),
    *(f"dataset={chosen.dataset}", f"output_dir={chosen.output}"),
)
main(settings)
renderer = load_renderer(chosen.output / "renderer.safetensors")
rows, gains = [], []
for clip in read_clips(chosen.dataset, "test"):
    drawn = render_clip(renderer, {name: clip.displayed(name) for name in renderer.config.guidance})
    given, truth = clip.displayed(renderer.config.skip), clip.displayed("rgb")
    gains += [(capped_psnr(a, c), capped_psnr(b, c)) for a, b, c in zip(given, drawn, truth)]
    rows.append(np.hstack([given[0], drawn[0], truth[0]]))
write_image(chosen.output / "train.jpg", np.vstack(rows[:3]).repeat(3, axis=0).repeat(3, axis=1))
before, after = np.mean(gains, axis=0)
print(f"unseen scenes, given {before:.1f} dB, drawn {after:.1f} dB: {chosen.output / 'train.jpg'}")
