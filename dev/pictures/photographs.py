"""The picture of docs/results.md: photographs without a prior, their scenes relit beside the truth.

    cd dev/pictures; python photographs.py REPORT ../../docs/images/photographs.jpg

REPORT is a finished `tron-eval benchmark=reconstruction`. Its middle held-out view of each scene: the true
picture, learnt radiance, normals and true ones, base color and the true one, relit and path-traced under each
of two other lights.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from tron.runtime import activate

activate("llvm_ad_rgb")

from eval.reconstruction.benchmark import relit_truths, scene_names  # noqa: E402
from eval.reconstruction.relighting import relight  # noqa: E402
from tron.captures import load_capture  # noqa: E402
from tron.color import linear_to_srgb  # noqa: E402
from tron.gaussians import GaussianScene  # noqa: E402
from tron.tracing import SurfelTracer  # noqa: E402


def row(dataset: Path, name: str, scene: Path) -> np.ndarray:
    """(H, W, 3) pictures of one scene beside one another."""
    views = load_capture(dataset / "captures" / name).test_views
    view = views[len(views) // 2]
    found = SurfelTracer(GaussianScene.load(scene)).gbuffer(view.camera).numpy()
    solid = found["opacity"][..., None]
    pictures = [
        view.read("image"),
        found["rgb"],
        0.5 + 0.5 * found["normal"] * solid,
        0.5 + 0.5 * view.read("normal"),
        linear_to_srgb(found["base_color"] * solid),
        linear_to_srgb(view.read("base_color")),
    ]
    for light in relight(scene, relit_truths(dataset, name)).lights.values():
        pictures += [light.shown, light.truth]
    return np.concatenate([np.clip(picture, 0, 1) for picture in pictures], axis=1)


def main(report: Path, out: Path) -> None:
    """Write the picture."""
    dataset = report / "photographs"
    rows = [
        row(dataset, name, report / "scenes" / name / "photos" / "scene.ply") for name in scene_names(dataset)
    ]
    Image.fromarray(np.round(255 * np.concatenate(rows)).astype(np.uint8)).save(out, quality=88)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
