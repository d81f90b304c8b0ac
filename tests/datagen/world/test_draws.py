"""Worlds hold what people bring as often as they do: rough metals, sheets of one polygon, relief."""

from collections import Counter
from importlib import import_module

import numpy as np
import pytest

from datagen.truth.build import build
from datagen.truth.pathtrace import gbuffers
from datagen.world.materials.material import Unsaid
from datagen.world.objects import Placement
from datagen.world.scene import SceneSpec, draw_scene
from datagen.world.shapes.sheets import SHEETS
from datagen.world.styles import Choice
from tron.seeds import generator

TABLE, HERO, THINGS = (import_module(f"datagen.world.styles.{name}") for name in ("table", "hero", "things"))
SCENES = 200


def stood(_rng, bodies, *_args, **_settings):
    return [Placement(quaternion=(1, 0, 0, 0), position=(0, 0, 0))] * len(bodies)


@pytest.fixture(scope="module")
def specs():
    """Scenes whose things do not fall, which is most of what drawing takes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TABLE, "settle", stood)
        patch.setattr(HERO, "settle", stood)
        patch.setattr(THINGS, "make_pieces", lambda *_: [])
        return [
            draw_scene(48, "train", i, style=("object", "table")[i % 2], lights=["overcast"], frames=1)
            for i in range(SCENES)
        ]


@pytest.fixture(scope="module")
def things(specs):
    return [item for spec in specs for item in spec.objects]


@pytest.fixture(scope="module")
def surfaces(things):
    """Mean metallic and median roughness of what each thing is made of, (N, 2)."""
    rng = generator(48, "points")
    points, normals = rng.uniform(-0.5, 0.5, (60, 3)), rng.normal(size=(60, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    found = []
    for item in things:
        for material in item.materials:
            seen = (Unsaid(material) if item.unsaid else material).evaluate(points, normals)
            found.append((seen.metallic.mean(), np.median(seen.roughness)))
    return np.array(found)


def test_metals_are_of_every_roughness_and_the_roughest_are_common(surfaces):
    metal = surfaces[:, 0] > 0.5
    assert 0.14 < metal.mean() < 0.26
    rough = surfaces[metal, 1]
    shares = np.histogram(rough, [0, 0.3, 0.5, 0.8, 1.01])[0] / len(rough)
    assert (shares > [0.05, 0.1, 0.02, 0.4]).all(), shares


def test_one_thing_in_ten_says_nothing_of_metal_and_roughness(things):
    assert 0.07 < np.mean([item.unsaid for item in things]) < 0.13
    named = Choice(materials=("paint",), things=("box",))
    drawn = [THINGS.draw_thing(generator(i, "named"), ((),), (0.5, 0.6), named) for i in range(40)]
    assert not any(thing.unsaid for thing in drawn), "who names materials gets those"


def test_one_thing_in_seven_is_a_sheet(things):
    kinds = Counter(item.shape.kind for item in things)
    sheets = {*SHEETS, "foliage"}
    assert all(kinds[kind] for kind in sheets)
    assert 0.1 < sum(kinds[kind] for kind in sheets) / len(things) < 0.2


def test_a_fifth_of_the_floors_or_more_is_relief_of_geometry(specs):
    under = Counter(spec.surroundings[0].shape.kind for spec in specs)
    assert 0.15 < under["cobbles"] / len(specs) < 0.35
    assert under["floor"] > under["cobbles"], "others have theirs in their normals"


def test_objects_written_before_say_what_their_materials_say(specs):
    text = specs[0].to_json()
    assert '"unsaid"' in text
    before = "\n".join(line for line in text.splitlines() if '"unsaid"' not in line)
    assert not any(item.unsaid for item in SceneSpec.model_validate_json(before).objects)


def test_what_says_nothing_is_built_as_metal_of_roughness_1(variant, specs):
    spec = specs[0]
    (thing,) = spec.objects
    camera = spec.clip(0, 1, 24, 24)[0]
    found = {}
    for unsaid in (False, True):
        item = thing.model_copy(update={"unsaid": unsaid})
        alone = spec.model_copy(update={"surroundings": (), "objects": (item,)})
        (found[unsaid],) = gbuffers(build(alone, edge=0.2, texels_per_unit=16), [camera])
    said, metal = found[False], found[True]
    assert said.valid.sum() > 20
    for name in ("metallic", "roughness"):
        np.testing.assert_allclose(getattr(metal, name)[metal.valid], 1, atol=1e-4)
    assert (said.roughness[said.valid] < 0.96).all()
    for name in ("base_color", "normal"):
        np.testing.assert_allclose(getattr(metal, name), getattr(said, name), atol=1e-4)
