"""Every kind is closed, oriented, bounded and repeatable whatever its parameters; each is what it says."""

import hashlib
from itertools import pairwise

import numpy as np
import pytest
import trimesh
from manifold3d import CrossSection, Manifold

from datagen.world.shapes import (
    SHAPES,
    SURROUNDINGS,
    ShapeSpec,
    draw_shape,
    make_pieces,
    split_creases,
    standing,
)
from datagen.world.shapes.extrusions import LETTERS
from datagen.world.shapes.primitives import PRIMITIVES
from datagen.world.shapes.shape import MOST_TRIANGLES, fit
from datagen.world.shapes.solids import (
    Noise,
    Parts,
    between,
    closed,
    count,
    post,
    rod,
    rounded_box,
    sheet,
    smooth_profile,
    tube,
    turned,
    vessel,
)
from tron.errors import TronError
from tron.seeds import generator

OPEN = {"foliage": {3}, "card": {0}, "throw": {0}, "open_box": {0}, "screen": {0}, "cobbles": {0}}
"""Slots of kinds that are sheets of single polygons."""
NEW = [kind for kind in SHAPES if kind not in PRIMITIVES and kind != "floor"]
EDGE = 0.2
HALF = (0.5, 0.5, 0.5, 0.5)
EXTREMES = ((0.0, 0.0, 0.0, 0.0), (1.0, 1.0, 1.0, 1.0), (0.0, 1.0, 0.0, 1.0), (1.0, 0.0, 1.0, 0.0))


def drawn(kind, seed, size=0.7):
    return draw_shape(generator(seed, "test", kind), [kind], (size, size))


def first_hits(pieces, origins, ends):
    """(N, 3) where segments first meet the pieces; NaN where they meet none. manifold3d casts the rays."""
    solids = [closed(piece.mesh.vertices, piece.mesh.faces) for piece in pieces]
    found = np.full((len(origins), 3), np.nan)
    for k, (a, b) in enumerate(zip(origins, ends)):
        hits = [hit for solid in solids for hit in solid.ray_cast(tuple(a), tuple(b))]
        if hits:
            found[k] = min(hits, key=lambda hit: hit.distance).position
    return found


def check(shape):
    pieces = make_pieces(shape, EDGE)
    vertices = np.concatenate([piece.mesh.vertices for piece in pieces])
    assert np.isfinite(vertices).all()
    assert np.linalg.norm(vertices, axis=1).max() == pytest.approx(shape.size, rel=1e-9)
    np.testing.assert_allclose(vertices.max(axis=0), -vertices.min(axis=0), atol=1e-9 * shape.size)
    for mesh, slot in pieces:
        assert mesh.is_winding_consistent
        if slot in OPEN.get(shape.kind, ()):
            assert not mesh.is_watertight
            assert np.bincount(mesh.faces_unique_edges.ravel()).max() <= 2
        else:
            assert mesh.is_watertight
            assert mesh.volume > 0
        assert len(mesh.faces) <= MOST_TRIANGLES
        assert 0 <= slot < len(SHAPES[shape.kind].roles)
    return pieces


@pytest.mark.parametrize("kind", NEW)
def test_every_kind_is_closed_oriented_bounded_and_fits_its_ball(kind):
    slots = set()
    for seed in range(2):
        slots |= {piece.slot for piece in check(drawn(kind, seed))}
    assert slots == set(range(len(SHAPES[kind].roles))), "a slot that no piece has"


@pytest.mark.long
@pytest.mark.parametrize("kind", NEW)
def test_no_seed_and_no_extreme_of_the_parameters_breaks_a_kind(kind):
    for seed in range(2, 14):
        check(drawn(kind, seed))
    for k, extreme in enumerate(EXTREMES):
        check(ShapeSpec(kind=kind, size=1.3, parameters=extreme, seed=k))


@pytest.mark.parametrize("kind", ["rock", "grass", "room_shell"])
def test_a_shape_is_the_same_mesh_every_time_and_another_with_another_seed(kind):
    def fingerprint(shape):
        return hashlib.sha256(
            b"".join(p.mesh.vertices.tobytes() for p in make_pieces(shape, EDGE))
        ).hexdigest()

    shape = drawn(kind, 5)
    assert fingerprint(shape) == fingerprint(shape)
    assert fingerprint(shape) != fingerprint(shape.model_copy(update={"seed": shape.seed + 1}))


