"""Backs of open sheets: which get surfels, by area, and that they are lit as paths say."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from eval.renderers.paths import path_traced
from eval.zoo.lights import disc
from tron.cameras import Camera
from tron.estimation import FINEST, PREVIEW
from tron.gaussians.scene import GaussianScene
from tron.models.parts import Part
from tron.models.shapes import textured
from tron.models.sides import spacing_of, two_sided
from tron.models.surfels import areas, surfels_of_model
from tron.relighting import EnvironmentMap, Relighter
from tron.tracing.meshes import Meshes

pytestmark = pytest.mark.usefixtures("variant")
GREEN = (0.3, 0.6, 0.2)


def part_of(mesh: trimesh.Trimesh) -> Part:
    faceted = np.repeat(mesh.face_normals, 3, axis=0)
    corners = np.array(mesh.triangles.reshape(-1, 3))
    faces = np.arange(len(corners)).reshape(-1, 3)
    return Part(corners, faceted, faces, None, np.array(GREEN, np.float32), 0.7, 0.0, None)


def turned(part: Part) -> Part:
    return replace(part, faces=part.faces[:, ::-1], normals=-part.normals)


def without(mesh: trimesh.Trimesh, faces: np.ndarray) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces[~faces], process=False)


def backs(parts: list[Part]) -> float:
    """Area of the backs over that of the parts."""
    both = two_sided(parts)
    assert both[: len(parts)] == parts
    whole = sum(areas(part).sum() for part in parts)
    return float(sum(areas(part).sum() for part in both) / whole - 1)


def box(size: float = 2.0) -> trimesh.Trimesh:
    return trimesh.creation.box((size, size, size)).subdivide().subdivide().subdivide()


def leaf() -> Part:
    """A card of two triangles in the plane y = 0 whose front looks to -y."""
    corners = np.array([[-1.0, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    normals = np.tile([0.0, -1, 0], (4, 1))
    return Part(corners, normals, faces, None, np.array(GREEN, np.float32), 0.7, 0.0, None)


def test_what_closes_and_faces_outwards_has_no_backs():
    hollow = [part_of(box()), turned(part_of(box(1.6)))]
    assert backs([part_of(box())]) == 0
    assert backs(hollow) == 0
    faces = [part_of(without(box(), np.arange(len(box().faces)) % 2 != k)) for k in range(2)]
    assert backs(faces) == 0  # of two materials that are sewn together at the corners' places
    assert backs([leaf(), turned(leaf())]) == 0  # the file has both sides already


def test_backs_are_of_sheets_that_are_seen_from_behind():
    assert backs([leaf()]) == pytest.approx(1)
    assert backs([turned(part_of(box()))]) == pytest.approx(1)  # a room whose walls look inwards
    lid = box().triangles_center[:, 2] > 0.99
    assert backs([part_of(without(box(), lid))]) == pytest.approx(1)
    leaves = [part_of(box()), leaf().moved(np.eye(4) + np.outer([0, 0, 1, 0], [0, 0, 0, 3]))]
    assert [len(part.faces) for part in two_sided(leaves)[2:]] == [2]


def test_an_inside_that_hardly_any_light_reaches_is_left_out():
    """A tube ten times as long as wide shows the back of its ends; a box without a bottom on a board none."""
    tube = trimesh.creation.cylinder(0.1, 2, sections=48).subdivide_to_size(0.05)
    caps = np.abs(tube.face_normals[:, 2]) > 0.5
    assert 0.05 < backs([part_of(without(tube, caps))]) < 0.5
    bottom = box().triangles_center[:, 2] < -0.99
    board = trimesh.creation.box((4, 4, 0.2))
    board.apply_translation((0, 0, -1.0999))
    assert backs([part_of(without(box(), bottom)), part_of(board)]) == 0


@pytest.mark.parametrize("behind", [False, True], ids=["front", "back"])
@pytest.mark.parametrize("quality", [PREVIEW, FINEST], ids=["preview", "final"])
def test_a_leaf_of_one_polygon_is_lit_on_both_sides(behind, quality):
    """Under a sun that is before it, against paths; as surfels and as a mesh."""
    light = EnvironmentMap(0.2 + 300 * np.repeat(disc(40, -60, 2.0)[..., None], 3, -1))
    camera = Camera.look_at((1, 3 if behind else -3, 0.5), (0, 0, 0), fov_deg=24, width=24, height=24)
    truth = path_traced([textured(leaf(), "leaf").shape], light, camera, 4, 256, 0)
    sides = two_sided([leaf()])
    scene = surfels_of_model(sides, spacing_of(sides, 8000))
    far = leaf().moved(np.eye(4) + np.outer([0, 0, 1, 0], [0, 0, 0, -50.0]))
    elsewhere = surfels_of_model([far], 0.5)
    for relighter in (
        Relighter(scene, quality, proxy="never"),
        Relighter(elsewhere, quality, proxy="never", meshes=[[leaf()]]),
    ):
        lit = relighter.under(light).render(camera).lit
        assert lit.mean() == pytest.approx(truth.mean(), rel=0.03)


def test_surfels_of_a_bent_sheet_lie_on_it_on_both_sides():
    sheet = trimesh.creation.icosphere(4, 0.5)
    sheet = without(sheet, sheet.triangles_center[:, 2] < 0)
    made: GaussianScene = Meshes([[part_of(sheet)]]).stand_ins
    outward = np.einsum("mc,mc->m", made.normals(), made.means) > 0
    assert 0.45 < outward.mean() < 0.55
    for side in (outward, ~outward):
        radii = np.linalg.norm(made.means[side], axis=1)
        assert np.quantile(radii, 0.02) > 0.5 * (1 - 2.5e-3)
        assert radii.max() < 0.5 + 1e-5
