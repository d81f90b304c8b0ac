"""Nothing at rest lies in another, towers stand, falls obey the closed form, last bits do not matter."""

import dataclasses

import mujoco
import numpy as np
import pytest
import trimesh
from trimesh.collision import CollisionManager

from datagen.world import rigid_bodies, settling
from datagen.world.objects import Placement
from datagen.world.rigid_bodies import GRAVITY, STEP, Exploded, RigidBodies, with_one_sign
from datagen.world.settling import Body, roll_to_rest, settle
from datagen.world.shapes import ShapeSpec, Standing, make_pieces, standing
from tron.seeds import generator

FLAT = Standing(np.array([-3.0, -3.0, 0.0]), np.array([3.0, 3.0, np.inf]))
SMALL = ("rock", "die", "box", "fruit", "mug", "sphere", "nut", "book", "twisted", "gear", "cutout", "joint")


def body(kind, seed=0, size=0.3, upright=False):
    a, b, c, d = generator(seed, "body", kind).random(4)
    shape = ShapeSpec(kind=kind, size=size, parameters=(a, b, c, d), seed=seed)
    return Body([piece.mesh for piece in make_pieces(shape, 0.5)], upright)


def box(*sides):
    return Body([trimesh.creation.box(sides)])


@pytest.fixture(scope="module")
def crowd():
    return [body(kind) for kind in SMALL]


@pytest.fixture(scope="module")
def terrain():
    return standing(ShapeSpec(kind="terrain", size=6.0, parameters=(0.5, 0.5, 0.5, 0.5), seed=3))


def test_a_ball_falls_as_the_closed_form_says():
    ball = Body([trimesh.creation.icosphere(3)])
    world = RigidBodies([ball], FLAT)
    world.put(0, np.eye(3), np.array([0.0, 0.0, 5.0]))
    n = 100
    for _ in range(n):
        world.step()
    fallen = GRAVITY * STEP**2 * n * (n + 1) / 2  # semi-implicit Euler, exactly
    placement = world.placement(0)
    assert placement is not None
    assert placement.position[2] == pytest.approx(5.0 - fallen, abs=1e-3)
    assert placement.position[2] == pytest.approx(5.0 - 0.5 * GRAVITY * (n * STEP) ** 2, abs=0.02)
    assert placement.position[:2] == (0.0, 0.0)


def test_energy_never_grows_once_things_touch(crowd):
    world = RigidBodies(crowd[:6], FLAT)
    for i in range(6):
        world.put(i, np.eye(3), np.array([0.1 * i, 0.0, 0.5 + 0.7 * i]))
    energy = [world.energy()]
    for _ in range(500):
        world.step()
        energy.append(world.energy())
    scale = energy[0] - energy[-1]
    assert scale > 0
    # Contacts are springs that give back what they took: within a step, not over many.
    assert np.max(np.diff(energy)) < 0.02 * scale
    assert np.max(np.array(energy[20:]) - np.array(energy[:-20])) < 0.005 * scale


@pytest.mark.parametrize("arrangement", ["strewn", "pile"])
@pytest.mark.parametrize("ground", ["flat", "terrain"])
def test_what_has_settled_rests_on_something_and_lies_in_nothing(arrangement, ground, crowd, terrain):
    under = FLAT if ground == "flat" else terrain
    placements = settle(generator(1, "settle"), crowd, under, arrangement=arrangement, radius=0.8)
    assert sum(placement is not None for placement in placements) >= 11
    manager, lowest = CollisionManager(), []
    for i, (thing, placement) in enumerate(zip(crowd, placements)):
        if placement is None:
            continue
        for j, piece in enumerate(thing.pieces):
            moved = piece.convex_hull.copy().apply_transform(placement.matrix())
            lowest.append((moved.vertices[:, 2] - under.height(moved.vertices[:, :2])).min())
            manager.add_object(f"{i}.{j}", moved)
    assert min(lowest) > -0.012, "nothing sinks into the ground"
    assert sum(low < 0.02 for low in lowest) >= 4, "a heap has a base"
    # FCL, on the full hulls: MuJoCo is not asked about itself.
    contacts = manager.in_collision_internal(return_data=True)[1]  # pyright: ignore
    depths = [c.depth for c in contacts if len({name.split(".")[0] for name in c.names}) == 2]
    assert max(depths, default=0.0) < 0.012


def test_a_pile_is_a_pile_and_what_is_strewn_is_not():
    rocks = [body("rock", seed) for seed in range(10)]

    def raised(arrangement, radius):
        placements = settle(generator(2, "pile"), rocks, FLAT, arrangement=arrangement, radius=radius)
        lowest = [p.moved(rock.points)[:, 2].min() for rock, p in zip(rocks, placements) if p is not None]
        return sum(float(z) > 0.1 for z in lowest)

    assert raised("pile", 0.6) >= 2
    assert raised("strewn", 2.5) == 0


