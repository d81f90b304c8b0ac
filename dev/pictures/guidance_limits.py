"""Pictures of docs/concepts/light.md: what `lit` cannot, beside the path tracer, three small scenes.

    python dev/pictures/guidance_limits.py docs/images/guidance-limits.jpg

Two minutes on two cores (``--small``: a tiny one, some seconds); nothing but what the data engine makes.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from tron.runtime import activate

activate("llvm_ad_rgb")

import mitsuba as mi  # noqa: E402

from datagen.truth.build import build  # noqa: E402
from datagen.truth.pathtrace import gbuffers, render_frames  # noqa: E402
from datagen.world.materials import Appearance, Material  # noqa: E402
from datagen.world.objects import ObjectSpec, Placement  # noqa: E402
from datagen.world.scene import SceneSpec, draw_scene  # noqa: E402
from datagen.world.shapes import ShapeSpec  # noqa: E402
from tron.cameras import Camera  # noqa: E402
from tron.color import to_display  # noqa: E402
from tron.gaussians import GaussianScene  # noqa: E402
from tron.gaussians.initialize import surfels_from_gbuffers  # noqa: E402
from tron.io.images import write_image  # noqa: E402
from tron.relighting import EnvironmentMap, Estimation, Relighter  # noqa: E402
from tron.report.contact_sheet import labelled_sheet  # noqa: E402
from tron.trajectories import spiral  # noqa: E402

SMALL = "--small" in sys.argv
SIZE = (32, 24) if SMALL else (288, 216)
PATHS = 4 if SMALL else 196
SURFELS = 1_000 if SMALL else 60_000
VIEWS, VIEW_SIDE = (6, 32) if SMALL else (32, 384)
ESTIMATION = Estimation(rays=8 if SMALL else 64, reflections=8, supersample=2)
VIEW = Camera.look_at((0.6, -4.4, 2.3), target=(0, 0, 0.35), fov_deg=32, width=SIZE[0], height=SIZE[1])
GLASS_AT, GLASS_RADIUS = (-0.55, 0.0, 0.55), 0.55


class Plain(Material):
    """One colour everywhere, or squares of one world unit of it and another."""

    family: str = "plain"
    color: tuple[float, float, float]
    other: tuple[float, float, float] | None = None
    roughness: float
    metallic: float

    def evaluate(self, points: np.ndarray, normals: np.ndarray) -> Appearance:  # noqa: ARG002
        full = np.ones(len(points), np.float32)
        odd = np.floor(2.0 * points[:, :2] + 0.25).sum(axis=1) % 2.0
        color = np.where(odd[:, None] == 0.0, self.color, self.other or self.color)
        return Appearance(color.astype(np.float32), self.roughness * full, self.metallic * full, 0.0 * full)


def plain(color: tuple[float, float, float], roughness: float, metallic: float) -> Plain:
    """A material of one colour."""
    return Plain(color=color, roughness=roughness, metallic=metallic)


def thing(kind: str, size: float, at: tuple[float, float, float], material: Plain) -> ObjectSpec:
    """A procedural object, upright."""
    shape = ShapeSpec(kind=kind, size=size, parameters=(0.2, 0.5, 0.5, 0.5))
    placement = Placement(quaternion=(1, 0, 0, 0), position=at)
    item = ObjectSpec(shape=shape, size=size, placement=placement)
    return item.model_copy(update={"materials": (material,)})


def made(*objects: ObjectSpec) -> SceneSpec:
    """The objects on a floor of squares."""
    drawn = draw_scene(0, "train", 0, style="object", lights=["sun"])
    squares = Plain(color=(0.5, 0.45, 0.4), other=(0.16, 0.17, 0.2), roughness=0.6, metallic=0)
    (floor,) = drawn.surroundings
    assert floor.shape is not None
    size = 2.6 * np.sqrt(2)
    shape = floor.shape.model_copy(update={"size": size})
    floor = floor.model_copy(update={"shape": shape, "size": size, "materials": (squares,)})
    return drawn.model_copy(update={"objects": objects, "surroundings": (floor,)})


def surfels(spec: SceneSpec) -> GaussianScene:
    """Surfels from the scene's true G-buffers."""
    cameras = spiral(VIEWS, target=(0, 0, 0.3), radius=5.5, width=VIEW_SIDE, height=VIEW_SIDE, fov_deg=40)
    return surfels_from_gbuffers(gbuffers(build(spec, edge=0.04), cameras), count=SURFELS)


def lit(scene: GaussianScene, light: EnvironmentMap) -> np.ndarray:
    """Our picture, radiance."""
    return Relighter(scene, ESTIMATION).under(light).render(VIEW).lit


def from_photographs(scene: GaussianScene, light: EnvironmentMap) -> GaussianScene:
    """What a plain 3DGS file of the scene under ``light`` says of it: colours, not what they are made of."""
    bounced = Relighter(scene).under(light).bounced
    assert bounced is not None
    shone = np.array(bounced.outgoing).T
    return replace(
        scene,
        base_color=np.clip(shone * 1.4 * light.exposure(), 0, 1),
        roughness=np.full(len(scene), 0.7),
        metallic=np.zeros(len(scene)),
    )


def main(output: Path) -> None:
    """Render the three rows."""
    gold, chrome, red = (
        plain((1.0, 0.72, 0.32), 0.06, 1),
        plain((0.95, 0.95, 0.95), 0.03, 1),
        (0.7, 0.1, 0.06),
    )
    ring = thing("torus", 0.75, (-0.75, -0.1, 0.24), gold)
    ball = thing("sphere", 0.5, (0.75, 0.1, 0.5), chrome)
    clay = thing("sphere", 0.45, (0.75, 0.1, 0.45), plain(red, 0.6, 0))
    white = thing("sphere", GLASS_RADIUS, GLASS_AT, plain((0.9, 0.9, 0.9), 0.05, 0))
    sun = made().lights[0].bake(256)

    def path_traced(spec: SceneSpec, **shapes: dict) -> np.ndarray:
        scene = {"type": "scene", "environment": sun.to_mitsuba(), **shapes}
        scene |= {f"surface{i}": surface.shape for i, surface in enumerate(build(spec, edge=0.04).surfaces)}
        return render_frames(mi.load_dict(scene), [VIEW], PATHS, [1], bounces=10)[0]

    metals, opaque = made(ring, ball), made(white, clay)
    to_world = mi.ScalarTransform4f().translate(GLASS_AT)
    glass = {"type": "sphere", "radius": GLASS_RADIUS, "to_world": to_world, "bsdf": {"type": "dielectric"}}
    known = surfels(made(ring.model_copy(update={"materials": (plain((0.2, 0.45, 0.2), 0.5, 0),)}), clay))
    guessed = from_photographs(known, sun.rotated(150))
    rows = {
        "mirrors, caustics": (path_traced(metals), lit(surfels(metals), sun)),
        "glass": (path_traced(made(clay), glass=glass), lit(surfels(opaque), sun)),
        "colours for\nmaterials": (lit(known, sun), lit(guessed, sun)),
    }
    shown = {name: [to_display(image, sun.exposure()) for image in pair] for name, pair in rows.items()}
    write_image(
        output, labelled_sheet(shown, ["as it should be", "lit"], width=SIZE[0]).astype(np.float32) / 255
    )


if __name__ == "__main__":
    main(*(Path(each) for each in sys.argv[1:] if each != "--small"))
