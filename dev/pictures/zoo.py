"""The picture of docs/concepts/light.md: the wall of a zoo that was measured, smaller.

tron-eval benchmark=zoo benchmark.real_data=FOLDER output_dir=outputs/zoo
python dev/pictures/zoo.py outputs/zoo docs/images/zoo.jpg
"""

import sys
from pathlib import Path

from PIL import Image

WIDTH, QUALITY = 1150, 45


def main(zoo: Path, out: Path) -> None:
    """Write the wall of ``zoo``, an output folder."""
    wall = Image.open(zoo / "pictures" / "wall.png").convert("RGB")
    size = (WIDTH, round(wall.height * WIDTH / wall.width))
    wall.resize(size, Image.Resampling.LANCZOS).save(out, quality=QUALITY, optimize=True, progressive=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
