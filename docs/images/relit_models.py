"""The first picture of README.md: three real models as surfels, under four environment maps.

    python docs/images/relit_models.py ../shared/data docs/images/relit-models.jpg

Two and a half minutes on two cores. Surfels are made from the models' true G-buffers.
"""

import sys
from pathlib import Path

import numpy as np

from tron.runtime import activate

activate("llvm_ad_rgb")

from datagen.build import build  # noqa: E402
from datagen.layout import Placement  # noqa: E402
from datagen.models import load_model  # noqa: E402
from datagen.pathtrace import gbuffers  # noqa: E402
from datagen.scene import ObjectSpec, draw_scene  # noqa: E402
from tron.cameras import Camera  # noqa: E402
from tron.color import to_display  # noqa: E402
from tron.gaussians.initialize import surfels_from_gbuffers  # noqa: E402
from tron.images import write_image  # noqa: E402
from tron.shading import EnvironmentMap, Estimation, Lighting, render_guidance  # noqa: E402
from tron.tracing import SurfelTracer  # noqa: E402

SIZE = (640, 440)
SUPERSAMPLES = 2
SURFELS = 600_000
MODELS = {  # file, radius, (x, y), turn about up in degrees
    "FlightHelmet/FlightHelmet.gltf": (1.15, (0.0, 0.0), 10),
    "cat/cat.glb": (1.0, (-1.35, 0.35), 35),
    "spot/spot.obj": (0.85, (1.25, -0.25), 140),
}
LIGHTS = {"venice_sunset_1k": 0, "kiara_1_dawn_1k": 60, "studio_small_03_1k": 180, "forest_slope_1k": 0}


def standing(parts: list, size: float, at: tuple[float, float], turn_deg: float) -> Placement:
    """A model on the floor z = 0, turned about up."""
    half = np.radians(turn_deg) / 2
    height = -size * min(part.vertices[:, 2].min() for part in parts)
    return Placement(quaternion=(np.cos(half), 0, 0, np.sin(half)), position=(*at, height))


def around(count: int) -> list[Camera]:
    """Cameras spread evenly over the upper hemisphere (a golden spiral)."""
    z = 0.03 + 0.95 * (np.arange(count) + 0.5) / count
    phi = (np.arange(count) + 0.5) * np.pi * (3 - np.sqrt(5))
    directions = np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], axis=-1)
    target = np.array([0, 0, 0.6])
    return [
        Camera.look_at(4.6 * d + target, target=target, fov_deg=46, width=512, height=512) for d in directions
    ]


def main(data: Path, output: Path) -> None:
    """Make the surfels, light them, write the picture."""
    models = {name: load_model(data / "assets" / name) for name in MODELS}
    objects = [
        ObjectSpec(asset=name, size=size, placement=standing(models[name], size, at, turn))
        for name, (size, at, turn) in MODELS.items()
    ]
    drawn = draw_scene(0, "train", 0, style="A", lights=["overcast"])
    grey = {"color_a": (0.42, 0.4, 0.37), "color_b": (0.42, 0.4, 0.37), "roughness": (0.45, 0.45)}
    floor = drawn.floor.model_copy(
        update={"half_size": 4.0, "material": drawn.floor.material.model_copy(update=grey)}
    )
    spec = drawn.model_copy(update={"objects": tuple(objects), "floor": floor})
    scene = surfels_from_gbuffers(gbuffers(build(spec, models, 0.1), around(60)), count=SURFELS)
    tracer = SurfelTracer(scene)
    width, height = (SUPERSAMPLES * side for side in SIZE)
    camera = Camera.look_at((0.25, -4.9, 1.75), target=(0, 0, 0.72), fov_deg=40, width=width, height=height)
    pictures = []
    for name, rotation in LIGHTS.items():
        environment = EnvironmentMap.load(data / "hdri" / f"{name}.hdr", rotation)
        guidance = render_guidance(tracer, camera, Lighting(environment), Estimation(rays=32))
        shown = to_display(guidance.shadowed, environment.exposure())
        pictures.append(
            shown.reshape(SIZE[1], SUPERSAMPLES, SIZE[0], SUPERSAMPLES, 3)
            .mean(axis=(1, 3))
            .astype(np.float32)
        )
    rows = [np.concatenate(pictures[i : i + 2], axis=1) for i in (0, 2)]
    write_image(output, np.concatenate(rows, axis=0).astype(np.float32))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