def test_primitives_are_closed_fitted_and_fine_with_shading_normals_near_their_geometry():
    for kind in PRIMITIVES:
        ((mesh, _),) = make_pieces(ShapeSpec(kind=kind, size=0.6, parameters=(0.2, 0.9, 0.4, 0.7)), 0.08)
        assert mesh.is_watertight, kind
        assert mesh.volume > 0
        assert np.linalg.norm(mesh.vertices, axis=1).max() == pytest.approx(0.6, abs=1e-6)
        assert mesh.edges_unique_length.max() <= 0.08 + 1e-9
        vertices, normals, faces = split_creases(mesh)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-9)
        a, b, c = np.moveaxis(vertices[faces], 1, 0)
        face_normals = np.cross(b - a, c - a)
        face_normals /= np.linalg.norm(face_normals, axis=1, keepdims=True)
        off = np.degrees(np.arccos(np.clip((normals[faces] * face_normals[:, None]).sum(-1), -1, 1)))
        assert off.max() < 60, kind
        assert np.median(off) < 10, kind


def test_primitives_take_no_seed():
    rng = generator(0, "draw")
    draw_shape(rng, ["box"], (0.5, 1.0))
    old = generator(0, "draw")
    for draw in (lambda: old.integers(1), old.uniform, lambda: old.random(4)):
        draw()
    assert rng.random() == old.random()
    assert draw_shape(rng, ["rock"], (0.5, 1.0)).seed != draw_shape(rng, ["rock"], (0.5, 1.0)).seed


def test_an_unknown_kind_is_one_line_that_names_those_there_are():
    for ask in (make_pieces, standing):
        with pytest.raises(TronError, match=r"no shape 'teapot'.*sphere.*terrain"):
            ask(ShapeSpec(kind="teapot", size=1.0, parameters=HALF))
    with pytest.raises(TronError, match="nothing stands on a shape 'chair'"):
        standing(ShapeSpec(kind="chair", size=1.0, parameters=HALF))


def test_a_finer_edge_gives_the_same_solid_with_smaller_triangles():
    shape = drawn("joint", 1)
    coarse, fine = make_pieces(shape, 0.5)[0].mesh, make_pieces(shape, 0.05)[0].mesh
    assert fine.volume == pytest.approx(coarse.volume, rel=1e-9)
    # manifold3d's edges are about as long as asked for: those across two of an edge's parts are longer.
    assert fine.edges_unique_length.max() <= 0.05 * 2**0.5 < 0.1 < coarse.edges_unique_length.max()


def test_a_large_solid_gets_longer_edges_and_never_too_many_triangles():
    parts: Parts = [(Manifold.cube((8.0, 8.0, 6.0)), 0)]
    mesh = fit(parts, 8.0, 0.05)[0].mesh
    assert 0.3 * MOST_TRIANGLES < len(mesh.faces) <= MOST_TRIANGLES


def test_a_part_that_is_empty_is_refused():
    box = Manifold.cube((1.0, 1.0, 1.0))
    with pytest.raises(TronError, match="empty"):
        fit([(box - box, 0)], 1.0, 0.1)


def test_a_mesh_that_is_open_or_inside_out_is_refused():
    box = trimesh.creation.box()
    assert closed(box.vertices, box.faces).volume() == pytest.approx(1.0)
    for faces in (box.faces[:-1], box.faces[:, ::-1]):
        with pytest.raises(TronError, match="not a closed solid"):
            closed(box.vertices, faces)


def test_solids_have_the_volumes_of_their_closed_forms():
    n = 64
    polygon = 0.5 * n * np.sin(2 * np.pi / n)  # area of a regular n-gon of radius 1
    assert rod((0, 0, 0), (1, 2, 2), 0.1, sections=n).volume() == pytest.approx(3.0 * 0.01 * polygon)
    angle = np.arange(200) * 2 * np.pi / 200
    ring = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    torus = tube(ring, 0.2, sections=n, loop=True)
    assert torus.volume() == pytest.approx(2 * np.pi * 0.04 * polygon, rel=1e-3)
    assert torus.genus() == 1
    assert post((0, 0, 0), (1, 0, 3), (0.2, 0.3)).volume() == pytest.approx(0.2 * 0.3 * 3.0)
    assert rounded_box((1, 2, 3), 1e-4).volume() == pytest.approx(6.0, rel=1e-3)
    cylinder = turned(np.array([[1.0, 0.0], [1.0, 2.0]]), n)
    assert cylinder.volume() == pytest.approx(2.0 * polygon)
    cup = vessel(np.array([[1.0, 0.0], [1.0, 2.0]]), 0.1, n)
    assert cup.volume() == pytest.approx((2.0 - 0.81 * 1.9) * polygon, rel=1e-2)
    x, y = np.meshgrid(np.linspace(0, 2, 5), np.linspace(0, 1, 4), indexing="ij")
    assert sheet(np.stack([x, y, 0 * x], -1), 0.1).volume() == pytest.approx(0.2)