def test_a_tower_of_boxes_stays():
    tower = [box(1.0, 0.9, 0.3), box(0.8, 0.8, 0.25), box(0.7, 0.6, 0.3), box(0.5, 0.5, 0.2)]
    placements = settle(generator(0, "tower"), tower, FLAT, arrangement="stack")
    z = [placement.position[2] for placement in placements if placement]
    assert len(z) == 4
    np.testing.assert_allclose(z, [0.15, 0.425, 0.7, 0.95], atol=0.025)


def test_a_tower_that_leans_too_far_falls():
    world = RigidBodies([box(1.0, 1.0, 0.3)] * 3, FLAT)
    for i in range(3):
        world.put(i, np.eye(3), np.array([0.45 * i, 0.0, 0.16 + 0.31 * i]))
    for _ in range(600):
        world.step()
    top = world.placement(2)
    assert top is not None
    assert top.position[2] < 0.6


def test_a_body_rolls_to_where_its_centre_of_mass_cannot_fall_further():
    ((mesh, _),) = make_pieces(ShapeSpec(kind="box", size=0.6, parameters=(0.1, 0.0, 0.0, 0.0)), 1.0)
    rng = generator(0, "settle")
    for _ in range(20):
        start = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        start *= np.sign(np.linalg.det(start))
        turn = roll_to_rest(mesh.convex_hull, start)
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)
        z = (mesh.vertices @ turn.T)[:, 2]
        corners = np.linalg.norm(mesh.vertices, axis=1) > 0.6 - 1e-6
        assert (z[corners] < z.min() + 1e-6).sum() == 4, "a box at rest stands on four corners"


def test_upright_things_stay_upright_and_others_come_to_lie():
    bottle = body("bottle", upright=True)
    for placement in settle(generator(0, "up"), [bottle] * 4, FLAT, arrangement="pile"):
        assert placement is not None
        np.testing.assert_allclose(placement.matrix()[:3, 2], [0, 0, 1], atol=1e-6)
    pencil = box(0.05, 0.05, 0.9)
    for placement in settle(generator(0, "fall"), [pencil] * 4, FLAT, arrangement="pile", radius=1.0):
        assert placement is not None
        assert abs(placement.matrix()[2, 2]) < 0.7


@pytest.mark.parametrize("arrangement", ["strewn", "pile", "stack"])
def test_a_difference_of_a_billionth_of_a_hair_changes_nothing(arrangement, crowd):
    rng = generator(0, "noise")

    def nudged(piece):
        return trimesh.Trimesh(piece.vertices + rng.normal(0.0, 1e-12, piece.vertices.shape), piece.faces)

    def run(bodies, ground):
        return settle(generator(3, "same"), bodies, ground, arrangement=arrangement, radius=0.5)

    few = crowd[:7]
    moved = dataclasses.replace(FLAT, low=FLAT.low + 1e-12)
    assert run(few, FLAT) == run(few, FLAT)
    assert run(few, FLAT) == run([Body([nudged(piece) for piece in b.pieces]) for b in few], moved)


def test_a_last_bit_that_differs_within_a_step_dies_at_once(crowd, monkeypatch):
    def run():
        world = RigidBodies(crowd[:5], FLAT)
        for i in range(5):
            world.put(i, np.eye(3), np.array([0.13 * i, 0.05 * i, 0.4 + 0.5 * i]))
        for _ in range(400):
            world.step()
        return [world.placement(i) for i in range(5)]

    exact = run()
    step, rng = mujoco.mj_step, generator(0, "libm")  # pyright: ignore

    def sloppy(model, data):
        step(model, data)
        data.qpos[:] *= 1.0 + rng.normal(0.0, 1e-15, model.nq)
        data.qvel[:] *= 1.0 + rng.normal(0.0, 1e-15, model.nv)

    monkeypatch.setattr(mujoco, "mj_step", sloppy)
    assert run() == exact
    monkeypatch.setattr(rigid_bodies, "POSITION_GRID", 2.0**-60)
    monkeypatch.setattr(rigid_bodies, "VELOCITY_GRID", 2.0**-60)
    assert run() != exact


def test_a_scene_ten_times_as_large_settles_ten_times_as_large():
    # Eight times: lengths within are in a power of two.
    def run(scale):
        ground = Standing(FLAT.low * scale, FLAT.high * scale)
        bodies = [box(*(scale * np.array(s))) for s in ((0.3, 0.2, 0.1), (0.25, 0.25, 0.25), (0.4, 0.1, 0.1))]
        return settle(generator(5, "scale"), bodies, ground, arrangement="pile", radius=0.2 * scale)

    for small, large in zip(run(1.0), run(8.0)):
        assert small is not None
        assert large is not None
        np.testing.assert_allclose(large.position, np.multiply(small.position, 8.0), atol=1e-4)
        np.testing.assert_allclose(large.quaternion, small.quaternion, atol=1e-5)


