"""Laws of shadow rays: agreement with the reference, order invariance, the sidedness rule."""

from __future__ import annotations

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tron import seeds
from tron.cameras import Camera
from tron.errors import TronError
from tron.gaussians.edit import moved
from tron.tracing import SurfelTracer, reference
from tron.tracing.hierarchy.transmittance import Fans

pytestmark = pytest.mark.usefixtures("variant")


@pytest.mark.parametrize(
    ("count", "degree", "two_sided"),
    [*((400, degree, sided) for degree in (2, 4) for sided in (True, False)),
     (1, 2, True), (1, 4, False), (2, 2, False), (2, 4, True), (3, 2, True), (3, 4, False)],
)  # fmt: skip
def test_agrees_with_the_float64_reference(random_rays, shadows, random_scene, degree, two_sided, count):
    scene = random_scene(count, degree=degree)
    origins, directions = random_rays(1000)
    truth, margin = reference.transmittance(scene, origins, directions, two_sided=two_sided)
    steady = margin > 1e-5
    assert (~steady).mean() < 0.05
    found = shadows(SurfelTracer(scene).sided(two_sided), origins, directions)
    np.testing.assert_allclose(found[steady], truth[steady], atol=1e-4)


def test_order_of_surfels_does_not_matter(random_rays, shadows, random_scene):
    scene = random_scene(300)
    order = seeds.generator(0, "tests", "order").permutation(len(scene))
    arrays = {
        f.name: getattr(scene, f.name)[order]
        for f in dataclasses.fields(scene)
        if isinstance(getattr(scene, f.name), np.ndarray) and f.name not in ("up", "offset")
    }
    origins, directions = random_rays(1000)
    first = shadows(SurfelTracer(scene), origins, directions)
    second = shadows(SurfelTracer(dataclasses.replace(scene, **arrays)), origins, directions)
    np.testing.assert_allclose(first, second, atol=1e-5)


def test_front_faces_block_from_zero_and_back_faces_beyond_two_spacings(shadows, disks):
    heights = np.array([0.15, 0.25])  # spacing is 0.1: the rule's threshold lies between them
    up = [[0, 0, 1]] * 2
    for down, expected in ((True, [0.2, 0.2]), (False, [1.0, 0.2])):
        found = [
            shadows(SurfelTracer(disks([[0, 0, h]], [down], opacity=0.8, sigma=0.2)), [[0, 0, 0]], up[:1])[0]
            for h in heights
        ]
        np.testing.assert_allclose(found, expected, rtol=1e-5)
    one_sided = SurfelTracer(disks([[0, 0, 0.25]], [False], opacity=0.8, sigma=0.2)).sided(False)
    assert shadows(one_sided, [[0, 0, 0]], up[:1])[0] == 1.0


@pytest.mark.parametrize(
    ("height", "direction", "leaves", "left"),
    [
        (0.03, (0, 0, 1), (0, 0, 1), 1.0),
        (0.15, (0, 0, 1), (0, 0, 1), 0.2),
        (0.03, (0.99, 0, 0.141), (0, 0, 1), 0.2),  # beyond two spacings along the ray
        (0.03, (0, 0, 1), (1, 0, 0), 0.2),  # a corner
        (0.03, (0, 0, 1), (0.766, 0, 0.643), 0.2),  # a crevice of 50 degrees
        (0.03, (0, 0, 1), (0, 0, 0), 0.2),  # the ray leaves no surface
    ],
)
def test_fronts_against_the_surface_that_a_ray_leaves_are_a_sheets_other_side(
    disks, height: float, direction, leaves, left: float
) -> None:
    along = np.array(direction) / np.linalg.norm(direction)
    tracer = SurfelTracer(disks([along * height / along[2]], [True], opacity=0.8, sigma=0.2))
    for sided, expected in ((True, left), (False, 0.2)):
        towards, normal = mi.Vector3f(*along.tolist()), mi.Vector3f(*map(float, leaves))
        fans = Fans(mi.Point3f(0), [towards], [mi.Bool(True)], normal)
        (found,) = tracer.sided(sided).transmittances(fans)
        assert found[0] == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize(("radius", "left"), [(0.05, 0.2), (0.2, 1.0), (0.4, 1.0)])
def test_a_sheet_is_as_thin_as_its_own_surfels_are_small(disks, radius: float, left: float) -> None:
    """The gap is half the scene's spacing, two of the smallest surfels': fine things had no shadow in it."""
    scene = disks([[0, 0, 0.03], [3, 0, 0], [4, 0, 0]], [True] * 3, opacity=0.8, sigma=0.2)
    scene.log_scales[0] = np.log(radius)
    up = mi.Vector3f(0, 0, 1)
    (found,) = SurfelTracer(scene).transmittances(Fans(mi.Point3f(0), [up], [mi.Bool(True)], up))
    assert found[0] == pytest.approx(left, abs=1e-4)