def test_a_tube_along_a_knotted_curve_is_turned_no_more_than_it_must():
    t = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    path = np.column_stack([np.cos(t), np.sin(t), 0.5 * np.sin(3 * t)])
    mesh = tube(path, 0.1, sections=8, loop=True).to_mesh64()
    around = np.asarray(mesh.vert_properties)
    nearest = np.linalg.norm(around[:, None] - path, axis=-1).argmin(axis=1)
    faces = nearest[np.asarray(mesh.tri_verts)]
    apart = np.abs(faces[:, [1, 2, 0]] - faces)
    assert np.minimum(apart, 200 - apart).max() <= 1, "triangles join neighbouring rings only"
    corners = around[np.asarray(mesh.tri_verts)]
    longest = np.linalg.norm(np.roll(corners, 1, 1) - corners, axis=-1).max()
    step = np.linalg.norm(np.roll(path, -1, 0) - path, axis=1).max() * 1.2
    assert longest < np.hypot(step, 0.2 * np.sin(np.pi / 8)) * 1.1, "no ring is turned against the next"


def test_a_profile_never_overshoots_its_radii():
    profile = smooth_profile([0.0, 0.1, 0.5, 1.0], [0.2, 1.0, 1.0, 0.3])
    assert profile[:, 0].min() >= 0.2
    assert profile[:, 0].max() <= 1.0


def test_proportions_reach_both_of_their_ends():
    assert (between(0.0, 2, 4), between(1.0, 2, 4)) == (2.0, 4.0)
    assert {count(f, 3, 6) for f in np.linspace(0, 1, 101)} == {3, 4, 5, 6}


def test_noise_has_zero_mean_unit_variance_and_is_smooth():
    noise = Noise(generator(0, "noise"), octaves=1)
    line = np.arange(0, 16, 0.5)
    points = np.stack(np.meshgrid(line, line, line), -1).reshape(-1, 3)
    values = noise(points)
    assert abs(values.mean()) < 0.05
    assert values.std() == pytest.approx(1.0, abs=0.05)
    np.testing.assert_allclose(noise(points[:99] + 16.0), values[:99], atol=1e-9)  # it repeats
    assert np.abs(noise(points + np.array([1e-4, 0.0, 0.0])) - values).max() < 5e-3


@pytest.mark.parametrize("kind", ["bowl", "chair", "draped", "terrain"])
def test_shading_normals_of_pieces_are_unit_and_finite(kind):
    for piece in make_pieces(drawn(kind, 3), EDGE):
        _, normals, _ = split_creases(piece.mesh)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-9)


def test_a_bowl_is_hollow_a_plate_is_thin_and_a_basket_is_mostly_air():
    bowl, basket = (make_pieces(drawn(kind, 1), EDGE)[0].mesh for kind in ("bowl", "basket"))
    assert bowl.volume < 0.4 * bowl.convex_hull.volume
    assert basket.volume < 0.1 * basket.convex_hull.volume
    bottom = first_hits(make_pieces(drawn("bowl", 1), EDGE), [(0.0, 0.0, 2.0)], [(0.0, 0.0, -2.0)])
    assert bottom[0, 2] < 0.0, "a ray from above enters the bowl"


