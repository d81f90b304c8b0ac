"""The picture of docs/concepts/light.md beside Blender: surfels as `lit`, Mitsuba's paths, Cycles.

    python dev/pictures/blender.py ../shared/data PYTHON_WITH_BPY docs/images/blender.jpg

Surfels are made of the model's meshes (FlightHelmet), without normal maps; the paths see the model itself.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from tron.runtime import activate

activate("llvm_ad_rgb")

from eval.exchange.mesh import LIGHTS, light_file  # noqa: E402
from eval.exchange.models import MODELS, before, both  # noqa: E402
from tron.color import to_display  # noqa: E402
from tron.estimation import FINEST  # noqa: E402
from tron.io.images import write_image  # noqa: E402
from tron.models.load import load_model  # noqa: E402
from tron.models.sides import spacing_of, two_sided  # noqa: E402
from tron.models.surfels import surfels_of_model  # noqa: E402
from tron.relighting import EnvironmentMap, Relighter  # noqa: E402

SIDE, PATHS, SURFELS = 384, 144, 600_000
BRIGHTER = 1.6


def main(data: Path, python: Path, output: Path) -> None:
    """Render and write the picture."""
    name, turn = LIGHTS[0]
    light, file = EnvironmentMap.load(light_file(data, name), turn), data / "assets" / MODELS[0]
    with tempfile.TemporaryDirectory() as folder:
        (pair,) = both(python, file, {name: light}, Path(folder), PATHS, 0, 2, SIDE)
    parts = load_model(file, fitted=False)
    sides = two_sided(parts)
    relighter = Relighter(surfels_of_model(sides, spacing_of(sides, SURFELS)), FINEST, proxy="never")
    lit = relighter.under(light).render(before(parts, SIDE)).lit
    cycles = np.where(pair.filled[..., None], pair.cycles, lit)  # it has no world behind it
    rows, columns = np.nonzero(pair.filled)
    crop = (
        slice(max(rows.min() - 8, 0), rows.max() + 8),
        slice(max(columns.min() - 24, 0), columns.max() + 24),
    )
    display = [to_display(image[crop], BRIGHTER * pair.exposure) for image in (lit, pair.mitsuba, cycles)]
    write_image(output, np.concatenate(display, axis=1).astype(np.float32))
    print(f"Mitsuba against Cycles: {pair.psnr:.1f} dB")


if __name__ == "__main__":
    main(*(Path(each) for each in sys.argv[1:]))