def test_a_sheets_other_side_is_that_of_float64(random_rays, random_scene):
    scene = dataclasses.replace(random_scene(300), spacing=0.4)
    origins, directions = random_rays(1500)
    normals = unit_rows(seeds.generator(0, "tests", "normals").normal(size=origins.shape))
    truth, margin = reference.transmittance(scene, origins, directions, normals=normals)
    plain, _ = reference.transmittance(scene, origins, directions)
    assert (truth > plain + 0.1).sum() > 20
    arguments = (np.ascontiguousarray(each.T, np.float32) for each in (origins, directions, normals))
    origin, direction, normal = (mi.Vector3f(each) for each in arguments)
    fans = Fans(mi.Point3f(origin), [direction], [dr.full(mi.Bool, True, len(origins))], normal)
    (found,) = SurfelTracer(scene).transmittances(fans)
    steady = margin > 1e-5
    np.testing.assert_allclose(np.array(found)[steady], truth[steady], atol=1e-4)


def unit_rows(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_behind_the_origin_nothing_blocks(shadows, disks):
    tracer = SurfelTracer(disks([[0, 0, -0.5]], [False], opacity=0.8, sigma=0.2))
    assert shadows(tracer, [[0, 0, 0]], [[0, 0, 1]])[0] == 1.0


def test_many_layers_are_exactly_opaque(shadows, disks):
    layers = disks([[0, 0, 0.3 + 0.1 * k] for k in range(6)], [True] * 6, opacity=0.8, sigma=0.5)
    assert shadows(SurfelTracer(layers), [[0, 0, 0]], [[0, 0, 1]])[0] == 0.0


def test_inactive_lanes_are_clear(disks):
    tracer = SurfelTracer(disks([[0, 0, 0.5]], [True], opacity=0.8, sigma=0.5))
    origin, direction = mi.Point3f([0, 0], [0, 0], [0, 0]), mi.Vector3f([0, 0], [0, 0], [1, 1])
    found = np.array(tracer.transmittance(origin, direction, mi.Bool([True, False])))
    np.testing.assert_allclose(found, [0.2, 1.0], rtol=1e-5)


def test_faint_surfels_block_nothing(shadows, disks):
    tracer = SurfelTracer(disks([[0, 0, 0.5]], [True], opacity=0.003, sigma=0.5))
    assert shadows(tracer, [[0, 0, 0]], [[0, 0, 1]])[0] == 1.0


def built(monkeypatch):
    """Count how often a hierarchy is built from now on."""
    from tron.tracing import tracer

    calls = []
    build = tracer.build_bvh
    monkeypatch.setattr(tracer, "build_bvh", lambda records: calls.append(records.count) or build(records))
    return calls


def test_a_tenth_of_the_surfels_may_move_every_frame_without_a_new_hierarchy(
    random_rays, shadows, random_scene, monkeypatch
):
    scene = random_scene(400)
    tracer, calls = SurfelTracer(scene), built(monkeypatch)
    origins, directions = random_rays(300)
    before = shadows(tracer, origins, directions)
    current, now = tracer, scene
    part = np.argsort(np.linalg.norm(scene.means - [0.5, 0.5, 0.5], axis=1))[:40]
    turn = Rotation.from_rotvec([0.0, 0.1, 0.2]).as_matrix()
    for _ in range(5):
        now = moved(now, part, turn, np.array([-0.05, -0.08, -0.04]))
        current = current.moved(now)
        truth, margin = reference.transmittance(now, origins, directions)
        steady = margin > 1e-5
        np.testing.assert_allclose(shadows(current, origins, directions)[steady], truth[steady], atol=1e-4)
    assert not calls
    assert np.abs(shadows(current, origins, directions) - before).max() > 0.1
    np.testing.assert_array_equal(shadows(tracer, origins, directions), before)


@pytest.mark.parametrize(
    ("change", "kept"),
    [
        ({"base_color": 0.25, "roughness": 0.5}, True),
        ({"sh": 0.125}, True),
        ({"opacity_logits": 2.0}, False),
        ({"log_scales": -3.5}, False),
    ],
)
def test_where_places_stay_so_does_the_hierarchy_and_all_is_seen_as_by_a_new_tracer(
    random_scene, change, kept
):
    scene = random_scene(400)
    tracer = SurfelTracer(scene)
    values = {name: np.full_like(getattr(scene, name), value) for name, value in change.items()}
    other = dataclasses.replace(scene, **values)
    now, anew = tracer.moved(other), SurfelTracer(other)
    assert (now.bvh is tracer.bvh) == kept
    camera = Camera.look_at((0.5, -2.0, 0.5), (0.5, 0.5, 0.5), fov_deg=40, width=24, height=24)
    seen, expected = now.gbuffer(camera).numpy(), anew.gbuffer(camera).numpy()
    for name in ("rgb", "base_color", "roughness", "opacity", "depth"):
        np.testing.assert_array_equal(seen[name], expected[name])


def test_a_hierarchy_gone_loose_is_built_anew(random_scene, monkeypatch):
    scene = random_scene(400)
    tracer, calls = SurfelTracer(scene), built(monkeypatch)
    shuffled = seeds.generator(0, "tests", "scatter").permutation(scene.means)
    tracer.moved(dataclasses.replace(scene, means=shuffled))
    assert calls == [400]


def test_surfels_that_come_or_go_need_a_new_tracer(random_scene):
    with pytest.raises(TronError, match="cannot be where"):
        SurfelTracer(random_scene(10)).moved(random_scene(11))
