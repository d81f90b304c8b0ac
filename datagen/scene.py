"""SceneSpec: everything a synthetic scene is, as pure data drawn from a seed.

A scene is named by its split and index; its specification depends on (root seed, split, index) and the recipe
of the split alone. What it is rendered with (resolution, samples) is the run's business and not part of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pydantic import Field
from trimesh import Trimesh

from datagen.layout import Placement, place
from datagen.lights import FAMILIES, PROCEDURAL, Family, HdriSpec, LightChoice, LightSpec
from datagen.materials import MaterialSpec, Style, draw_material
from datagen.shapes import ShapeSpec, draw_shape, make_mesh
from datagen.spec import Number, Spec, Triple
from tron.cameras import Camera
from tron.errors import TronError
from tron.seeds import generator
from tron.trajectories import oscillating, spiral

SPEC_VERSION = 1
LAYOUT_EDGE = 0.5
"""Edge length of the meshes that objects are placed with: only their convex hulls matter there."""

FEWEST_OBJECTS = 2
SCENE_RADIUS = 1.45
"""World units from the origin within which objects stand: all of them in view from every camera."""


class ObjectSpec(Spec):
    """One object: a procedural shape with its material, or a user's asset scaled to a ball of ``size``."""

    shape: ShapeSpec | None = None
    material: MaterialSpec | None = None
    asset: str | None = None
    size: Number
    placement: Placement


class FloorSpec(Spec):
    """A square in the plane z = 0 around the origin; a side is twice ``half_size`` world units."""

    half_size: Number
    material: MaterialSpec


class CameraSpec(Spec):
    """Paths of the cameras; angles in degrees, lengths in world units.

    The spiral is what surfels are made from; the oscillating path is what is path-traced. ``first_frame``
    says, for each light, where on the path its clip begins.
    """

    target: Triple
    fov_deg: Number
    spiral_radius: Number
    spiral_phase: Number
    path_radius: Number
    path_elevation_deg: Number
    path_amplitude_deg: Number
    path_azimuth_deg: tuple[Number, Number]
    path_frames: int
    first_frame: tuple[int, ...]


class SceneSpec(Spec):
    """One scene: objects on a floor, lights, cameras. ``left_out`` counts objects that found no place."""

    version: int = SPEC_VERSION
    name: str
    split: str
    index: int
    seed: int
    style: Style
    objects: tuple[ObjectSpec, ...]
    left_out: int
    floor: FloorSpec
    lights: tuple[LightSpec, ...] = Field(min_length=1)
    cameras: CameraSpec

    def spiral(self, count: int, width: int, height: int) -> list[Camera]:
        """The ``count`` cameras that surfels are made from."""
        c = self.cameras
        return spiral(
            count,
            target=c.target,
            radius=c.spiral_radius,
            width=width,
            height=height,
            fov_deg=c.fov_deg,
            phase=c.spiral_phase,
        )

    def clip(self, light: int, frames: int, width: int, height: int) -> list[Camera]:
        """The consecutive cameras of the clip under light number ``light``."""
        c = self.cameras
        path = oscillating(
            c.path_frames,
            target=c.target,
            radius=c.path_radius,
            width=width,
            height=height,
            fov_deg=c.fov_deg,
            elevation_deg=c.path_elevation_deg,
            amplitude_deg=c.path_amplitude_deg,
            azimuth_deg=c.path_azimuth_deg,
        )
        first = c.first_frame[light]
        return path[first : first + frames]


def scene_name(split: str, index: int) -> str:
    """A scene's name within a dataset, e.g. ``train-000012``."""
    return f"{split}-{index:06d}"


