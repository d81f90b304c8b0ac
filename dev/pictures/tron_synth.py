"""Picture of docs/paper/reproduction.md: tron_synth_small path-traced, a column a scene, a row a light.

    python dev/pictures/tron_synth.py docs/images/tron-synth.jpg

Scenes and lights are those of the recipe (seed 0); frames are the middle ones of its clips, larger. With
``--small`` all is tiny.
"""

import io
import sys
from pathlib import Path

import numpy as np
from PIL import Image

from tron.runtime import activate

activate("llvm_ad_rgb", threads=1)

from datagen.files.sources import ready_sources  # noqa: E402
from datagen.run.plan import plan  # noqa: E402
from datagen.settings.command import Settings  # noqa: E402
from datagen.truth.build import draw_and_build  # noqa: E402
from datagen.truth.pathtrace import render_lights, stacked_lights  # noqa: E402
from tron.cli.recipes import check, compose_recipe  # noqa: E402
from tron.color import to_display  # noqa: E402

SMALL = "--small" in sys.argv
SCENES = (1, 16) if SMALL else (1, 2, 5, 16, 18, 21)
"""Three of one object, three of several."""
LIGHTS = (0, 1, 3)
"""High, high and medium contrast."""
SIDE, GUTTER, PATHS = (24, 6, 4) if SMALL else (232, 6, 144)
LARGEST = 200_000
"""Bytes of the picture."""


def main(target: Path) -> None:
    """Render the scenes and write the grid."""
    words = ["experiment=tron_synth_small", "output_dir=none", f"test.width={SIDE}", f"test.height={SIDE}"]
    settings = check(compose_recipe("conf.datagen", Settings, words), Settings)
    sources, items = ready_sources(settings), plan(settings)
    columns = []
    for index in SCENES:
        spec, geometry = draw_and_build(items[index], settings, sources, settings.test.lights)
        baked = [spec.lights[k].bake(settings.environment_height).baked() for k in LIGHTS]
        maps = [each.resized(settings.environment_height) for each in baked]
        camera = spec.clip(0, settings.test.frames, SIDE, SIDE)[settings.test.frames // 2]
        frames = render_lights(geometry.lit(), stacked_lights(maps), camera, PATHS, index)
        columns.append([to_display(frame, light.exposure()) for frame, light in zip(frames, maps)])
        print(spec.name, [light.family for light in spec.lights], flush=True)
    gap = ((0, GUTTER), (0, GUTTER), (0, 0))
    rows = [
        np.concatenate([np.pad(c[k], gap, constant_values=1) for c in columns], 1) for k in range(len(LIGHTS))
    ]
    grid = np.concatenate(rows, 0)[:-GUTTER, :-GUTTER]
    picture = Image.fromarray((np.clip(grid, 0, 1) * 255 + 0.5).astype(np.uint8))
    for quality in range(92, 50, -3):
        buffer = io.BytesIO()
        picture.save(buffer, "JPEG", quality=quality, optimize=True)
        if buffer.tell() <= LARGEST:
            break
    target.write_bytes(buffer.getvalue())


main(*(Path(each) for each in sys.argv[1:] if each != "--small"))
