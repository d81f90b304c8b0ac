"""Meshes among surfels along camera rays: what hides what, by closed forms."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tron.cameras import Camera
from tron.errors import TronError
from tron.models.parts import Part
from tron.tracing import SurfelTracer
from tron.tracing import meshes as meshes_module
from tron.tracing.meshes import Meshes

pytestmark = pytest.mark.usefixtures("variant")

RED, SPACING = (0.8, 0.1, 0.05), 0.1


def quad(height: float, half: float = 1.0, tilt: float = 0.0, down: bool = False) -> Part:
    """A square at a height, facing up, or down; its shading normals lean by so many radians."""
    corners = half * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) + [0, 0, height]
    normal = np.array([np.sin(tilt), 0, np.cos(tilt)]) * (-1 if down else 1)
    faces = np.array([[0, 1, 2], [0, 2, 3]])[:, :: -1 if down else 1]
    color = np.array(RED, np.float32)
    return Part(corners, np.tile(normal, (4, 1)), faces, None, color, 0.25, 1.0, None)


@pytest.fixture(autouse=True)
def few_stand_ins(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(meshes_module, "STAND_INS", 1200)


@pytest.fixture
def camera() -> Camera:
    """Looks down on the origin from 2 above."""
    return Camera.look_at((0, 0, 2), (0, 0, 0), up=(0, 1, 0), fov_deg=30, width=11, height=9)


def view(scene, meshes: Meshes, camera: Camera, values=()) -> dict[str, np.ndarray]:
    layer = meshes.seen(camera, scene.spacing)
    surfels = SurfelTracer(scene).gbuffer(camera, values[:1], layer.limit)
    return layer.behind(surfels, meshes.values_at(camera, layer, values[1:])).numpy()


@pytest.fixture
def card(disks):
    """One disk at z = 0, as wide as the view, of an opacity."""
    return lambda opacity: disks([[0, 0, 0]], [False], opacity=opacity, sigma=100.0)


def test_a_mesh_before_surfels_hides_them(card, camera):
    found = view(card(0.9), Meshes([[quad(0.5)]]), camera)
    down = -camera.rays()[..., 2]
    np.testing.assert_allclose(found["opacity"], 1)
    np.testing.assert_allclose(found["depth"], 1.5 / down, rtol=1e-5)
    np.testing.assert_allclose(found["position"][..., 2], 0.5, atol=1e-5)
    np.testing.assert_allclose(
        found["base_color"], np.broadcast_to(RED, found["base_color"].shape), atol=1e-5
    )
    np.testing.assert_allclose(found["roughness"], 0.25, atol=1e-6)
    np.testing.assert_allclose(found["metallic"], 1, atol=1e-6)
    np.testing.assert_allclose(found["normal"], np.broadcast_to((0, 0, 1), found["normal"].shape), atol=1e-5)


@pytest.mark.parametrize("opacity", [0.3, 0.8])
def test_a_mesh_behind_a_surfel_shows_as_much_as_that_lets_through(card, camera, opacity):
    scene = card(opacity)
    found = view(scene, Meshes([[quad(-0.5)]]), camera)
    down = -camera.rays()[..., 2]
    np.testing.assert_allclose(found["opacity"], 1)
    mixed = opacity * scene.base_color[0] + (1 - opacity) * np.array(RED)
    np.testing.assert_allclose(
        found["base_color"], np.broadcast_to(mixed, found["base_color"].shape), atol=1e-4
    )
    np.testing.assert_allclose(
        found["roughness"], opacity * scene.roughness[0] + (1 - opacity) * 0.25, atol=1e-4
    )
    # The median: of the surfel where it takes half of the light, else of the mesh.
    height = 0.0 if opacity > 0.5 else -0.5
    np.testing.assert_allclose(found["depth"], (2 - height) / down, rtol=1e-5)
    np.testing.assert_allclose(found["position"][..., 2], height, atol=1e-5)


def test_beside_a_mesh_all_is_as_without_it(card, camera):
    scene = card(0.7)
    found, alone = (
        view(scene, Meshes([[quad(0.5, half=0.1)]]), camera),
        SurfelTracer(scene).gbuffer(camera).numpy(),
    )
    beside = found["opacity"] < 1
    assert 0.5 < beside.mean() < 1
    for name, values in alone.items():
        np.testing.assert_array_equal(found[name][beside], values[beside], err_msg=name)


def test_a_mesh_shows_values_of_its_own_surfels(card, camera):
    meshes = Meshes([[quad(-5, half=3)], [quad(0.5)]])
    x = mi.Float(np.ascontiguousarray(meshes.stand_ins.means[:, 0]))
    found = view(card(0.9), meshes, camera, [mi.Float(7), x])
    place = camera.rays()[..., 0] / -camera.rays()[..., 2] * 1.5
    np.testing.assert_allclose(found["values"][..., 0], place, atol=0.08)
    below = Camera.look_at((0, 0, -2), (0, 0, 0), up=(0, 1, 0), fov_deg=30, width=11, height=9)
    seen = view(card(0.9), meshes, below, [mi.Float(7), x])["values"][..., 0]
    np.testing.assert_allclose(seen, below.rays()[..., 0] / below.rays()[..., 2] * 2.5, atol=0.08)


def test_inside_a_closed_mesh_triangles_show_their_nearest_surfel(card):
    trimesh = pytest.importorskip("trimesh")
    box = trimesh.creation.box((2, 2, 2))
    faces = np.arange(36).reshape(-1, 3)
    part = Part(np.array(box.triangles.reshape(-1, 3)), np.repeat(box.face_normals, 3, axis=0), faces, None,
                np.ones(3, np.float32), 0.5, 0.0, None)  # fmt: skip
    meshes = Meshes([[part]])
    x = mi.Float(np.ascontiguousarray(meshes.stand_ins.means[:, 0]))
    within = Camera.look_at((0, 0, -0.9), (0, 0, 0), up=(0, 1, 0), fov_deg=30, width=11, height=9)
    seen = view(card(0.9), meshes, within, [mi.Float(7), x])["values"][..., 0]
    assert len(np.unique(seen)) == 2
    np.testing.assert_allclose(np.abs(seen), 1 / 3, atol=0.15)


@pytest.mark.parametrize("down", [False, True])
def test_normals_are_those_of_the_side_that_is_seen(card, camera, down):
    found = view(card(0.9), Meshes([[quad(0.5, down=down)]]), camera)
    np.testing.assert_allclose(found["normal"], np.broadcast_to((0, 0, 1), found["normal"].shape), atol=1e-5)


def test_normals_that_look_away_are_bent_until_they_are_seen(card, camera):
    found = view(card(0.9), Meshes([[quad(0.5, tilt=1.9)]]), camera)
    assert ((found["normal"] * found["direction"]).sum(-1) < 0).all()
    np.testing.assert_allclose(np.linalg.norm(found["normal"], axis=-1), 1, atol=1e-5)


def test_rays_leave_along_the_triangle_by_the_meshs_own_measure(card, camera):
    scene, meshes = card(0.9), Meshes([[quad(0.5, tilt=1.2)]])
    layer = meshes.seen(camera, scene.spacing)
    seen = layer.behind(SurfelTracer(scene).gbuffer(camera, (), layer.limit), [])
    rise = np.array((seen.raised(mi.Float(0.01)) - seen.position)[2])
    met = np.array(layer.met)
    expected = 0.01 * meshes.stand_ins.spacing / SPACING
    assert expected < 0.01
    np.testing.assert_allclose(rise[met], expected, rtol=1e-3)
    np.testing.assert_allclose(np.array(seen.raised(mi.Float(0.01)).x - seen.position.x)[met], 0, atol=1e-6)


def test_moved_meshes_stand_where_their_poses_say(card, camera):
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    meshes = Meshes([[quad(0.5, half=0.2)], [quad(-0.7)]])
    elsewhere = meshes.moved([(turn, np.array([0.3, 0, 0]), np.array([-0.3, 0.3, 0.4])), None])
    # (0, 0) -> about (0.3, 0) by a quarter turn (0.3, -0.3) -> (0, 0), and up.
    heights = view(card(0.9), elsewhere, camera)["position"][4, 5, 2]
    assert heights == pytest.approx(0.9, abs=1e-5)
    first = len(meshes.stand_ins) // 2
    np.testing.assert_allclose(elsewhere.stand_ins.means[:first, 2], 0.9, atol=1e-5)
    np.testing.assert_array_equal(elsewhere.stand_ins.means[first:], meshes.stand_ins.means[first:])
    blocked = elsewhere.blocked(mi.Point3f(0, 0, 0.7), mi.Vector3f(0, 0, 1), dr.full(mi.Bool, True, 1))
    assert np.array(blocked).all()
    assert view(card(0.9), meshes, camera)["position"][4, 5, 2] == pytest.approx(0.5, abs=1e-5)


def test_a_model_without_faces_is_refused():
    empty = Part(np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((0, 3), int), None, np.ones(3), 0.5, 0.0, None)
    with pytest.raises(TronError, match="no triangles"):
        Meshes([[empty]])


def test_surfels_of_bent_meshes_lie_on_them():
    trimesh = pytest.importorskip("trimesh")
    ball = trimesh.creation.icosphere(4, 0.5)
    part = Part(np.array(ball.vertices), np.array(ball.vertex_normals), np.array(ball.faces), None,
                np.ones(3, np.float32), 0.5, 0.0, None)  # fmt: skip
    faces = ball.vertices[ball.faces]
    planes = (faces.mean(axis=1) * ball.face_normals).sum(axis=1)
    radii = np.linalg.norm(Meshes([[part]]).stand_ins.means, axis=1)
    assert planes.min() > 0.5 * (1 - 2e-3)
    assert radii.min() > planes.min() - 1e-5
    assert radii.max() < 0.5 + 1e-5