def test_cloth_lies_outside_of_what_it_is_draped_over_and_keeps_its_threads():
    for seed in range(3):
        pieces = make_pieces(drawn("draped", seed), 0.5)
        body, cloth = (piece.mesh for piece in pieces)
        solid = closed(body.vertices, body.faces)
        points = np.asarray(cloth.vertices)[::37]
        crossings = [len(solid.ray_cast(tuple(x), tuple(x + np.array([0.01, 0.02, 3.0])))) for x in points]
        inside = np.array(crossings) % 2 == 1
        assert inside.mean() < 0.02, "threads may cross an edge between two of their points"
        assert cloth.bounds[0, 2] == pytest.approx(body.bounds[0, 2], abs=0.05)
        assert cloth.bounds[1, 2] > body.bounds[1, 2]


@pytest.mark.parametrize("kind", [kind for kind in SURROUNDINGS if kind not in ("floor", "cobbles")])
def test_things_stand_on_the_surface_where_the_mesh_has_it(kind):
    for seed in range(3):
        shape = drawn(kind, seed, 4.0)
        space = standing(shape)
        assert (space.high > space.low).all()
        points = generator(seed, "spots").uniform(space.low[:2], space.high[:2], (40, 2))
        heights = space.height(points)
        above = min(0.5 * (space.high[2] - space.low[2]), 2.0)
        origins = np.column_stack([points, heights + above])
        first = first_hits(make_pieces(shape, 1.0), origins, origins - np.array([0.0, 0.0, 2.0 * above]))[
            :, 2
        ]
        # The skirting of a room is the only thing over its floor.
        np.testing.assert_allclose(first, heights, atol=0.12 if kind == "room_shell" else 0.01)
        assert np.median(np.abs(first - heights)) < 0.004


def test_a_floor_is_flat_and_things_stand_on_it():
    shape = drawn("floor", 0, 4.0)
    space, mesh = standing(shape), make_pieces(shape, 1.0)[0].mesh
    assert (mesh.vertices[:, 2] == 0.0).all()
    np.testing.assert_allclose(mesh.face_normals, np.tile([0.0, 0.0, 1.0], (len(mesh.faces), 1)))
    np.testing.assert_allclose([space.low[:2], space.high[:2]], mesh.bounds[:, :2])


def test_cobbles_are_relief_that_things_stand_on_top_of():
    for seed in range(3):
        shape = drawn("cobbles", seed, 4.0)
        space, mesh = standing(shape), make_pieces(shape, np.inf)[0].mesh
        top, low = mesh.vertices[:, 2].max(), mesh.vertices[:, 2].min()
        assert space.low[2] - 0.01 < top <= space.low[2] + 1e-9
        assert 0.015 < top - low < 0.1, "world units, under stones of 0.2"
        slopes = np.degrees(np.arccos(np.clip(mesh.face_normals[:, 2], -1, 1)))
        assert (mesh.face_normals[:, 2] > 0).all()
        assert 5 < np.average(slopes, weights=mesh.area_faces) < 40


def test_a_room_is_a_shell_with_openings_that_let_light_in():
    for seed in range(6):
        shape = drawn("room_shell", seed, 3.5)
        space = standing(shape)
        directions = generator(seed, "rays").normal(size=(600, 3))
        directions *= 20.0 / np.linalg.norm(directions, axis=1, keepdims=True)
        middle = np.tile(0.5 * (space.low + space.high), (600, 1))
        free = np.isnan(first_hits(make_pieces(shape, 1.0), middle, middle + directions)[:, 0])
        assert 0.04 < free.mean() < 0.5, "share of the sphere of directions that sees the sky"


def test_terrain_is_gentle():
    for seed in range(4):
        space = standing(drawn("terrain", seed, 5.0))
        assert space.heights is not None
        cell = (space.high - space.low)[0] / (len(space.heights) - 1)
        slope = np.hypot(*np.gradient(space.heights, cell))
        assert np.degrees(np.arctan(np.quantile(slope, 0.99))) < 25
        assert np.ptp(space.heights) > 0.05


def test_letters_can_be_told_apart_from_their_outlines():
    outlines = []
    for strokes in LETTERS.values():
        pen = CrossSection.circle(0.3, 12)
        marks = [
            CrossSection.batch_hull([pen.translate(a), pen.translate(b)])
            for stroke in strokes
            for a, b in pairwise(stroke)
        ]
        outline = marks[0]
        for mark in marks[1:]:
            outline += mark
        assert outline.num_contour() >= 1
        outlines.append(outline)
    for i, a in enumerate(outlines):
        for b in outlines[i + 1 :]:
            assert (a + b).area() - (a ^ b).area() > 0.8
