"""A specification is pure data that depends on (seed, split, index) alone."""

import hashlib
from functools import cache

import numpy as np
import pytest

from datagen.world.lights import USUAL
from datagen.world.scene import SceneSpec, draw_scene
from tron.errors import TronError

LIGHTS = ("any", "sun", "studio", "overcast")


@cache
def draw(seed=0, split="train", index=0, **changes):
    return draw_scene(
        seed, split, index, **{"style": "object", "lights": LIGHTS, "frames": 5, "path_frames": 24} | changes
    )


def test_a_specification_is_the_same_bytes_on_every_machine():
    text = draw().to_json()
    assert hashlib.sha256(text.encode()).hexdigest()[:16] == "915a656e32a6a928", (
        "the distribution changed: is that meant?"
    )


def test_a_specification_survives_its_json():
    spec = draw(style="table", split="train_b", index=3)
    assert SceneSpec.model_validate_json(spec.to_json()) == spec
    assert SceneSpec.model_validate_json(spec.to_json()).to_json() == spec.to_json()


def test_seed_split_and_index_each_change_the_scene_and_nothing_else_does():
    first = draw().to_json()
    others = [draw(seed=1), draw(split="test"), draw(index=1)]
    assert len({first, *(other.to_json() for other in others)}) == 4
    assert draw.__wrapped__().to_json() == first


def test_more_lights_leave_objects_floor_and_earlier_lights_alone():
    few, many = draw(lights=LIGHTS[:2]), draw(lights=LIGHTS)
    assert many.objects == few.objects
    assert many.surroundings == few.surroundings
    assert many.lights[:2] == few.lights


def test_lights_are_the_families_asked_for():
    families = [light.family for light in draw().lights]
    assert families[1:] == ["sun", "studio", "overcast"]
    seen = {light.family for i in range(3) for light in draw(index=i, lights=("any",) * 16).lights}
    assert seen == set(USUAL)


def test_camera_paths_stay_above_the_floor_and_see_the_middle():
    spec = draw()
    for camera in [*spec.views(16, 32, 32), *spec.clip(2, 5, 32, 32)]:
        assert camera.position[2] > 0.1
        pixels, depth = camera.project(np.array([spec.cameras.film.target]))
        np.testing.assert_allclose(pixels, [[16, 16]], atol=1e-6)
        assert depth[0] > 1


def test_a_clip_is_consecutive_frames_of_the_path():
    spec = draw(lights_share_path=False)
    whole = [camera.position for camera in draw(frames=24).clip(1, 24, 8, 8)]
    first = spec.cameras.first_frame
    assert isinstance(first, tuple)
    first = first[1]
    for camera, expected in zip(spec.clip(1, 5, 8, 8), whole[first : first + 5]):
        np.testing.assert_allclose(camera.position, expected)


def test_lights_that_share_a_path_are_filmed_from_the_same_places():
    own, shared = draw(lights_share_path=False), draw()
    assert isinstance(own.cameras.first_frame, tuple)
    assert len(set(own.cameras.first_frame)) > 1
    assert own.groups() == [[k] for k in range(len(own.lights))]
    assert shared.groups() == [list(range(len(shared.lights)))]
    assert shared.cameras.first_frame == own.cameras.first_frame[0]
    first, last = (shared.clip(k, 5, 8, 8) for k in (0, len(shared.lights) - 1))
    assert [camera.to_dict() for camera in first] == [camera.to_dict() for camera in last]
    assert type(shared).model_validate_json(shared.to_json()) == shared
    changed = shared.model_copy(update={"cameras": own.cameras})
    assert changed == own, "nothing else of the scene changes"


def test_a_clip_longer_than_its_path_is_an_error():
    with pytest.raises(TronError, match="path_frames"):
        draw(frames=30)
