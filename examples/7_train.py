"""Train a neural renderer, the small one that sees each pixel alone, and look at a scene it has not seen.

The picture shows what it is given, split-sum, then its drawing, then the path tracer's.
"""

import numpy as np
from stage import OUTPUTS, arguments

from train.cli import cli, main
from tron.images import write_image
from tron.neural.renderer import render_clip
from tron.neural.weights import load_renderer
from tron.shards.reader import read_clips

chosen = arguments(__doc__, "7_renderer", dataset=OUTPUTS / "6_dataset")
steps, crop = (60, 16) if chosen.small else (1500, 48)
stage = f"name: fit, split: train, steps: {steps}, batch_size: 8, crop: {crop}"
settings = cli.compose(
    *("renderer=pixel_mlp", f"stages=[{{{stage}}}]", "optimizer.learning_rate=3e-3", "loss.lpips=0"),
    *("accelerator=cpu", f"dataset={chosen.dataset}", f"output_dir={chosen.output}"),
)
main(settings)
renderer = load_renderer(chosen.output / "renderer.safetensors")
rows = []
for clip in read_clips(chosen.dataset, "test"):
    drawn = render_clip(renderer, {name: clip.displayed(name) for name in renderer.config.guidance})
    rows.append(np.hstack([clip.displayed("pbr")[0], drawn[0], clip.displayed("rgb")[0]]))
write_image(chosen.output / "train.jpg", np.vstack(rows[:3]).repeat(3, axis=0).repeat(3, axis=1))
print(f"trained for {steps} steps: {chosen.output / 'train.jpg'}")
