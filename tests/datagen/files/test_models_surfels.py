"""A model as surfels is what the path tracer sees of its mesh: places, normals, textures and areas."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial import KDTree
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from datagen.truth.build import build
from datagen.truth.pathtrace import gbuffers
from datagen.world.objects import ObjectSpec, Placement
from datagen.world.scene import draw_scene
from tron.cameras import Camera
from tron.editing import EditList, Insert, Remove, Selection, Views
from tron.errors import TronError
from tron.gaussians.scene import GaussianScene
from tron.models.load import load_model
from tron.models.parts import Sampling
from tron.models.surfels import surfels_of_model
from tron.seeds import generator
from tron.tracing import SurfelTracer

NOISE = generator(1, "texture").integers(0, 255, (16, 16, 3))
QUAD = np.array([[-1.0, 0, 0], [1, 0, 0], [1, 2, 0], [-1, 2, 0]])  # faces +z, y up: a standing card
UV = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])


def image(pixels) -> Image.Image:
    return Image.fromarray(np.asarray(pixels, np.uint8))


def write_quad(path, material, vertices=QUAD):
    mesh = trimesh.Trimesh(vertices, [[0, 1, 2], [0, 2, 3]], process=False)
    mesh.visual = TextureVisuals(uv=UV, material=material)
    path.write_bytes(trimesh.Scene(mesh).export(file_type="glb"))
    return path


def scene_of(parts):
    drawn = draw_scene(0, "test", 0, style="object", lights=["overcast"], frames=1, path_frames=4)
    at = Placement(quaternion=(1, 0, 0, 0), position=(0.0, 0.0, 0.0))
    item = ObjectSpec(asset="card", size=1.0, placement=at)
    return build(drawn.model_copy(update={"objects": (item,)}), {"card": parts})


def front(side: int) -> Camera:
    """In front of a card that stands in the plane y = 0 and faces -y."""
    return Camera.look_at((0, -4.0, 0), (0, 0, 0), fov_deg=30, width=side, height=side)


@pytest.mark.parametrize("wrap", ["repeat", "mirror", "clamp"])
def test_textures_are_where_the_path_tracer_has_them(tmp_path, variant, wrap):
    """Scaled, turned and continued: of single texels, 16 to a turn of the texture."""
    path = write_quad(tmp_path / "card.glb", PBRMaterial(baseColorTexture=image(NOISE), metallicFactor=0))
    matrix = np.array([[1.6, 0.5, -0.3], [-0.5, 1.6, 0.2], [0, 0, 1]])
    parts = [replace(each, sampling={"base_color": Sampling(matrix, wrap)}) for each in load_model(path)]
    view = gbuffers(scene_of(parts), [front(192)])[0]
    card = view.object_id == 2
    surfels = surfels_of_model(parts, 0.01)
    near = KDTree(surfels.means).query(view.position[card])[1]
    difference = np.abs(surfels.base_color[near] - view.base_color[card]).mean()
    assert difference < 0.25 * np.abs(view.base_color[card] - view.base_color[card].mean(0)).mean()
    np.testing.assert_allclose(surfels.normals()[near], view.normal[card], atol=1e-3)


def test_factors_vertices_and_packed_textures_give_materials(tmp_path):
    packed = np.zeros((8, 8, 3), np.uint8)
    packed[..., 1], packed[..., 2] = 128, 255
    material = PBRMaterial(metallicRoughnessTexture=image(packed), roughnessFactor=0.5, metallicFactor=0.6)
    surfels = surfels_of_model(load_model(write_quad(tmp_path / "card.glb", material)), 0.05)
    np.testing.assert_allclose(surfels.roughness, 0.5 * 128 / 255, atol=1e-3)
    np.testing.assert_allclose(surfels.metallic, 0.6, atol=1e-3)


def test_a_ball_is_closed_and_as_dense_as_it_was_asked_to_be(tmp_path, variant):
    ball = trimesh.creation.icosphere(3, radius=1.0)
    (tmp_path / "ball.glb").write_bytes(trimesh.Scene(ball).export(file_type="glb"))
    for degree in (2, 4):
        parts = load_model(tmp_path / "ball.glb")
        surfels = surfels_of_model(parts, 0.05, kernel_degree=degree, object_id=3)
        assert len(surfels) == pytest.approx(4 * np.pi / 0.05**2, rel=0.05)
        np.testing.assert_allclose(np.linalg.norm(surfels.means, axis=1), 1, atol=0.02)
        np.testing.assert_allclose(np.einsum("mc,mc->m", surfels.normals(), surfels.means), 1, atol=0.02)
        gbuffer = SurfelTracer(surfels).gbuffer(front(96)).numpy()
        inside = np.linalg.norm(gbuffer["position"][..., [0, 2]], axis=-1) < 0.9
        assert set(surfels.object_id) == {3}
        opacity = gbuffer["opacity"][inside & (gbuffer["opacity"] > 0)]
        assert opacity.mean() > 0.93  # as of surfels from G-buffers: cells are not a grid on the surface
        assert np.quantile(opacity, 0.02) > 0.75


@pytest.mark.parametrize(("spacing", "count"), [(10.0, "surfels"), (1e-5, "surfels")])
def test_a_spacing_that_does_not_fit_the_model_is_one_line(tmp_path, spacing, count):
    parts = load_model(write_quad(tmp_path / "card.glb", PBRMaterial()))
    with pytest.raises(TronError, match=f"would be .* {count}"):
        surfels_of_model(parts, spacing)


@pytest.fixture
def scene() -> GaussianScene:
    from examples.stage import make_scene

    return make_scene(0.1)


def test_a_model_is_inserted_upright_in_its_own_units_and_removed_to_the_bit(tmp_path, scene, variant):
    path = write_quad(tmp_path / "card.glb", PBRMaterial(), vertices=0.25 * QUAD + 3)
    there = Insert(file=path, at=(1, 1, 5), scale=2, object=9).apply(scene, Views())
    card = there.means[there.object_id == 9]
    np.testing.assert_allclose(np.ptp(card, axis=0), [1, 0, 1], atol=0.05)
    np.testing.assert_allclose([card[:, 2].min(), *card[:, :2].mean(0)], [0, 1, 1], atol=0.05)
    assert len(card) == pytest.approx(20_000, rel=0.05)
    back = Remove(select=Selection(object=9)).apply(there, Views())
    for name in ("means", "quats", "base_color"):
        np.testing.assert_array_equal(getattr(back, name), getattr(scene, name))
    coarse = Insert(file=path, at=(1, 1, 5), scale=2, object=9, spacing=0.1).apply(scene, Views())
    assert (coarse.object_id == 9).sum() == pytest.approx(200, rel=0.2)  # half on either side


@pytest.mark.parametrize("name", ["none.glb", "broken.obj", "empty.gltf"])
def test_a_model_that_cannot_be_read_is_one_line(tmp_path: Path, scene, name):
    if name != "none.glb":
        (tmp_path / name).write_text("nonsense")
    edits = EditList.of([{"action": "insert", "file": name, "at": [0, 0, 1], "standing": False}], tmp_path)
    with pytest.raises(TronError) as caught:
        edits.apply(scene)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)
