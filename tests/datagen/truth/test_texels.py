"""The atlas: what Mitsuba reads off a mesh is the material there, on seams too; relief bends its normals."""

from typing import Literal

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh

from datagen.truth import build, texels
from datagen.truth.pathtrace import render_frames
from datagen.truth.texels import make_charts
from datagen.world.materials import SOLIDS, Appearance, Material
from datagen.world.shapes import ShapeSpec, make_pieces, split_creases
from datagen.world.shapes.primitives import PRIMITIVES
from tron.cameras import Camera
from tron.seeds import generator
from tron.shading.environments.environment import EnvironmentMap

pytestmark = pytest.mark.usefixtures("variant")

DENSITY = 80.0


class Waves(Material):
    """Colours and relief of long sines, so that interpolation errs little and gradients are known."""

    family: Literal["waves"] = "waves"
    amplitude: float = 0.03

    def evaluate(self, points: np.ndarray, normals: np.ndarray) -> Appearance:
        color = 0.5 + 0.34 * np.sin(4.0 * points + (0.0, 1.0, 2.0))  # under what dielectrics may have
        rough, metal = 0.5 + 0.4 * np.sin(5.0 * points[:, 0]), 0.5 + 0.5 * np.cos(3.0 * points[:, 2])
        height = self.amplitude * np.sin(6.0 * points).sum(axis=1)
        return Appearance(*(np.float32(each) for each in (color, rough, metal, height)))

    def gradient(self, points: np.ndarray) -> np.ndarray:
        return self.amplitude * 6.0 * np.cos(6.0 * points)


