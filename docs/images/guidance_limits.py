"""The pictures of docs/guidance.md that show what `lit` cannot: beside the path tracer, three small scenes.

    python docs/images/guidance_limits.py docs/images/guidance-limits.jpg

Two minutes on two cores; nothing but what the data engine makes.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from tron.runtime import activate

activate("llvm_ad_rgb")

import mitsuba as mi  # noqa: E402

from datagen.build import build  # noqa: E402
from datagen.layout import Placement  # noqa: E402
from datagen.materials import MaterialSpec  # noqa: E402
from datagen.pathtrace import gbuffers, render_frames  # noqa: E402
from datagen.scene import ObjectSpec, SceneSpec, draw_scene  # noqa: E402
from datagen.shapes import ShapeKind, ShapeSpec  # noqa: E402
from tron.apps.labelled_sheet import labelled_sheet  # noqa: E402
from tron.cameras import Camera  # noqa: E402
from tron.color import to_display  # noqa: E402
from tron.gaussians import GaussianScene  # noqa: E402
from tron.gaussians.initialize import surfels_from_gbuffers  # noqa: E402
from tron.images import write_image  # noqa: E402
from tron.shading import BounceTransport, EnvironmentMap, Estimation, Lighting, render_guidance  # noqa: E402
from tron.tracing import SurfelTracer  # noqa: E402
from tron.trajectories import spiral  # noqa: E402

SIZE = (288, 216)
PATHS = 196
SURFELS = 60_000
ESTIMATION = Estimation(rays=64, reflections=8, supersample=2)
VIEW = Camera.look_at((0.6, -4.4, 2.3), target=(0, 0, 0.35), fov_deg=32, width=SIZE[0], height=SIZE[1])
GLASS_AT, GLASS_RADIUS = (-0.55, 0.0, 0.55), 0.55


def plain(color: tuple[float, float, float], roughness: float, metallic: float) -> MaterialSpec:
    """A material of one colour."""
    return MaterialSpec(
        pattern="plain", frequency=1, axis=(1, 0, 0), phase=(0, 0, 0), color_a=color, color_b=color,
        roughness=(roughness, roughness), metallic=(metallic, metallic),
    )  # fmt: skip


def thing(kind: ShapeKind, size: float, at: tuple[float, float, float], material: MaterialSpec) -> ObjectSpec:
    """A procedural object, upright."""
    shape = ShapeSpec(kind=kind, size=size, parameters=(0.2, 0.5, 0.5, 0.5))
    return ObjectSpec(
        shape=shape, material=material, size=size, placement=Placement(quaternion=(1, 0, 0, 0), position=at)
    )


def made(*objects: ObjectSpec) -> SceneSpec:
    """The objects on a floor of squares."""
    drawn = draw_scene(0, "train", 0, style="A", lights=["sun"])
    squares = plain((0.5, 0.45, 0.4), 0.6, 0).model_copy(
        update={"pattern": "checker", "frequency": 1.0, "color_b": (0.16, 0.17, 0.2)}
    )
    floor = drawn.floor.model_copy(update={"half_size": 2.6, "material": squares})
    return drawn.model_copy(update={"objects": objects, "floor": floor})


def surfels(spec: SceneSpec) -> GaussianScene:
    """Surfels from the scene's true G-buffers."""
    cameras = spiral(32, target=(0, 0, 0.3), radius=5.5, width=384, height=384, fov_deg=40)
    return surfels_from_gbuffers(gbuffers(build(spec, edge=0.04), cameras), count=SURFELS)


def lit(scene: GaussianScene, light: EnvironmentMap) -> np.ndarray:
    """Our picture, radiance."""
    tracer, lighting = SurfelTracer(scene), Lighting(light)
    bounce = BounceTransport.trace(tracer).bake(lighting, ESTIMATION)
    return render_guidance(tracer, VIEW, lighting, ESTIMATION, bounce=bounce).lit


def from_photographs(scene: GaussianScene, light: EnvironmentMap) -> GaussianScene:
    """What a plain 3DGS file of the scene under ``light`` says of it: colours, not what they are made of."""
    lighting = Lighting(light)
    shone = np.array(BounceTransport.trace(SurfelTracer(scene)).bake(lighting).outgoing).T
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
        return render_frames(mi.load_dict(scene), [VIEW], PATHS, [1], max_depth=12)[0]

    metals, opaque = made(ring, ball), made(white, clay)
    to_world = mi.ScalarTransform4f().translate(GLASS_AT)
    glass = {"type": "sphere", "radius": GLASS_RADIUS, "to_world": to_world, "bsdf": {"type": "dielectric"}}
    known = surfels(made(ring.model_copy(update={"material": plain((0.2, 0.45, 0.2), 0.5, 0)}), clay))
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
    main(Path(sys.argv[1]))