def test_what_falls_off_a_table_is_tried_again_and_then_left_out():
    table = Standing(np.array([-0.4, -0.4, 1.0]), np.array([0.4, 0.4, np.inf]))
    balls = [Body([trimesh.creation.icosphere(2, radius=0.2)]) for _ in range(8)]
    placements = settle(generator(0, "off"), balls, table, arrangement="pile", radius=0.3)
    assert 1 <= placements.count(None) <= 7
    assert all(placement.position[2] > 1.1 for placement in placements if placement)


def test_things_in_a_room_stay_within_its_walls(crowd):
    space = standing(ShapeSpec(kind="room_shell", size=2.0, parameters=(0.5, 0.5, 0.5, 0.5), seed=1))
    corner = (float(space.low[0]), float(space.low[1]))
    few = crowd[:6]
    placements = settle(generator(0, "room"), few, space, arrangement="pile", centre=corner, radius=0.5)
    assert placements.count(None) <= 1
    for thing, placement in zip(few, placements):
        if placement is None:
            continue
        points = placement.moved(thing.points)
        assert (points[:, :2] > space.low[:2] - 0.012).all()
        assert (points[:, :2] < space.high[:2] + 0.012).all()


def test_things_keep_off_what_stands_fixed():
    pillar = Body([trimesh.creation.box((0.8, 0.8, 2.0))])
    at = Placement(quaternion=(1, 0, 0, 0), position=(0, 0, 1.0))
    cubes = [box(0.3, 0.3, 0.3) for _ in range(6)]
    for placement in settle(generator(0, "fixed"), cubes, FLAT, radius=1.0, fixed=[(pillar, at)]):
        assert placement is not None
        x, y, z = placement.position
        assert max(abs(x), abs(y)) > 0.4 or z > 2.0


def test_an_explosion_is_caught_tried_again_and_counted(crowd, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    world = RigidBodies(crowd[:2], FLAT)
    world.put(0, np.eye(3), np.array([0.0, 0.0, 1.0]))
    world._data.qvel[0] = np.nan
    with pytest.raises(Exploded):
        world.step()
    assert list(tmp_path.iterdir()) == [], "MuJoCo's log"
    runs = []
    run = settling._run

    def explode(world):
        runs.append(world)
        if len(runs) < 3:
            raise Exploded
        run(world)

    monkeypatch.setattr(settling, "_run", explode)
    assert None not in settle(generator(0, "bang"), crowd[:3], FLAT)
    assert len(runs) == 3
    monkeypatch.setattr(rigid_bodies, "FASTEST", 1e-3)
    monkeypatch.setattr(settling, "_run", run)
    assert settle(generator(0, "bang"), crowd[:3], FLAT) == [None, None, None]


def test_nothing_to_drop_is_no_error():
    assert settle(generator(0, "none"), [], FLAT) == []


@pytest.mark.parametrize("sides", [(1.0, 0.8, 0.0), (0.0, 0.8, 1.0), (1.0, 0.8, 1e-5), (0.0, 0.0, 1.0)])
def test_what_is_flat_or_straight_comes_to_rest_like_anything_else(sides):
    # A user's picture, rug or string: MuJoCo and Qhull have no hull of such points.
    turn = trimesh.transformations.rotation_matrix(0.4, (1.0, 2.0, 0.0)) if sides[2] == 0.0 else np.eye(4)
    board = trimesh.Trimesh(
        trimesh.creation.box(sides).apply_transform(turn).vertices, [[0, 1, 2], [1, 3, 2]]
    )
    bodies = [Body([board], upright=True), box(0.3, 0.3, 0.3)]
    for thing, placement in zip(bodies, settle(generator(0, "flat"), bodies, FLAT)):
        assert placement is not None
        lowest = placement.moved(np.asarray(thing.pieces[0].vertices))[:, 2].min()
        assert lowest == pytest.approx(0.0, abs=0.01)


def test_a_half_turn_has_one_sign_whatever_side_of_zero_its_w_is_rounded_to():
    for w in (-1e-9, 0.0, 1e-9):
        assert with_one_sign((w, -0.6, 0.8, 0.0))[1:] == (0.6, -0.8, -0.0)
        assert with_one_sign((w, 0.6, -0.8, 0.0))[1:] == (0.6, -0.8, 0.0)
    assert with_one_sign((-0.5, 0.5, 0.5, 0.5)) == (0.5, -0.5, -0.5, -0.5)
