"""The first picture of README.md: real models as surfels, `lit` under an environment map, no network.

    I=docs/images; python dev/pictures/relit_models.py ../shared/data $I/relit-models.jpg \\
        $I/guidance-path-traced.jpg

The second picture, of docs/concepts/light.md, is smaller, beside the path tracer's of the same models; with
``--small`` both are tiny. Surfels are made from the models' true G-buffers.
"""

import sys
from pathlib import Path

import numpy as np

from tron.runtime import activate

activate("llvm_ad_rgb")

from datagen.truth.build import Geometry, build  # noqa: E402
from datagen.truth.pathtrace import gbuffers, render_frames  # noqa: E402
from datagen.world.materials.plastic import PlasticSpec  # noqa: E402
from datagen.world.objects import ObjectSpec, Placement  # noqa: E402
from datagen.world.scene import draw_scene  # noqa: E402
from tron.cameras import Camera  # noqa: E402
from tron.color import to_display  # noqa: E402
from tron.gaussians.initialize import surfels_from_gbuffers  # noqa: E402
from tron.io.images import write_image  # noqa: E402
from tron.models.load import load_model  # noqa: E402
from tron.relighting import EnvironmentMap, Estimation, Relighter  # noqa: E402

SMALL = "--small" in sys.argv
SIZE = (64, 36) if SMALL else (1280, 720)
ESTIMATION = Estimation(rays=8 if SMALL else 64, reflections=4, supersample=2)
SURFELS = 2_000 if SMALL else 1_200_000
VIEWS, VIEW_SIDE = (8, 48) if SMALL else (40, 896)
PATHS = 4 if SMALL else 256
MODELS = [  # file, radius, (x, y), turn about up in degrees
    ("FlightHelmet/FlightHelmet.gltf", 1.15, (0.12, 0.2), 10),
    ("cat/cat.glb", 1.0, (-1.0, 0.1), 30),
    ("spot/spot.obj", 0.8, (1.12, -0.15), 140),
    ("spot/spot.obj", 0.27, (0.42, -0.72), 200),
]
FLOOR_SIZE = 2.6 * np.sqrt(2)
"""Distance of its corners from the middle."""
FLOOR = PlasticSpec(
    offset=(0, 0, 0), color=(0.55, 0.24, 0.13), roughness=0.4, grain=0.05, relief=0, scuffed=0
)
LIGHT, TURN_DEG, BRIGHTER = "venice_sunset_1k", 30, 1.6


def standing(parts: list, size: float, at: tuple[float, float], turn_deg: float) -> Placement:
    """A model on the floor z = 0, turned about up."""
    half = np.radians(turn_deg) / 2
    height = -size * min(part.vertices[:, 2].min() for part in parts)
    return Placement(quaternion=(np.cos(half), 0, 0, np.sin(half)), position=(*at, height))


def around(count: int, side: int) -> list[Camera]:
    """Cameras spread evenly over the upper hemisphere (a golden spiral)."""
    z = 0.03 + 0.95 * (np.arange(count) + 0.5) / count
    phi = (np.arange(count) + 0.5) * np.pi * (3 - np.sqrt(5))
    directions = np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], axis=-1)
    target = np.array([0, 0, 0.5])
    return [
        Camera.look_at(4.4 * d + target, target=target, fov_deg=46, width=side, height=side)
        for d in directions
    ]


def view(width: int, height: int) -> Camera:
    """The camera of the picture."""
    return Camera.look_at((0.35, -5.3, 1.5), (0.06, 0, 0.82), fov_deg=38.5, width=width, height=height)


def models_on_a_table(data: Path) -> Geometry:
    """The meshes and materials."""
    models = {name: load_model(data / "assets" / name) for name, *_ in MODELS}
    objects = [
        ObjectSpec(asset=name, size=size, placement=standing(models[name], size, at, turn))
        for name, size, at, turn in MODELS
    ]
    drawn = draw_scene(0, "train", 0, style="object", lights=["overcast"])
    (floor,) = drawn.surroundings
    assert floor.shape is not None
    shape = floor.shape.model_copy(update={"size": FLOOR_SIZE})
    floor = floor.model_copy(update={"shape": shape, "size": FLOOR_SIZE, "materials": (FLOOR,)})
    return build(drawn.model_copy(update={"objects": tuple(objects), "surroundings": (floor,)}), models, 0.1)


def main(data: Path, output: Path, comparison: Path) -> None:
    """Make the surfels, light them, write the pictures."""
    geometry = models_on_a_table(data)
    environment = EnvironmentMap.load(data / "hdri" / f"{LIGHT}.hdr", TURN_DEG)
    scene = surfels_from_gbuffers(gbuffers(geometry, around(VIEWS, VIEW_SIDE)), count=SURFELS)
    lit = Relighter(scene, ESTIMATION).under(environment).render(view(*SIZE)).lit
    exposure = BRIGHTER * environment.exposure()
    write_image(output, to_display(lit, exposure))

    width, height = (side // 2 for side in SIZE)
    small = lit.reshape(height, 2, width, 2, 3).mean(axis=(1, 3))
    (truth,) = render_frames(geometry.lit(environment), [view(width, height)], PATHS, [0])
    pair = [to_display(image, exposure) for image in (small, truth)]
    write_image(comparison, np.concatenate(pair, axis=1).astype(np.float32))


if __name__ == "__main__":
    main(*(Path(each) for each in sys.argv[1:] if each != "--small"))