def draw_scene(
    seed: int,
    split: str,
    index: int,
    *,
    style: Style,
    lights: Sequence[LightChoice],
    families: Sequence[Family] = PROCEDURAL,
    environments: Sequence[HdriSpec] = (),
    assets: Mapping[str, Trimesh] | None = None,
    asset_share: float = 1.0,
    objects: tuple[int, int] | None = None,
    frames: int = 5,
    path_frames: int = 93,
) -> SceneSpec:
    """Draw scene ``index`` of a split.

    Args:
        seed: the run's root seed.
        split, index: which scene; they name its random stream.
        style: distribution of shapes, materials, counts and floor.
        lights: a family for each light of the scene; ``any`` draws one of ``families``.
        families: what ``any`` chooses from.
        environments: files for the family ``hdri``.
        assets: id -> mesh in a unit ball, z up, standing; None or empty means procedural shapes only.
        asset_share: probability that an object is an asset, where there are any.
        objects: least and greatest number of objects; None takes the style's own.
        frames, path_frames: length of a clip and of the path it is cut from.

    Raises:
        TronError: fewer objects found a place than make a scene, or a clip is longer than its path.
    """
    if frames > path_frames:
        raise TronError(
            f"a clip of {frames} frames does not fit a path of {path_frames}", mend="raise path_frames"
        )
    counts, sizes = {"A": ((3, 7), (0.4, 0.85)), "B": ((2, 4), (0.55, 1.0))}[style]
    low, high = objects or counts
    rng = generator(seed, split, index, "objects")
    drawn: list[tuple[ShapeSpec | None, str | None, float]] = []
    meshes: list[Trimesh] = []
    names = sorted(assets or {})
    for _ in range(int(rng.integers(low, high + 1))):
        if assets and rng.random() < asset_share:
            name, size = names[int(rng.integers(len(names)))], round(float(rng.uniform(*sizes)), 6)
            drawn.append((None, name, size))
            meshes.append(assets[name].copy().apply_scale(size))
        else:
            shape = draw_shape(rng, style, sizes)
            drawn.append((shape, None, shape.size))
            meshes.append(make_mesh(shape, LAYOUT_EDGE))
    upright = [shape is None for shape, _, _ in drawn]
    places = place(generator(seed, split, index, "layout"), meshes, SCENE_RADIUS, upright=upright)
    rng = generator(seed, split, index, "materials")
    materials = [draw_material(rng, style) if shape else None for shape, _, _ in drawn]
    placed = tuple(
        ObjectSpec(shape=shape, asset=asset, size=size, material=material, placement=spot)
        for (shape, asset, size), material, spot in zip(drawn, materials, places)
        if spot is not None
    )
    if len(placed) < min(FEWEST_OBJECTS, len(drawn)):
        raise TronError(f"only {len(placed)} of {len(drawn)} objects found a place on the floor", split)
    floor = generator(seed, split, index, "floor")
    return SceneSpec(
        name=scene_name(split, index),
        split=split,
        index=index,
        seed=seed,
        style=style,
        objects=placed,
        left_out=len(drawn) - len(placed),
        floor=FloorSpec(
            half_size=3.0 if style == "A" else 2.6, material=draw_material(floor, style, floor=True)
        ),
        lights=tuple(_draw_lights(seed, split, index, lights, families, environments)),
        cameras=_draw_cameras(seed, split, index, len(lights), frames, path_frames),
    )


def _draw_lights(
    seed: int,
    split: str,
    index: int,
    lights: Sequence[LightChoice],
    families: Sequence[Family],
    environments: Sequence[HdriSpec],
) -> list[LightSpec]:
    drawn = []
    for k, wanted in enumerate(lights):
        rng = generator(seed, split, index, "light", k)
        family = families[int(rng.integers(len(families)))] if wanted == "any" else wanted
        drawn.append(FAMILIES[family].draw(rng, environments))
    return drawn


def _draw_cameras(
    seed: int, split: str, index: int, lights: int, frames: int, path_frames: int
) -> CameraSpec:
    rng = generator(seed, split, index, "cameras")
    start = rng.uniform(0.0, 360.0)
    return CameraSpec(
        target=(0.0, 0.0, 0.3),
        fov_deg=34.0,
        spiral_radius=6.4,
        spiral_phase=rng.uniform(0.0, 360.0),
        path_radius=rng.uniform(5.8, 6.6),
        path_elevation_deg=rng.uniform(24.0, 34.0),
        path_amplitude_deg=rng.uniform(8.0, 15.0),
        path_azimuth_deg=(start, start + 321.0),
        path_frames=path_frames,
        first_frame=tuple(int(rng.integers(path_frames - frames + 1)) for _ in range(lights)),
    )
