"""A style's scenes hold things at rest, and cameras that touch nothing and see them."""

from functools import cache

import numpy as np
import pytest

from datagen.settings.command import Settings
from datagen.world.objects import Placement
from datagen.world.paths import WalkPath
from datagen.world.scene import SceneSpec, draw_scene
from datagen.world.settling import Body
from datagen.world.shapes import SHAPES, Standing, make_pieces, standing
from datagen.world.styles import MIXED, STYLES, Choice
from datagen.world.styles.cameras import Obstacles, unhindered
from tron.cli.recipes import check, compose_recipe
from tron.errors import TronError
from tron.seeds import generator

INDICES = {"object": (0, 1), "table": (0, 1), "room": (0, 1), "ground": (0,)}


@cache
def draw(style, index, objects=None):
    choice = Choice(objects=objects) if objects else None
    return draw_scene(
        11, "train", index, style=style, lights=["overcast"], choice=choice, frames=2, path_frames=12
    )


def world_vertices(item) -> np.ndarray:
    matrix = item.placement.matrix()
    vertices = np.concatenate([piece.mesh.vertices for piece in make_pieces(item.shape, 0.1)])
    return vertices @ matrix[:3, :3].T + matrix[:3, 3]


def test_a_scene_survives_its_json_and_is_the_same_again():
    for style in INDICES:
        spec = draw(style, 0)
        assert SceneSpec.model_validate_json(spec.to_json()) == spec
    assert draw.__wrapped__("table", 0).to_json() == draw("table", 0).to_json()


@pytest.mark.parametrize("style", INDICES)
def test_every_slot_has_a_material_of_its_role_and_every_thing_stands_on_the_ground(style):
    for index in INDICES[style]:
        spec = draw(style, index)
        assert spec.objects
        (under,) = spec.surroundings
        ground = standing(under.shape)
        lift = under.placement.position[2]
        for item in (*spec.surroundings, *spec.objects):
            assert len(item.materials) == len(SHAPES[item.shape.kind].roles)
        for item in spec.objects:
            vertices = world_vertices(item)
            below = ground.height(vertices[:, :2]) + lift - vertices[:, 2]
            assert below.max() < 0.05 * item.size + 0.02, (index, item.shape.kind)


@pytest.mark.parametrize("style", INDICES)
def test_no_camera_stands_within_a_thing_or_under_the_ground(style):
    for index in INDICES[style]:
        spec = draw(style, index)
        ground, lift = standing(spec.surroundings[0].shape), spec.surroundings[0].placement.position[2]
        things = np.concatenate([world_vertices(item) for item in spec.objects])
        for camera in [*spec.views(24, 8, 8), *spec.clip(0, 2, 8, 8)]:
            x, y, z = camera.position
            if style in ("room", "ground"):
                assert np.linalg.norm(things - camera.position, axis=1).min() > 0.05
                assert z > ground.height(np.array([[x, y]]))[0] + lift
            else:
                assert z > 0


@pytest.mark.parametrize("style", INDICES)
def test_every_clip_sees_some_thing(style):
    for index in INDICES[style]:
        spec = draw(style, index)
        things = np.concatenate([world_vertices(item) for item in spec.objects])
        for camera in spec.cameras.film.cameras(12, 64, 64):
            pixels, depth = camera.project(things)
            assert ((depth > 0) & (pixels >= 0).all(1) & (pixels < 64).all(1)).any()


def test_the_recipe_says_how_many_things_there_are():
    spec = draw("table", 1, (3, 3))
    assert len(spec.objects) + spec.left_out == 3
    assert len(draw("object", 0).objects) == 1


@pytest.mark.parametrize("style", ["table", "room"])
def test_the_recipe_says_of_what_kinds_and_materials_they_are(style):
    choice = Choice(objects=(4, 4), things=("vase", "book"), materials=("metal", "paint"))
    drawn = [
        draw_scene(seed, "train", 0, style=style, lights=["overcast"], choice=choice, frames=2, path_frames=2)
        for seed in range(2)
    ]
    objects = [item for spec in drawn for item in spec.objects]
    assert {item.shape.kind for item in objects} == {"vase", "book"}
    of_all = [item for spec in drawn for item in (*spec.surroundings, *spec.objects)]
    assert {material.family for item in of_all for material in item.materials} == {"metal", "paint"}


def test_unknown_kinds_and_families_are_refused_with_those_that_there_are():
    for key, known in (("things", "'vase'"), ("materials", "'metal'")):
        words = [f"train.{key}=[floor]", "output_dir=data"]
        with pytest.raises(TronError, match=known):
            check(compose_recipe("conf.datagen", Settings, words), Settings)


@pytest.mark.long
def test_mixed_draws_each_of_its_styles_and_only_rooms_are_metered():
    drawn = [draw("mixed", index) for index in range(14)]
    assert {spec.style for spec in drawn} == set(MIXED) == set(INDICES) <= set(STYLES)
    assert all(spec.metered == (spec.style == "room") for spec in drawn)


def test_paths_that_touch_a_thing_are_drawn_again_and_at_last_given_up():
    flat = Standing(np.array([-3.0, -3.0, 0.0]), np.array([3.0, 3.0, np.inf]))
    (piece,) = make_pieces(draw("object", 0).objects[0].shape.model_copy(update={"kind": "sphere"}), 0.1)
    ball = (Body([piece.mesh]), Placement(quaternion=(1, 0, 0, 0), position=(0, 0, 1.0)))
    obstacles, tries = Obstacles([ball], flat), []

    def walk(height):
        return WalkPath(fov_deg=50, positions=((-2, 0, height), (2, 0, height)), targets=((0, 1, 1),) * 2)

    def draw_path(_rng, ease):
        tries.append(ease)
        return walk(1.0 if len(tries) < 3 else 2.9)

    path = unhindered(generator(0, "p"), draw_path, obstacles, 0.3, 0.2)
    assert path == walk(2.9)
    assert tries[:2] == sorted(tries[:2])
    assert not obstacles.leave(walk(0.1), 0.0, 0.2), "too near the ground"
    indoors = Obstacles([ball], Standing(flat.low, np.array([3.0, 3.0, 3.0])))
    assert indoors.leave(walk(2.89), 0.3, 0.2), "half as near to a ceiling"
    assert not indoors.leave(walk(2.92), 0.3, 0.2)
    with pytest.raises(TronError, match="no camera path"):
        unhindered(generator(0, "p"), lambda _rng, _ease: walk(1.0), obstacles, 0.3, 0.2)