def shape(kind: str, edge: float = 0.1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    spec = ShapeSpec(kind=kind, size=0.7, parameters=(0.3, 0.6, 0.4, 0.7))
    return split_creases(make_pieces(spec, edge)[0].mesh)


def on_mesh(vertices, normals, faces, count=4000):
    """Random points of a mesh with their normals and triangles, and which triangle each is on."""
    corners = vertices[faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    rng = generator(0, "surface")
    face = rng.choice(len(faces), count, p=areas / areas.sum())
    weights = rng.dirichlet((1.0, 1.0, 1.0), count)
    normal = np.einsum("nk,nki->ni", weights, normals[faces[face]])
    points = np.einsum("nk,nki->ni", weights, corners[face])
    return points, normal / np.linalg.norm(normal, axis=1, keepdims=True), face, weights


def read(surface: build.Surface, face: np.ndarray, weights: np.ndarray) -> dict[str, np.ndarray]:
    """What Mitsuba's own hits and BSDF say at places of a mesh, met by rays from just before them."""
    parameters = mi.traverse(surface.shape)
    vertices = np.array(parameters["vertex_positions"]).reshape(-1, 3)
    corners = vertices[np.array(parameters["faces"]).reshape(-1, 3)[face]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    start = np.einsum("nk,nki->ni", weights, corners) + 1e-3 * normal
    ray = mi.Ray3f(mi.Point3f(np.float32(start.T)), mi.Vector3f(np.float32(-normal.T)))
    si = build.Geometry([surface]).lit().ray_intersect(ray)
    assert (np.array(si.prim_index) == face).mean() > 0.98
    bent = 2.0 * mi.Vector3f(surface.normal_map.eval_3(si)) - 1.0
    return {
        "base_color": np.array(surface.material.eval_attribute_3("base_color", si)).T,
        "roughness": np.array(surface.material.eval_attribute_1("roughness", si)),
        "metallic": np.array(surface.material.eval_attribute_1("metallic", si)),
        "normal": np.array(dr.normalize(si.sh_frame.to_world(bent))).T,
        "position": np.array(si.p).T,
    }


def baked(*pieces, matrix=None, density=DENSITY):
    matrix = np.eye(4) if matrix is None else matrix
    solids = [build._Solid(texels.Surface(*piece), matrix, 1 + i) for i, piece in enumerate(pieces)]
    return build._solids(solids, density)


@pytest.mark.parametrize("kind", sorted(PRIMITIVES))
def test_mitsuba_reads_the_material_of_every_point(kind):
    arrays, material = shape(kind), Waves()
    points, normals, face, weights = on_mesh(*arrays)
    found = read(baked((*arrays, material)), face, weights)
    truth = material.evaluate(points, normals)
    np.testing.assert_allclose(found["position"], points, atol=1e-5)
    # A texel is 1/80: (4/80)^2 / 8 x 0.4 of curvature and the half-precision number itself; slopes to 3 more.
    for name in ("base_color", "roughness", "metallic"):
        np.testing.assert_allclose(found[name], getattr(truth, name), atol=4e-3, err_msg=name)


@pytest.mark.parametrize("kind", ["sphere", "box", "knot", "cone"])
def test_relief_bends_normals_as_its_gradient_says(kind):
    arrays, material = shape(kind, 0.05), Waves()
    turn = trimesh.transformations.random_rotation_matrix(generator(1, "turn").random(3))
    points, normals, face, weights = on_mesh(*arrays)
    found = read(baked((*arrays, material), matrix=turn, density=160.0), face, weights)["normal"]
    slope = material.gradient(points)
    # Mikkelsen: the gradient seen on the triangle, in the plane of the shading normal.
    corners = arrays[0][arrays[2][face]]
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    hu, hv = (np.einsum("ni,ni->n", slope, each)[:, None] for each in (u, v))
    volume = np.einsum("ni,ni->n", u, np.cross(v, normals))[:, None]
    expected = normals - (hu * np.cross(v, normals) + hv * np.cross(normals, u)) / volume
    expected = expected / np.linalg.norm(expected, axis=1, keepdims=True) @ turn[:3, :3].T
    angle = np.degrees(np.arccos(np.clip((found * expected).sum(axis=1), -1.0, 1.0)))
    assert np.median(angle) < 0.3
    assert np.quantile(angle, 0.99) < 2.5
    plain = normals @ turn[:3, :3].T
    assert np.degrees(np.arccos((plain * expected).sum(axis=1))).mean() > 5.0, "there is relief to see"


@pytest.mark.parametrize("kind", ["sphere", "box", "torus", "knot"])
def test_no_seam_between_triangles(kind):
    vertices, normals, faces = shape(kind)
    edges = np.concatenate([faces[:, [i, (i + 1) % 3]] for i in range(3)])
    face = np.tile(np.arange(len(faces)), 3)
    corner = np.repeat(np.arange(3), len(faces))
    surface = baked((vertices, normals, faces, Waves()))
    order = np.lexsort(np.sort(edges, axis=1).T)
    same = np.flatnonzero(
        (np.sort(edges, axis=1)[order][1:] == np.sort(edges, axis=1)[order][:-1]).all(axis=1)
    )
    values = []
    for side in (order[same], order[same + 1]):
        weights = np.full((len(side), 3), 0.495)
        weights[np.arange(len(side)), (corner[side] + 2) % 3] = 0.01
        values.append(read(surface, face[side], weights))
    assert len(same) > 500
    for name in ("base_color", "roughness", "metallic"):
        np.testing.assert_allclose(values[0][name], values[1][name], atol=6e-3, err_msg=name)
    apart = (values[0]["normal"] * values[1]["normal"]).sum(axis=1)
    assert np.degrees(np.arccos(np.clip(np.quantile(apart, 0.02), -1, 1))) < 3.0


def test_texels_of_one_piece_never_reach_another():
    """Two cubes of two colours in one atlas: at every point exactly one's own."""

    class Plain(Waves):
        tone: float

        def evaluate(self, points: np.ndarray, normals: np.ndarray) -> Appearance:
            n = len(points)
            return Appearance(
                np.full((n, 3), self.tone), *(np.full(n, self.tone) for _ in range(2)), np.zeros(n)
            )

    arrays = shape("box")
    beside = (arrays[0] + (3.0, 0.0, 0.0), *arrays[1:])
    surface = baked((*arrays, Plain(tone=0.25)), (*beside, Plain(tone=0.75)))
    _, _, face, weights = on_mesh(*arrays)
    for which, tone in enumerate((0.25, 0.75)):
        found = read(surface, face + which * len(arrays[2]), weights)
        np.testing.assert_allclose(found["base_color"], tone, atol=1e-6)
        np.testing.assert_allclose(found["roughness"], tone, atol=1e-6)


@pytest.mark.parametrize("kind", sorted(PRIMITIVES))
def test_charts_stretch_little_and_lie_side_by_side(kind):
    vertices, _, faces = shape(kind)
    charts = make_charts(vertices, faces)
    corners, flat = vertices[faces], charts.corners
    area = 0.5 * np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    a, b = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    laid = 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    assert (laid <= area * (1 + 1e-9)).all()
    assert (laid >= 0.45 * area).all()


def test_slivers_and_large_faces_cost_their_area():
    """A disc of 2,000 needles around a point, and a wall of two triangles."""
    angle = np.linspace(0, 2 * np.pi, 2001)[:-1]
    rim = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    vertices = np.concatenate([[[0.0, 0.0, 0.0]], rim])
    i = np.arange(2000)
    faces = np.stack([0 * i, 1 + i, 1 + (i + 1) % 2000], axis=1)
    normals = np.broadcast_to((0.0, 0.0, 1.0), vertices.shape)
    atlas = texels.bake([texels.Surface(vertices, normals, faces, Waves())], DENSITY)
    assert atlas.base_color[..., 0].size < 1.2 * (2 * DENSITY + 2) ** 2


def test_what_folds_over_itself_is_divided():
    """A ramp that winds twice around: seen from above its turns lie over each other."""
    angle = np.linspace(0, 4 * np.pi, 200)
    inner = np.stack([0.3 * np.cos(angle), 0.3 * np.sin(angle), 0.04 * angle], axis=1)
    vertices = np.concatenate([inner, inner * (2.0, 2.0, 1.0)])
    i = np.arange(199)
    faces = np.concatenate([np.stack([i, i + 200, i + 201], 1), np.stack([i, i + 201, i + 1], 1)])
    normals = np.broadcast_to((0.0, 0.0, 1.0), vertices.shape)
    arrays = (vertices, normals, faces)
    points, normal, face, weights = on_mesh(*arrays)
    found = read(baked((*arrays, Waves())), face, weights)
    np.testing.assert_allclose(found["base_color"], Waves().evaluate(points, normal).base_color, atol=4e-3)


def test_an_atlas_that_would_be_too_large_is_coarser_and_says_so(caplog):
    arrays = shape("sphere")
    atlas = texels.bake([texels.Surface(*arrays, Waves())], 500.0, most=20_000)
    assert atlas.texels_per_unit < 100
    assert atlas.base_color[..., 0].size < 26_000
    assert "texels a unit instead of 500" in caplog.text


def test_rectangles_are_packed_without_overlap_and_tightly():
    sizes = generator(2, "pack").integers(3, 60, (500, 2))
    places, (height, width) = texels.pack(sizes)
    taken = np.zeros((height, width), int)
    for (x, y), (w, h) in zip(places, sizes):
        taken[y : y + h, x : x + w] += 1
    assert taken.max() == 1
    assert taken.sum() == sizes.prod(axis=1).sum()
    assert taken.mean() > 0.8


@pytest.mark.parametrize("family", SOLIDS, ids=lambda family: family.__name__)
def test_a_white_sky_gives_no_family_more_light_than_it_had(family):
    """Furnace: under radiance 1 a convex body sends back between nothing and one, whatever its relief."""
    material = family.draw(generator(5, family.__name__), family.roles[0])
    geometry = build.Geometry([baked((*shape("sphere", 0.15), material), density=40.0)])
    camera = Camera.look_at((0, -3, 0.5), (0, 0, 0), fov_deg=22, width=12, height=12)
    frame = render_frames(geometry.lit(EnvironmentMap.constant(1.0)), [camera], 64, [1])[0]
    assert frame.max() < 1.1
    assert 0.02 < frame.mean() <= 1.001
