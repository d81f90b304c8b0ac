"""Make a dataset for the neural renderer: scenes of random shapes, path-traced, with our guidance.

The picture shows three clips: of what the network is given split-sum and irradiance, and what it is to draw.
"""

import numpy as np

from datagen.cli import cli, main
from examples.stage import arguments
from tron.io.images import write_image
from tron.shards.reader import read_clips

chosen = arguments(__doc__, "dataset")
side, rays = (24, 4) if chosen.small else (96, 64)
every = ["lights=[sun,studio,overcast]", "frames=2", f"width={side}", f"height={side}"]
every += [f"path_spp={rays}", f"guidance_spp={rays}", f"reference_spp={rays}"]
scenes = {"train": 4, "train_b": 1, "validation": 1, "test": 2}
settings = cli.compose(
    *(f"{split}.{setting}" for split in scenes for setting in every),
    *(f"{split}.scenes={min(count // 2, 1) if chosen.small else count}" for split, count in scenes.items()),
    *(
        ("views=24", "view_width=24", "view_height=24", "surfels=1500", "refine_steps=10")
        if chosen.small
        else ()
    ),
    *("path_frames=8", "mesh_edge=0.1", "environment_height=64", "cluster=none"),
    f"output_dir={chosen.output}",
)
if main(settings) != 0:
    raise SystemExit("a scene could not be made: see failures.jsonl")
rows = []
for clip in read_clips(chosen.output, "train"):
    rows.append(np.hstack([clip.displayed(name)[0] for name in ("pbr", "irradiance", "rgb")]))
write_image(chosen.output / "dataset.jpg", np.vstack(rows[:3]).repeat(3, axis=0).repeat(3, axis=1))
print(f"{len(rows)} clips to train on: {chosen.output / 'index.html'}")
