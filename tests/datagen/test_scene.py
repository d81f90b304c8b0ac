"""A specification is pure data that depends on (seed, split, index) alone; objects rest and do not touch."""

import hashlib
from functools import cache
from itertools import combinations

import numpy as np
import pytest

from datagen.layout import GAP, place, settle
from datagen.scene import SceneSpec, draw_scene
from datagen.shapes import ShapeSpec, make_pieces, split_creases
from datagen.styles import Choice
from datagen.styles.primitives import DISTRIBUTIONS
from tron.errors import TronError
from tron.seeds import generator

LIGHTS = ("any", "sun", "studio", "overcast")
KINDS = [kind for each in DISTRIBUTIONS.values() for kind in each.kinds]


def solid(shape, edge):
    (piece,) = make_pieces(shape, edge)
    return piece.mesh


@cache
def draw(seed=0, split="train", index=0, **changes):
    return draw_scene(
        seed, split, index, **{"style": "A", "lights": LIGHTS, "frames": 5, "path_frames": 24} | changes
    )


def test_a_specification_is_the_same_bytes_on_every_machine():
    text = draw().to_json()
    assert hashlib.sha256(text.encode()).hexdigest()[:16] == "9d9730c58646315b", (
        "the distribution changed: is that meant?"
    )


def test_a_specification_survives_its_json():
    spec = draw(style="B", split="train_b", index=3)
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


def test_styles_share_no_shape():
    kinds = {
        style: {o.shape.kind for i in range(6) for o in draw(style=style, index=i).objects if o.shape}
        for style in "AB"
    }
    assert kinds["A"]
    assert kinds["B"]
    assert not kinds["A"] & kinds["B"]


def test_lights_are_the_families_asked_for():
    families = [light.family for light in draw().lights]
    assert families[1:] == ["sun", "studio", "overcast"]
    seen = {light.family for i in range(8) for light in draw(index=i, lights=("any",) * 3).lights}
    assert seen == {"sun", "studio", "overcast"}


def test_objects_rest_on_the_floor_and_keep_their_distance():
    for index in range(4):
        meshes = [
            solid(o.shape, 0.1).apply_transform(o.placement.matrix())
            for o in draw(index=index).objects
            if o.shape is not None
        ]
        assert len(meshes) >= 2
        for mesh in meshes:
            assert mesh.vertices[:, 2].min() == pytest.approx(0.0, abs=1e-5)
        for a, b in combinations(meshes, 2):
            # Independent of FCL: every vertex of one is beyond some face plane of the other's hull.
            hull = a.convex_hull
            beyond = np.einsum("vfi,fi->vf", b.vertices[:, None] - hull.triangles_center, hull.face_normals)
            assert beyond.max(axis=1).min() > 0.25 * GAP


def test_what_finds_no_place_is_left_out_and_the_rest_stays():
    balls = [
        solid(ShapeSpec(kind="sphere", size=0.5, parameters=(0.5, 0.5, 0.5, 0.5)), 0.5) for _ in range(8)
    ]
    placements = place(generator(0, "layout"), balls, radius=0.4)
    assert placements[0] is not None
    assert placements.count(None) >= 5


def test_a_scene_without_room_is_an_error(monkeypatch):
    monkeypatch.setattr("datagen.styles.primitives.SCENE_RADIUS", 0.01)
    with pytest.raises(TronError, match="found a place"):
        draw.__wrapped__(choice=Choice(objects=(3, 3)))


@pytest.mark.parametrize("kind", KINDS)
def test_shapes_are_closed_oriented_fitted_and_fine(kind):
    shape = ShapeSpec(kind=kind, size=0.6, parameters=(0.2, 0.9, 0.4, 0.7))
    mesh = solid(shape, 0.08)
    assert mesh.is_watertight
    assert mesh.volume > 0
    assert np.linalg.norm(mesh.vertices, axis=1).max() == pytest.approx(0.6, abs=1e-6)
    assert mesh.edges_unique_length.max() <= 0.08 + 1e-9


@pytest.mark.parametrize("kind", KINDS)
def test_shading_normals_are_unit_and_near_the_geometry(kind):
    mesh = solid(ShapeSpec(kind=kind, size=0.6, parameters=(0.2, 0.9, 0.4, 0.7)), 0.08)
    vertices, normals, faces = split_creases(mesh)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-9)
    corners = vertices[faces]
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    face_normals /= np.linalg.norm(face_normals, axis=1, keepdims=True)
    cosine = (normals[faces] * face_normals[:, None]).sum(-1)
    assert np.degrees(np.arccos(np.clip(cosine.min(), -1, 1))) < 60
    assert np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1))) < 10


def test_a_body_settles_where_its_centre_of_mass_cannot_fall_further():
    box = solid(ShapeSpec(kind="box", size=0.6, parameters=(0.1, 0.0, 0.0, 0.0)), 1.0)
    rng = generator(0, "settle")
    for _ in range(20):
        start = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        start *= np.sign(np.linalg.det(start))
        turn = settle(box.convex_hull, start)
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)
        z = (box.vertices @ turn.T)[:, 2]
        corners = np.linalg.norm(box.vertices, axis=1) > 0.6 - 1e-6
        assert (z[corners] < z.min() + 1e-6).sum() == 4, "a box at rest stands on four corners"


def test_camera_paths_stay_above_the_floor_and_see_the_middle():
    spec = draw()
    for camera in [*spec.views(16, 32, 32), *spec.clip(2, 5, 32, 32)]:
        assert camera.position[2] > 0.5
        pixels, depth = camera.project(np.array([spec.cameras.film.target]))
        np.testing.assert_allclose(pixels, [[16, 16]], atol=1e-6)
        assert depth[0] > 4


def test_a_clip_is_consecutive_frames_of_the_path():
    spec = draw()
    whole = [camera.position for camera in draw(frames=24).clip(1, 24, 8, 8)]
    first = spec.cameras.first_frame
    assert isinstance(first, tuple)
    first = first[1]
    for camera, expected in zip(spec.clip(1, 5, 8, 8), whole[first : first + 5]):
        np.testing.assert_allclose(camera.position, expected)


def test_lights_that_share_a_path_are_filmed_from_the_same_places():
    own, shared = draw(), draw(lights_share_path=True)
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
